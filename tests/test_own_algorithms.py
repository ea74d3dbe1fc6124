"""Algorithms, loggers and environments of users that do what SB3 allows, but not what its own do."""

import subprocess
import sys
from inspect import signature
from pathlib import Path

import gymnasium as gym
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import HumanOutputFormat, Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper

from sb3_cchain import CChainCallback, CChainDQN, CChainPPO, CChainSAC, ContinualEnv, TrainingCheckpoint, resume
from sb3_cchain.algorithms import ChurnAlgorithm
from sb3_cchain.envs import CommonSpaces, TaskCaption
from sb3_cchain.replaced import replaced
from tests.churn_models import DQN_SETTINGS, PPO_SETTINGS, assert_close
from tests.envs import RandomEnv


class OwnLoop(PPO):
    """Begins its updates with ``zero_grad()``, and has a loss without the values."""

    def train(self):
        for data in self.rollout_buffer.get(self.batch_size):
            self.policy.optimizer.zero_grad()
            _, log_prob, entropy = self.policy.evaluate_actions(data.observations, data.actions.long().flatten())
            loss = -(data.advantages * th.exp(log_prob - data.old_log_prob)).mean()
            loss.backward()
            self.policy.optimizer.step()
            self.logger.record_mean("train/policy_gradient_loss", loss.item())
        self.logger.record("train/entropy_loss", -entropy.mean().item())


class InOrder(RolloutBuffer):
    """Its ``get()`` takes one argument more."""

    def get(self, batch_size=None, shuffle=True):
        for minibatch in super().get(batch_size):
            self.was_shuffled = shuffle
            yield minibatch


class InOrderLoop(PPO):
    def train(self):
        get = self.rollout_buffer.get
        with replaced(self.rollout_buffer, "get", lambda batch_size: get(batch_size, shuffle=False)):
            super().train()


@pytest.mark.parametrize("churn_base_loss", ["actor", "last"])
def test_an_own_buffer_takes_further_arguments(churn_base_loss):
    settings = dict(PPO_SETTINGS, rollout_buffer_class=InOrder)
    model = InOrderLoop("MlpPolicy", "CartPole-v1", **settings).learn(64, CChainCallback(churn_base_loss=churn_base_loss))
    assert model.rollout_buffer.was_shuffled is False


def test_an_own_train_is_trained_with_churn_reduction():
    churns = {}
    for coef in (1e-6, 1e3):
        model = OwnLoop("MlpPolicy", "CartPole-v1", learning_rate=1e-3, **PPO_SETTINGS)
        model.learn(256, CChainCallback(churn_coef=coef))
        churns[coef] = model.logger.name_to_value["churn/policy_churn"]
    assert 0 < 10 * churns[1e3] < churns[1e-6]


class OfEnv(CChainPPO):
    def __init__(self, env):
        super().__init__("MlpPolicy", env, **PPO_SETTINGS)


class OneMore(CChainPPO):
    def __init__(self, *args, more=1, **kwargs):
        super().__init__(*args, **kwargs)


class OneBefore(CChainPPO):
    def __init__(self, before=1, *args, **kwargs):
        super().__init__(*args, **kwargs)


def test_the_signature_of_an_own_constructor():
    assert list(signature(OfEnv).parameters) == ["env"]
    assert signature(OneMore).parameters.keys() == {*signature(CChainPPO).parameters, "more"}
    assert list(signature(OneBefore).parameters) == ["before", "args", "kwargs"]


class FewArguments(PPO):
    def learn(self, total_timesteps, callback=None):
        return super().learn(total_timesteps, callback, tb_log_name="few")


class OwnName(PPO):
    def learn(self, total_timesteps, tb_log_name="own"):
        return super().learn(total_timesteps, tb_log_name=tb_log_name)


class NameOfSB3(PPO):
    def learn(self, total_timesteps, callback=None, tb_log_name="PPO"):
        return super().learn(total_timesteps, callback, tb_log_name=tb_log_name)


@pytest.mark.parametrize(
    "base, args, name",
    [
        (FewArguments, (), "few"),
        (OwnName, (), "own"),
        (OwnName, ("given",), "given"),
        (NameOfSB3, (), "Mine"),
        (NameOfSB3, (None, "given"), "given"),
    ],
)
def test_an_own_learn_keeps_its_arguments_and_its_name(base, args, name, tmp_path):
    class Mine(ChurnAlgorithm, base):
        pass

    model = Mine("MlpPolicy", RandomEnv(), tensorboard_log=str(tmp_path), **PPO_SETTINGS).learn(32, *args)
    assert Path(model.logger.dir).name == f"{name}_1"


class ScaledLoop(PPO):
    """Mixed precision, with the churn gradient scaled as the FAQ says."""

    scale = 1.0

    def train(self):
        scaler = th.amp.GradScaler("cpu", init_scale=self.scale)
        for data in self.rollout_buffer.get(self.batch_size):
            _, log_prob, entropy = self.policy.evaluate_actions(data.observations, data.actions.long().flatten())
            loss = -(data.advantages * th.exp(log_prob - data.old_log_prob)).mean()
            self.policy.optimizer.zero_grad()
            for parameter in self.policy.parameters():
                if parameter.grad is not None:  # only the churn gradient so far
                    parameter.grad *= scaler.get_scale()
            scaler.scale(loss).backward()
            scaler.unscale_(self.policy.optimizer)
            scaler.step(self.policy.optimizer)
            scaler.update()
            self.logger.record_mean("train/policy_gradient_loss", loss.item())
        self.logger.record("train/entropy_loss", -entropy.mean().item())


def test_a_gradient_scaler():
    models = []
    for scale in (1.0, 65536.0):
        models.append(ScaledLoop("MlpPolicy", "CartPole-v1", learning_rate=1e-3, **PPO_SETTINGS))
        models[-1].scale = scale
        models[-1].learn(64, CChainCallback(churn_coef=1e4))
    assert_close(*models, atol=1e-6)
    stock = ScaledLoop("MlpPolicy", "CartPole-v1", learning_rate=1e-3, **PPO_SETTINGS).learn(64)
    with pytest.raises(AssertionError):
        assert_close(models[0], stock, atol=1e-4)


class Prefixed(Logger):
    """Several agents in one log."""

    def record(self, key, value, exclude=None):
        super().record(f"agent/{key}", value, exclude)


@pytest.mark.parametrize("algorithm", [CChainPPO, CChainSAC])
def test_the_logger_may_have_other_names(algorithm, capsys):
    settings = PPO_SETTINGS if algorithm is CChainPPO else {**DQN_SETTINGS, "train_freq": 8}
    coefs = []
    for logger in (Logger, Prefixed):
        model = algorithm("MlpPolicy", "Pendulum-v1", churn_warmup=1, **settings)
        model.set_logger(logger(None, [HumanOutputFormat(sys.stdout)]))
        model.learn(96, log_interval=1)
        model.logger.dump(1)
        coefs.append(model.churn_reducer.coefficient.value)
    assert coefs[0] == coefs[1] not in (0, 1)
    assert "agent/" in capsys.readouterr().out


class OwnLogger:
    """Does not derive from SB3's."""

    def __init__(self):
        self.values = {}

    def record(self, key, value, exclude=None):
        self.values[key] = value

    record_mean = record

    def dump(self, step=0):
        pass


@pytest.mark.parametrize("algorithm", [CChainPPO, CChainDQN])
def test_a_logger_that_has_only_what_sb3_calls(algorithm, tmp_path):
    env = ContinualEnv([RandomEnv, RandomEnv], steps_per_task=24)
    model = algorithm("MlpPolicy", env, **(PPO_SETTINGS if algorithm is CChainPPO else DQN_SETTINGS))
    logger = OwnLogger()
    model.set_logger(logger)
    model.learn(64, TrainingCheckpoint(32, tmp_path))
    assert {"churn/loss", "continual/task_id"} <= logger.values.keys()
    with pytest.warns(UserWarning, match="also logged by OwnLogger"):
        resume(tmp_path, env)


def test_a_loss_that_is_not_logged_is_named():
    class Silent(SAC):
        def train(self, gradient_steps, batch_size=64):
            logger, self._logger = self._logger, Logger(None, [])
            super().train(gradient_steps, batch_size)
            self._logger = logger

    model = Silent("MlpPolicy", "Pendulum-v1", learning_starts=8, buffer_size=64, batch_size=8, device="cpu")
    with pytest.raises(ValueError, match=r"`train\(\)` of Silent must log train/actor_loss, as SB3's does"):
        model.learn(16, CChainCallback())


class Lists(VecEnvWrapper):
    """Its rewards are a list, and it has no attributes to give."""

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        observations, rewards, dones, infos = self.venv.step_wait()
        return observations, rewards.tolist(), dones, infos

    def get_attr(self, attr_name, indices=None):
        return [None] * self.num_envs

    def has_attr(self, attr_name):
        return True


@pytest.mark.parametrize("algorithm", [CChainPPO, CChainDQN])
def test_an_own_vectorised_environment(algorithm):
    base = PPO if algorithm is CChainPPO else DQN
    settings = PPO_SETTINGS if base is PPO else DQN_SETTINGS
    env = Lists(DummyVecEnv([lambda: RandomEnv(action_space=spaces.Discrete(2))]))
    assert algorithm("MlpPolicy", env, **settings).learn(64).num_timesteps == 64


class WithoutOptions(gym.Env):
    """Its ``reset()`` takes no options, which SB3 does not ask for."""

    observation_space, action_space = spaces.Box(-1, 1, (2,)), spaces.Discrete(2)

    def reset(self, seed=None):
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {}


def test_tasks_whose_reset_takes_no_options(tmp_path):
    env = ContinualEnv([WithoutOptions, WithoutOptions], steps_per_task=64)
    checkpoint = TrainingCheckpoint(32, tmp_path)
    model = CChainPPO("MlpPolicy", make_vec_env(lambda: env), **PPO_SETTINGS).learn(128, checkpoint)
    assert model.num_timesteps == 128 and env.task_id == 1
    pictured = WithoutOptions()
    pictured.render_mode = "rgb_array"
    assert TaskCaption(pictured).reset()[1] == {}
    assert CommonSpaces(WithoutOptions(), 4, 2, "wrap").reset()[0].shape == (4,)


FOR_MYPY = """
[mypy]
strict = true
follow_imports = silent
ignore_missing_imports = true
cache_dir = {cache}
[mypy-torch.*,numpy.*,gymnasium.*,stable_baselines3.*,sb3_contrib.*,matplotlib.*,pandas.*]
follow_imports = skip
"""


def test_type_checkers_know_which_classes_there_are(tmp_path):
    """Those of sb3-contrib, too, which are imported when they are asked for."""
    (tmp_path / "mypy.ini").write_text(FOR_MYPY.format(cache=tmp_path / "cache"))
    program = "from sb3_cchain import CChainMaskablePPO, CChainPOO\nclass Own(CChainMaskablePPO): pass"
    command = [sys.executable, "-m", "mypy", "--config-file", str(tmp_path / "mypy.ini"), "-c", program]
    errors = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, text=True).stdout.splitlines()
    assert 'has no attribute "CChainPOO"' in errors[0] and errors[1:] == ["Found 1 error in 1 file (checked 1 source file)"]
