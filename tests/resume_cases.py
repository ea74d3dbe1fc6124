"""Small trainings that are stopped and resumed: how each is made, and what two of them are compared by."""

import copy
import hashlib
import multiprocessing
import os
import random
import signal
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Optional

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import A2C, DQN, PPO, SAC, TD3, HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback, StopTrainingOnNoModelImprovement
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import SubprocVecEnv, VecFrameStack, VecMonitor, VecNormalize
from torch import nn

from sb3_cchain import CChainCallback, CChainDQN, CChainPPO, ChurnMonitor, ContinualMetrics, DoubleDQN, TaskSync
from sb3_cchain.algorithms.churn_targets import churn_kind
from sb3_cchain.analysis import Doctor, EvalAllTasks, EvalTrainedTask, NetworkHealth, NTKCallback
from sb3_cchain.callbacks import TaskLearningStarts
from sb3_cchain.checkpoint import ResumableEnv, TrainingCheckpoint, find_checkpoint, resume
from sb3_cchain.checkpoint.training_description import constructor_arguments
from sb3_cchain.envs import ContinualProcgenVecEnv, TaskVecNormalize
from sb3_cchain.methods import PlasticityInjection
from sb3_cchain.methods.registry import FAMILY_PAGE, REGISTRY
from sb3_cchain.networks import InjectionDQNPolicy
from tests.method_models import make_callback, nested_optimizers, optimizer_arguments

# Another one in each process, so that nothing goes on well because it began alike
OTHER_SEED = 1000


class Extractor(BaseFeaturesExtractor):
    """Cheap features of pictures."""

    def __init__(self, observation_space):
        super().__init__(observation_space, 8)
        self.net = nn.Sequential(nn.AdaptiveAvgPool2d(4), nn.Flatten(), nn.LazyLinear(8), nn.ReLU())
        self.net(th.zeros(1, *observation_space.shape))

    def forward(self, observations):
        return self.net(observations)


class BatchNormExtractor(BaseFeaturesExtractor):
    """Statistics of batches, which target networks copy."""

    def __init__(self, observation_space):
        super().__init__(observation_space, 8)
        self.net = nn.Sequential(nn.Flatten(), nn.Linear(spaces.flatdim(observation_space), 8), nn.BatchNorm1d(8))

    def forward(self, observations):
        return self.net(observations)


class MaskedCartPole(gym.Wrapper):
    """Forbids the one action or the other, now and then."""

    def __init__(self):
        super().__init__(gym.make("CartPole-v1"))

    def action_masks(self):
        """For MaskablePPO."""
        position = self.unwrapped.state[0]
        return np.array([position > -0.02, position < 0.02])


def vec_env(env_id, n_envs=2, subproc=False, wrap=None, **kwargs):
    """:return: A function of the seed that makes the environment"""

    def make(seed):
        options: dict[str, Any] = {}
        if subproc:
            # Python 3.13 cannot fork a process in which tests of Ray ran, but a new one, which would need a server of its own
            start = {"start_method": "forkserver" if multiprocessing.parent_process() is None else "fork"}
            options = dict(vec_env_cls=SubprocVecEnv, vec_env_kwargs=start, wrapper_class=ResumableEnv)
        if str(env_id).startswith("Continual/"):
            kwargs.setdefault("n_envs", n_envs)
        env = make_vec_env(env_id, n_envs, seed=seed, env_kwargs=kwargs, **options)
        return wrap(env) if wrap else env

    return make


def procgen_vec_env(seed):
    env = ContinualProcgenVecEnv("starpilot", 2, num_threads=0, steps_per_task=150, n_tasks=2)
    env.seed(seed)
    return VecMonitor(env)


@dataclass(frozen=True)
class Case:
    """
    :param algorithm: Class
    :param make_env: A function of a seed
    :param arguments: Of the algorithm, but policy, environment and seed
    :param policy: The policy
    :param callbacks: Makes callbacks, besides ContinualMetrics
    :param total: Environment steps
    :param save_freq: Environment steps between checkpoints
    :param continual: Whether there are tasks
    :param learn: Arguments of ``learn()``
    :param package: What it needs
    :param ends: How it is stopped, the first and the second time: by an error or a signal
    :param checkpoint_last: Whether TrainingCheckpoint comes after the other callbacks, not before them
    """

    algorithm: Any
    make_env: Callable[[int], Any]
    arguments: Callable[[Any], dict[str, Any]] | dict[str, Any]
    policy: Any = "MlpPolicy"
    callbacks: Callable[[], list[BaseCallback]] = list
    total: int = 320
    save_freq: int = 40
    continual: bool = False
    learn: dict[str, Any] | None = None
    package: str | None = None
    ends: tuple[str, str] = ("error", "signal")
    checkpoint_last: bool = False

    def make_model(self, env):
        """The model, with random numbers of its own."""
        algorithm = self.algorithm
        if isinstance(algorithm, str):
            algorithm = getattr(pytest.importorskip("sb3_contrib"), algorithm)
        arguments = self.arguments(env) if callable(self.arguments) else self.arguments
        # Algorithms write to their arguments
        return algorithm(self.policy, env, seed=1, device="cpu", **copy.deepcopy(arguments))

    def make_callbacks(self, folder: Path, save_freq: int, stop: Optional["Stop"]) -> list[BaseCallback]:
        """For ``learn()``."""
        continual = [TaskSync(), ContinualMetrics(folder / "returns.csv")] if self.continual else []
        own = self.callbacks()
        for callback in own:
            if isinstance(callback, (EvalAllTasks, EvalTrainedTask)):
                callback.path = folder / callback.file_name
        others = [*continual, *own, stop or Stop(float("inf"))]
        checkpoint = TrainingCheckpoint(save_freq, folder / "checkpoints")
        return [*others, checkpoint] if self.checkpoint_last else [checkpoint, *others]


NET = dict(net_arch=[8])
ON_POLICY = dict(n_steps=16, batch_size=8, n_epochs=2, policy_kwargs=NET)
OFF_POLICY = dict(learning_starts=20, buffer_size=200, batch_size=8, policy_kwargs=NET)
CHURN = dict(churn_warmup=2, churn_window=4)
PENDULUM = vec_env("Pendulum-v1", 1)
CARTPOLE = vec_env("CartPole-v1")
CONTINUAL_CARTPOLE = vec_env("Continual/CartPole-v1", n_tasks=3, steps_per_task=120)
ACROBOT = dict(n_tasks=3, steps_per_task=150, max_episode_steps=35)
LANDER = dict(n_tasks=3, steps_per_task=150, max_episode_steps=20)
MINATAR = dict(steps_per_task=100)
WALKER = dict(tasks=["stand", "walk"], steps_per_task=70, max_episode_steps=25)
PICTURES = dict(features_extractor_class=Extractor, net_arch=[])


def evaluation():
    """In an environment of its own, which goes on, too; and a callback in it, and one in that."""
    env = VecNormalize(make_vec_env("Pendulum-v1", 1, seed=9, env_kwargs={}), training=False)
    inside = StopTrainingOnNoModelImprovement(max_no_improvement_evals=100)
    return [EvalCallback(env, callback_after_eval=inside, eval_freq=50, n_eval_episodes=1, verbose=0, warn=False)]


def continual_evaluation(env_id, n_eval_episodes=2, **kwargs):
    env = make_vec_env(env_id, 1, seed=9, env_kwargs=kwargs)
    return [EvalCallback(env, eval_freq=30, n_eval_episodes=n_eval_episodes, verbose=0, warn=False)]


def decay(progress):
    """Of a learning rate."""
    return 1e-3 * progress


def normal_noise(env):
    return dict(OFF_POLICY, action_noise=NormalActionNoise(np.zeros(1), np.full(1, 0.3)), train_freq=2)


def correlated_noise(env):
    noise = OrnsteinUhlenbeckActionNoise(np.zeros(1), np.full(1, 0.3))
    return dict(OFF_POLICY, action_noise=noise, train_freq=1, policy_delay=3)


def method_case(method):
    policy_kwargs = {**method.policy_kwargs, **NET}
    if method.optimizer_class is not None:
        policy_kwargs.update(optimizer_class=method.optimizer_class, optimizer_kwargs=optimizer_arguments(method))
    on_policy = issubclass(method.algorithm, PPO)
    arguments = {**(ON_POLICY if on_policy else dict(OFF_POLICY, train_freq=2)), "policy_kwargs": policy_kwargs}
    if issubclass(method.algorithm, (CChainPPO, CChainDQN)):
        arguments |= dict(CHURN, target_churn_ratio=0.1)
    return Case(
        *(method.algorithm, CONTINUAL_CARTPOLE, arguments, method.policy),
        callbacks=lambda: [make_callback(cls) for cls in method.callbacks],
        continual=True,
        checkpoint_last=bool(method.callbacks),
    )


def family_case(method):
    """C-CHAIN for another algorithm than PPO and DQN."""
    name = method.algorithm.__name__.removeprefix("CChain")
    env = {"MaskablePPO": vec_env(MaskedCartPole), **dict.fromkeys(("A2C", "TRPO", "RecurrentPPO", "QRDQN"), CARTPOLE)}
    given = {**(ON_POLICY if issubclass(method.algorithm, OnPolicyAlgorithm) else OFF_POLICY), **CHURN, "churn_target": "auto"}
    if "policy" in churn_kind(method.algorithm).targets:
        given["churn_target"] = "both"
    if not issubclass(method.algorithm, OnPolicyAlgorithm):
        given["train_freq"] = 4  # SAC and its kin would update at each step
    allowed = constructor_arguments(method.algorithm)
    return Case(
        *(method.algorithm, env.get(name, PENDULUM), {key: value for key, value in given.items() if key in allowed}),
        policy="MlpLstmPolicy" if name == "RecurrentPPO" else method.policy,
        learn=dict(log_interval=1),
        package="sb3_contrib",
    )


CASES = {
    **{f"{method.algo} cartpole": method_case(method) for method in REGISTRY if method.page != FAMILY_PAGE},
    **{method.algo: family_case(method) for method in REGISTRY if method.page == FAMILY_PAGE},
    # Continual environments
    "CChainPPO acrobot": Case(
        *(CChainPPO, vec_env("Continual/Acrobot-v1", **ACROBOT), {**ON_POLICY, **CHURN, "churn_reference": "next"}),
        callbacks=lambda: [
            *(ChurnMonitor(interval=1), EvalAllTasks(n_eval_episodes=1, interval=60)),
            EvalTrainedTask(n_eval_episodes=1, interval=30, deterministic=False),
            *continual_evaluation("Continual/Acrobot-v1", **ACROBOT),
        ],
        checkpoint_last=True,
        continual=True,
    ),
    "CChainPPO nested optimisers acrobot processes": Case(
        *(CChainPPO, vec_env("Continual/Acrobot-v1", subproc=True, **ACROBOT)),
        lambda env: {**ON_POLICY, **CHURN, "policy_kwargs": dict(NET, **nested_optimizers()), "learning_rate": decay},
        callbacks=lambda: [NetworkHealth(interval=2)],
        continual=True,
    ),
    "CChainDQN plasticity injection cartpole": Case(
        *(CChainDQN, CONTINUAL_CARTPOLE, dict(OFF_POLICY, **CHURN, train_freq=2), InjectionDQNPolicy),
        callbacks=lambda: [PlasticityInjection()],
        continual=True,
    ),
    "PPO NTK acrobot": Case(
        *(PPO, vec_env("Continual/Acrobot-v1", **ACROBOT), ON_POLICY),
        callbacks=lambda: [
            *(NTKCallback(n_minibatches=4, interval=2, picture_interval=0), NetworkHealth(interval=2)),
            Doctor(interval=1, patience=1),
        ],
        checkpoint_last=True,
        continual=True,
    ),
    "CChainPPO lander": Case(
        *(CChainPPO, vec_env("Continual/LunarLander-v3", wrap=TaskVecNormalize, **LANDER), {**ON_POLICY, **CHURN}),
        callbacks=lambda: [ChurnMonitor(interval=2)],
        continual=True,
        package="Box2D",
    ),
    "PPO lander drifting in cycles": Case(
        *(PPO, vec_env("Continual/LunarLander-v3", **{**LANDER, "n_tasks": 2, "cycles": 2, "blend_steps": 120}), ON_POLICY),
        callbacks=lambda: [EvalAllTasks(n_eval_episodes=1)],
        continual=True,
        package="Box2D",
    ),
    "PPO callback lander processes": Case(
        *(PPO, vec_env("Continual/LunarLander-v3", subproc=True, wrap=VecNormalize, **LANDER), ON_POLICY),
        callbacks=lambda: [CChainCallback(churn_warmup=2, churn_window=4)],
        continual=True,
        package="Box2D",
    ),
    "CChainDQN minatar": Case(
        *(CChainDQN, vec_env("Continual/MinAtar-v0", 1, **MINATAR)),
        dict(OFF_POLICY, **CHURN, train_freq=4, gradient_steps=2, policy_kwargs=PICTURES, target_update_interval=30),
        policy="CnnPolicy",
        callbacks=lambda: [TaskLearningStarts(10), ChurnMonitor(interval=20, batch_size=8)],
        checkpoint_last=True,
        continual=True,
        package="minatar",
    ),
    "DoubleDQN minatar processes": Case(
        *(DoubleDQN, vec_env("Continual/MinAtar-v0", 2, subproc=True, **MINATAR)),
        dict(OFF_POLICY, train_freq=2, gradient_steps=2, policy_kwargs=PICTURES, exploration_fraction=0.8),
        policy="CnnPolicy",
        continual=True,
        package="minatar",
    ),
    "CChainPPO procgen vectorised": Case(
        *(CChainPPO, procgen_vec_env, {**ON_POLICY, **CHURN, "policy_kwargs": PICTURES}, "CnnPolicy"),
        continual=True,
        package="procgen",
    ),
    "PPO procgen processes": Case(
        *(PPO, vec_env("Continual/Starpilot-v0", 1, subproc=True, n_tasks=2, steps_per_task=150)),
        *({**ON_POLICY, "policy_kwargs": PICTURES}, "CnnPolicy"),
        continual=True,
        package="procgen",
    ),
    "CChainPPO walker": Case(
        *(CChainPPO, vec_env("Continual/Walker-v0", 1, wrap=TaskVecNormalize, **WALKER), {**ON_POLICY, **CHURN}),
        continual=True,
        total=160,
        package="dm_control",
    ),
    "SAC walker processes": Case(
        *(SAC, vec_env("Continual/Walker-v0", 1, subproc=True, wrap=VecNormalize, **WALKER), OFF_POLICY),
        callbacks=lambda: [NetworkHealth(interval=30)],
        continual=True,
        total=160,
        package="dm_control",
    ),
    "PPO slippery ant drifting": Case(
        *(PPO, vec_env("Continual/SlipperyAnt-v0", 1, n_tasks=3, steps_per_task=70, blend_steps=40, max_episode_steps=25)),
        ON_POLICY,
        continual=True,
        total=160,
        package="mujoco",
    ),
    "DQN minigrid processes": Case(
        *(DQN, vec_env("Continual/MiniGrid-v0", 2, subproc=True, steps_per_task=100)),
        dict(OFF_POLICY, train_freq=2),
        continual=True,
        package="minigrid",
    ),
    "PPO sequence": Case(
        *(PPO, vec_env("Continual/Sequence-v0", steps_per_task=100, cycles=2), ON_POLICY), continual=True, total=400
    ),
    # The algorithms of Stable-Baselines3 and sb3-contrib
    # After a signal, which does not wait for the end of an interval, the log goes on in another rhythm
    "A2C log interval": Case(
        A2C, vec_env("CartPole-v1", 3), dict(policy_kwargs=NET), learn=dict(log_interval=3), ends=("error", "error")
    ),
    "PPO evaluation": Case(
        PPO, vec_env("Pendulum-v1", wrap=VecNormalize), dict(ON_POLICY, learning_rate=decay), callbacks=evaluation, total=400
    ),
    "PPO gSDE": Case(PPO, PENDULUM, dict(ON_POLICY, use_sde=True, sde_sample_freq=-1, clip_range=decay)),
    "PPO frames": Case(PPO, vec_env("CartPole-v1", wrap=partial(VecFrameStack, n_stack=3)), ON_POLICY),
    "PPO stopped": Case(PPO, CARTPOLE, dict(ON_POLICY, target_kl=1e-4, normalize_advantage=False)),
    "DQN": Case(DQN, CARTPOLE, dict(OFF_POLICY, train_freq=3, target_update_interval=25, exploration_fraction=0.9)),
    "DQN memory": Case(
        DQN,
        vec_env("CartPole-v1", 1),
        dict(OFF_POLICY, optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False)),
    ),
    "DQN n steps": Case(DQN, CARTPOLE, dict(OFF_POLICY, n_steps=3, buffer_size=80), total=400),
    "DQN HER": Case(
        *(DQN, vec_env(partial(BitFlippingEnv, n_bits=4, continuous=False, max_steps=6), 2)),
        dict(OFF_POLICY, replay_buffer_class=HerReplayBuffer, replay_buffer_kwargs=dict(n_sampled_goal=2), train_freq=2),
        policy="MultiInputPolicy",
    ),
    "SAC gSDE": Case(SAC, PENDULUM, dict(OFF_POLICY, use_sde=True, use_sde_at_warmup=True, train_freq=8, sde_sample_freq=4)),
    "SAC batch norm": Case(
        SAC,
        PENDULUM,
        dict(
            OFF_POLICY, policy_kwargs=dict(NET, features_extractor_class=BatchNormExtractor), target_update_interval=7, tau=0.1
        ),
        total=200,
    ),
    "SAC episodes": Case(
        *(SAC, vec_env(partial(gym.make, "Pendulum-v1", max_episode_steps=25), 1)),
        dict(OFF_POLICY, train_freq=(1, "episode"), gradient_steps=-1),
        learn=dict(log_interval=2),
        total=200,
    ),
    "TD3 noise": Case(TD3, PENDULUM, normal_noise),
    "TD3 correlated noise": Case(TD3, vec_env("Pendulum-v1", 2), correlated_noise),
    "QRDQN": Case("QRDQN", CARTPOLE, dict(OFF_POLICY, policy_kwargs=dict(NET, n_quantiles=5))),
    "TQC": Case("TQC", PENDULUM, dict(OFF_POLICY, train_freq=2), total=160),
    "CrossQ": Case("CrossQ", PENDULUM, dict(OFF_POLICY, train_freq=2), total=160),
    "TRPO": Case("TRPO", CARTPOLE, dict(n_steps=16, batch_size=8, policy_kwargs=NET)),
    "RecurrentPPO": Case(
        "RecurrentPPO", CARTPOLE, dict(ON_POLICY, policy_kwargs=dict(NET, lstm_hidden_size=8)), "MlpLstmPolicy"
    ),
    "MaskablePPO": Case("MaskablePPO", vec_env(MaskedCartPole), ON_POLICY),
}


class Stop(BaseCallback):
    """
    Ends training, in place of what may happen to a process. It draws random numbers of Python meanwhile.

    :param step: When
    :param kind: An error, or a signal
    """

    def __init__(self, step: float, kind: str = "error"):
        super().__init__()
        # Not the argument's name, so that it is no setting that a checkpoint leaves alone
        self.at, self.kind = step, kind

    def state_dict(self):
        """Each process has its own end."""
        return {}

    def load_state_dict(self, state):
        """Each process has its own end."""

    def _on_step(self):
        random.random()  # SB3 does not, but environments and callbacks may
        if self.num_timesteps >= self.at:
            self.at = float("inf")
            if self.kind == "error":
                raise Stopped
            os.kill(os.getpid(), signal.SIGTERM)
        return True


class Stopped(Exception):
    """By Stop."""


class Record(KVWriter):
    """Keeps what is logged, by step."""

    def __init__(self):
        self.rows = []

    def write(self, key_values, key_excluded, step=0):
        """As other writers do."""
        row = {key: plain(value) for key, value in key_values.items() if not key.startswith("time/")}
        self.rows.append((step, row))

    def close(self):
        """There is nothing to close."""


def plain(value: Any) -> Any:
    """What can be compared and sent to another process: arrays by a hash of their bytes."""
    if isinstance(value, th.Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.generic):
        value = np.asarray(value)
    if isinstance(value, np.ndarray) and value.dtype == object:
        return plain(value.tolist())
    if isinstance(value, np.ndarray):
        if value.size == 1:
            return value.dtype.str, value.shape, value.item()
        return value.dtype.str, value.shape, hashlib.sha1(np.ascontiguousarray(value).tobytes()).hexdigest()
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    return value if isinstance(value, (int, float, str, bool, type(None))) else type(value).__name__


def flat(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    """The entries of nested dictionaries and lists, by names that say where they are. Empty ones count as absent."""
    value = value.as_dict() if hasattr(value, "as_dict") else value
    if isinstance(value, dict):
        for key, entry in value.items():
            yield from flat(entry, f"{path}.{key}")
    elif isinstance(value, (list, tuple)):
        for index, entry in enumerate(value):
            yield from flat(entry, f"{path}.{index}")
    else:
        yield path, plain(value)


# Attributes of models in which a difference shows
ATTRIBUTES = (
    *("num_timesteps", "_n_updates", "_episode_num", "_last_obs", "_last_episode_starts", "_last_original_obs"),
    *("exploration_rate", "_total_timesteps", "_current_progress_remaining", "_n_calls", "continual_returns"),
    "task_returns",
    "evaluations",
    *("learning_starts", "_last_lstm_states", "churn_state", "continual_state"),
)


def outcome(model) -> dict[str, Any]:
    """All that a training came to, by names. It is the last thing done with the model, for it acts in its environment."""
    found = dict(flat(model.get_parameters(), "parameters"))
    for name in model._get_torch_save_params()[1]:
        found |= flat(getattr(model, name, None), name)
    for name in ATTRIBUTES:
        found |= flat(getattr(model, name, None), name)
    found |= flat([{key: info[key] for key in "rl"} for info in model.ep_info_buffer], "ep_info_buffer")
    found |= flat(list(model.ep_success_buffer), "ep_success_buffer")
    found |= flat(random.getstate(), "random numbers of Python")
    found |= flat(np.random.get_state(), "random numbers of NumPy")
    found |= flat(th.get_rng_state(), "random numbers of PyTorch")
    found |= flat(model.action_space.np_random.bit_generator.state, "random numbers of actions")
    buffer = getattr(model, "replay_buffer", None)
    if buffer is not None:
        for name, value in vars(buffer).items():
            if isinstance(value, (np.ndarray, dict, int)):
                found |= flat(value, f"replay buffer.{name}")
    noise = getattr(model, "action_noise", None)
    if noise is not None:
        found |= flat(noise(), "next noise")
    found |= flat(model.predict(model._last_obs)[0], "next action")
    env = model.env
    normalize = model.get_vec_normalize_env()
    if normalize is not None:
        found |= flat(
            {"obs": vars(normalize.obs_rms), "ret": vars(normalize.ret_rms), "returns": normalize.returns}, "normalise"
        )
    # All that is in the environments shows in their next steps
    for step in range(12):
        actions = np.random.default_rng(step)
        low = getattr(env.action_space, "low", None)
        action = (
            actions.integers(env.action_space.n, size=env.num_envs)
            if low is None
            else actions.uniform(low, env.action_space.high, (env.num_envs, *low.shape)).astype(np.float32)
        )
        observations, rewards, dones, infos = env.step(action)
        found |= flat([observations, rewards, dones], f"next step {step}")
        found |= flat([info.get("task_id") for info in infos], f"next task {step}")
    return found


def begin(case: Case, folder: Path, save_freq: int, stop: Stop | None = None):
    """
    Train from the beginning.

    :param case: The training
    :param folder: For its files
    :param save_freq: Environment steps between checkpoints
    :param stop: Ends it, if it is to be ended
    :return: The model, None if it was stopped; and the rows of its log
    """
    set_random_seed(5)
    env, record = case.make_env(3), Record()
    try:
        model = case.make_model(env)
        model.set_logger(Logger(None, [record]))
        model.learn(case.total, case.make_callbacks(folder, save_freq, stop), **(case.learn or {}))
        return outcome(model), record.rows
    except (Stopped, SystemExit):
        return None, record.rows
    finally:
        env.close()


def go_on(case: Case, folder: Path, stop: Stop | None = None):
    """
    Go on with it in another process.

    :return: As :func:`begin`, and the step of the checkpoint
    """
    set_random_seed(OTHER_SEED + 1)
    env, record = case.make_env(OTHER_SEED), Record()
    start = find_checkpoint(folder / "checkpoints").num_timesteps
    try:
        callbacks = case.make_callbacks(folder, case.save_freq, stop)
        model = resume(folder / "checkpoints", env, callbacks, logger=Logger(None, [record]), device="cpu")
        return outcome(model), record.rows, start
    except (Stopped, SystemExit):
        return None, record.rows, start
    finally:
        env.close()


def in_new_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """
    :param function: Of a module
    :param arguments: Its arguments
    :return: What it returned in a process in which nothing was done before
    """
    # Its processes are copies of one that has imported modules (tests/conftest.py) and done nothing else
    context = multiprocessing.get_context("forkserver")
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_send, args=(there, function, arguments))
    process.start()
    there.close()
    try:
        returned, error = here.recv()
    except EOFError:
        returned, error = None, "the process ended without a word"
    process.join()
    if error is not None:
        raise RuntimeError(f"In the new process: {error}")
    return returned


def _send(connection: Any, function: Callable[..., Any], arguments: Any) -> None:
    try:
        th.set_num_threads(1)
        connection.send((function(*arguments), None))
    except Exception:
        connection.send((None, traceback.format_exc()))


def stopped_piece(name: str, folder: Path, save_freq: int, stop: tuple[float, str]):
    """:func:`begin` for another process."""
    return begin(CASES[name], folder, save_freq, Stop(*stop))


def further_piece(name: str, folder: Path, stop: tuple[float, str] | None):
    """:func:`go_on` for another process."""
    return go_on(CASES[name], folder, stop and Stop(*stop))
