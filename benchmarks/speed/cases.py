"""What is timed: models under the same shipped settings."""

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import sb3_contrib
import stable_baselines3
import torch as th
from sb3_contrib.common.envs import InvalidActionEnvDiscrete
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn

import sb3_cchain
from benchmarks.speed import sbx_ppo
from benchmarks.speed.deepcopy_dqn import DeepCopyDQN
from benchmarks.speed.deepcopy_ppo import DeepCopyPPO
from benchmarks.speed.settings import model_settings
from benchmarks.speed.timing import Case, Entry, Product, n_operations, seconds
from benchmarks.speed.training import iteration, timed_learn
from sb3_cchain import CChainDQN, CChainPPO, ContinualMetrics, DoubleDQN, TaskSync, make_lean
from sb3_cchain.methods import ReDo, ReGraMa
from sb3_cchain.methods.registry import BY_ALGO, REGISTRY, Method

# Methods that by default act less often than once in what is timed, so that they would seem to cost nothing
EACH_ITERATION: dict[type[BaseCallback], dict[str, Any]] = {
    ReDo: {"interval": 1},
    ReGraMa: {"interval": 1},
}


def ppo(env_id: str, product: Callable[[], Product], n_rounds: int, sbx: bool = True, **changed: Any) -> Case:
    """
    :param env_id: Environment id
    :param product: Makes the largest product of a forward pass
    :param n_rounds: How often each model is timed
    :param sbx: Whether SBX has the network
    :param changed: Arguments that differ from the shipped settings
    :return: PPO under the settings of that environment
    """
    stock = partial(model_settings, "ppo", env_id, **changed)
    cchain = partial(model_settings, "ppo_cchain", env_id, **changed)
    models: dict[str, PPO] = {
        "PPO": PPO(**stock()),
        "lean PPO": make_lean(PPO(**stock())),
        "CChainPPO": CChainPPO(**cchain()),
        'CChainPPO, `churn_reference="next"`': CChainPPO(**cchain(), churn_reference="next"),
        "deep copy": DeepCopyPPO(**stock()),
    }
    entries = {}
    for name, model in models.items():
        iteration(model)  # from here on, every update has a churn loss
        entries[name] = Entry(partial(iteration, model), n_operations(model.train))
    if sbx and sbx_ppo.is_installed():
        # The algorithm is PPO's, and so are the operations that it needs
        entries["SBX's PPO"] = Entry(sbx_ppo.SBXProcess(env_id, **changed).iteration, entries["PPO"].n_operations)
    different = ", ".join(f"`{name}={value}`" for name, value in changed.items())
    note = f"Differs from the shipped settings: {different}." if changed else ""
    return Case(entries, ("PPO", "lean PPO"), n_rounds, product(), note)


def matrix_product(n_rows: int, n_inputs: int, n_outputs: int) -> Product:
    """
    :param n_rows: Size of the minibatch
    :param n_inputs: Inputs of the layer
    :param n_outputs: Outputs of the layer
    :return: The product of a linear layer
    """
    name = f"the product of a {n_rows} × {n_inputs} and a {n_inputs} × {n_outputs} matrix"
    return Product(name, partial(th.mm, th.ones(n_rows, n_inputs), th.ones(n_inputs, n_outputs)))


def convolution(n_images: int, size: int, n_inputs: int, n_outputs: int) -> Product:
    """
    :param n_images: Size of the minibatch
    :param size: Height and width of the images
    :param n_inputs: Channels of the images
    :param n_outputs: Channels of the result
    :return: A 3×3 convolution, in the layout that it is fastest in
    """
    name = f"a 3 × 3 convolution of {n_images} images of {size} × {size} with {n_inputs} channels to {n_outputs} channels"
    images = th.ones(n_images, n_inputs, size, size).contiguous(memory_format=th.channels_last)
    return Product(name, partial(nn.functional.conv2d, images, th.ones(n_outputs, n_inputs, 3, 3), padding=1))


def related() -> Case:
    """
    :return: PPO under the Gym Control settings with each of the methods of the registry that are settings of PPO, and C-CHAIN
    """

    def make(method: Method) -> tuple[Any, list[BaseCallback]]:
        settings = model_settings("ppo", "Continual/Acrobot-v1")
        adam = settings["policy_kwargs"].pop("optimizer_kwargs")
        policy_kwargs = {"optimizer_kwargs": adam, **settings["policy_kwargs"], **method.policy_kwargs}
        if method.optimizer_class is not None:
            base = {"base_kwargs": adam} if method.optimizer_class.has_arguments_of_base else {}
            optimizer_kwargs = {**base, **method.optimizer_kwargs}
            policy_kwargs |= {"optimizer_class": method.optimizer_class, "optimizer_kwargs": optimizer_kwargs}
        model = method.algorithm(**{**settings, "policy": method.policy, "policy_kwargs": policy_kwargs})
        # Each with the callbacks that it learns with
        return model, [callback(**EACH_ITERATION.get(callback, {})) for callback in method.callbacks]

    # Callbacks act around train(), some only between the iterations of a learn(). No task switches in between.
    def iterations(model: Any, callbacks: list[BaseCallback]) -> dict[str, float]:
        learn = partial(model.learn, 3 * model.n_steps, callback=[TaskSync(), ContinualMetrics(), *callbacks])
        return {"3 iterations": seconds(partial(learn, reset_num_timesteps=False))}

    entries = {}
    for method in REGISTRY:
        if issubclass(method.algorithm, PPO):
            round_of_it = partial(iterations, *make(method))
            round_of_it()
            entries[method.label] = Entry(round_of_it)
    return Case(entries, [BY_ALGO["ppo"].label], n_rounds=4)


def minatar(n_past_updates: int = 0) -> Case:
    """
    :param n_past_updates: Updates that the running means already hold
    :return: Double DQN under the MinAtar settings: a small convolutional network, minibatches of 32
    """
    changed = {"buffer_size": 20_000, "learning_starts": 1000}
    settings = model_settings("double_dqn", "Continual/MinAtar-v0", **changed)
    cchain = partial(model_settings, "dqn_cchain", "Continual/MinAtar-v0", **changed)
    models: dict[str, Any] = {
        "DoubleDQN": DoubleDQN(**settings),
        "CChainDQN": CChainDQN(**cchain()),
        'CChainDQN, `churn_reference="next"`': CChainDQN(**cchain(), churn_reference="next"),
        "deep copy": DeepCopyDQN(**{name: value for name, value in settings.items() if name not in ("double_q", "loss")}),
    }
    entries = {}
    for name, model in models.items():
        timed_learn(model, 1200, "")
        one_update = partial(model.train, gradient_steps=1, batch_size=model.batch_size)
        round_of_it = partial(timed_learn, model, 200, "environment step and update")
        entries[name] = Entry(round_of_it, 200 * n_operations(one_update))
    for _ in range(n_past_updates):
        for model in models.values():
            if isinstance(model, CChainDQN):
                model.churn_reducer.coefficient.update(0.01, 1e-6)
        models["deep copy"].td_losses.append(0.01)
        models["deep copy"].churn_losses.append(1e-6)
    note = "Seconds are of 200 steps with an update each."
    return Case(entries, ["DoubleDQN"], 15, matrix_product(32, 1024, 128), note)


def family() -> Case:
    """
    :return: Each of the other algorithms with churn reduction and its base, with their default targets and a small network
    """
    on_policy, off_policy = dict(n_steps=128, batch_size=64), dict(learning_starts=100, buffer_size=10_000)
    masked = InvalidActionEnvDiscrete(dim=20, n_invalid_actions=10)
    settings: dict[str, tuple[str, str | gym.Env, dict[str, Any]]] = {
        "A2C": ("MlpPolicy", "CartPole-v1", {}),
        "TRPO": ("MlpPolicy", "CartPole-v1", on_policy),
        "MaskablePPO": ("MlpPolicy", masked, dict(n_epochs=4, **on_policy)),
        "RecurrentPPO": ("MlpLstmPolicy", "CartPole-v1", dict(n_epochs=4, **on_policy)),
        "QRDQN": ("MlpPolicy", "CartPole-v1", dict(train_freq=1, **off_policy)),
        **{name: ("MlpPolicy", "Pendulum-v1", off_policy) for name in ("SAC", "TD3", "DDPG", "TQC", "CrossQ")},
    }
    entries = {}
    for name, (policy, env, arguments) in settings.items():
        base = getattr(stable_baselines3, name, None) or getattr(sb3_contrib, name)
        for algorithm in (base, getattr(sb3_cchain, f"CChain{name}")):
            model = algorithm(policy, env, policy_kwargs=dict(net_arch=[64, 64]), seed=0, device="cpu", **arguments)
            timed_learn(model, 256, "", continual=False)  # from here on, every update has a churn loss
            entries[algorithm.__name__] = Entry(partial(timed_learn, model, 128, "steps and updates", continual=False))
    pairs = {f"CChain{name}": name for name in settings}
    note = "Two hidden layers of 64. Each is divided by its own base."
    return Case(entries, (), 7, note=note, base_of=pairs)


CASES: dict[str, Callable[[], Case]] = {
    "gym_control": partial(ppo, "Continual/Acrobot-v1", partial(matrix_product, 32, 256, 256), n_rounds=15),
    "dmc": partial(ppo, "Continual/Walker-v0", partial(matrix_product, 64, 256, 256), n_rounds=5),
    # One epoch. SBX has the Nature CNN only
    "procgen": partial(
        ppo, "Continual/Starpilot-v0", partial(convolution, 125, 32, 16, 32), n_rounds=3, sbx=False, n_epochs=1
    ),
    "related": related,
    "minatar": minatar,
    "minatar_later": partial(minatar, n_past_updates=50_000),
    "family": family,
}
