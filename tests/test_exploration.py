"""Exploration that begins again at each task."""

import json

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import TRPO
from stable_baselines3 import A2C, DQN, PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback

from sb3_cchain import CChainCallback, CChainPPO, TaskSignal, TrainingCheckpoint
from sb3_cchain.methods import EntropyBonusRestart, ExplorationRateRestart, LogStdRestart
from tests.envs import CountEnv, RandomEnv
from tests.method_models import make_model

BOX = spaces.Box(-1, 1, (2,), np.float32)


class OwnTrustRegion(TRPO):
    """A user's subclass."""


class InTrain(BaseCallback):
    """Reads ``ent_coef`` in ``train()``, by the step at which the rollout began."""

    def __init__(self):
        super().__init__()
        self.ent_coefs = {}

    def _on_training_start(self):
        self.model.policy.optimizer.register_step_pre_hook(self._read)

    def _on_step(self):
        return True

    def _read(self, *_):
        self.ent_coefs[self.num_timesteps - self.model.n_steps] = self.model.ent_coef


class Spy(BaseCallback):
    """Reads a value before each step, or before each rollout."""

    def __init__(self, read):
        super().__init__()
        self.read, self.before_steps, self.before_rollouts = read, {}, {}

    def _on_rollout_start(self):
        self.before_rollouts[self.num_timesteps] = self.read(self.model)

    def _on_step(self):
        self.before_steps[self.num_timesteps - 1] = self.read(self.model)
        return True


def test_the_exploration_rate():
    model = make_model("DQN", CountEnv(), exploration_fraction=0.25)
    spy = Spy(lambda model: model.exploration_rate)
    model.learn(80, [TaskSignal(switch_at=[40]), ExplorationRateRestart(0.8, n_steps=20), spy])
    seen = spy.before_steps
    assert seen[10] == pytest.approx(1 - 0.95 * 10 / 20) and seen[39] == 0.05
    assert seen[40] == 0.8  # the first step of the task
    assert seen[50] == pytest.approx(0.8 - 0.75 * 10 / 20)
    assert seen[60] == seen[79] == pytest.approx(0.05)


def test_the_exploration_rate_goes_on_over_calls_of_learn(tmp_path):
    model = make_model("DQN", CountEnv())
    model.learn(50, [TaskSignal(switch_at=[40]), ExplorationRateRestart(n_steps=20)]).save(tmp_path / "model")
    loaded, spy = DQN.load(tmp_path / "model", env=CountEnv(), device="cpu"), Spy(lambda model: model.exploration_rate)
    loaded.learn_starts = 0
    loaded.learn(10, [TaskSignal(switch_at=[40]), ExplorationRateRestart(n_steps=20), spy], reset_num_timesteps=False)
    assert spy.before_steps[55] == pytest.approx(1 - 0.95 * 15 / 20)


@pytest.mark.parametrize("is_given_again", [True, False])
def test_the_exploration_rate_is_the_models_own_in_the_next_training(is_given_again):
    model = make_model("DQN", CountEnv(), exploration_fraction=0.5)
    callbacks = [TaskSignal(switch_at=[40]), ExplorationRateRestart(0.8, n_steps=20)]
    model.learn(80, callbacks)
    spy = Spy(lambda model: model.exploration_rate)
    model.learn(40, [*callbacks, spy] if is_given_again else spy)
    assert spy.before_steps[10] == pytest.approx(1 - 0.95 * 10 / 20)


@pytest.mark.parametrize("log_std, expected", [(None, 0.0), (-0.5, -0.5)])
@pytest.mark.parametrize("cls", [PPO, A2C, CChainPPO])
def test_the_standard_deviation(cls, log_std, expected):
    settings = {} if cls is A2C else dict(batch_size=8, n_epochs=1)
    model = cls("MlpPolicy", RandomEnv(action_space=BOX), n_steps=16, device="cpu", seed=0, **settings)
    model.policy.log_std.data.fill_(-3.0)
    spy = Spy(lambda model: model.policy.log_std.tolist())
    model.learn(48, [TaskSignal(switch_at=[32]), LogStdRestart(log_std), spy])
    assert max(spy.before_rollouts[16]) < -2.5
    assert spy.before_rollouts[32] == [expected, expected]


def test_the_references_are_forgotten():
    model = CChainPPO("MlpPolicy", RandomEnv(action_space=BOX), n_steps=16, batch_size=8, device="cpu", seed=0)
    spy = Spy(lambda model: model.churn_reducer.reference is None)
    model.learn(48, [TaskSignal(switch_at=[32]), LogStdRestart(), spy])
    assert spy.before_rollouts == {0: True, 16: False, 32: True}


def test_the_entropy_bonus():
    model, spy = make_model("PPO", CountEnv(), ent_coef=0.1), InTrain()
    for steps in (48, 64):
        callbacks = [TaskSignal(switch_at=[32]), EntropyBonusRestart(0.5, n_steps=64), spy]
        model.learn(steps, callbacks, reset_num_timesteps=False)
        assert model.ent_coef == 0.1
    # From 0.5 to the model's 0.1 over 64 steps, a quarter of it a rollout
    assert spy.ent_coefs == pytest.approx({0: 0.1, 16: 0.1, 32: 0.5, 48: 0.4, 64: 0.3, 80: 0.2, 96: 0.1})


def test_the_raised_entropy_bonus_is_not_left_in_the_model(tmp_path):
    class Interruption(CheckpointCallback):
        def _on_rollout_end(self):
            if self.num_timesteps == 48:
                model.policy.optimizer.register_step_pre_hook(self.interrupt)

        def interrupt(self, *_):
            assert model.ent_coef == pytest.approx(0.5)
            raise KeyboardInterrupt

    model = make_model("PPO", CountEnv(), ent_coef=0.1)
    checkpoint = TrainingCheckpoint(16, tmp_path / "training")
    callbacks = [checkpoint, TaskSignal(switch_at=[16]), EntropyBonusRestart(0.5, n_steps=10**9), Interruption(40, tmp_path)]
    with pytest.raises(KeyboardInterrupt):
        model.learn(64, callbacks)
    saved = [PPO.load(path) for path in tmp_path.rglob("*.zip")]
    assert [each.ent_coef for each in (model, *saved)] == [0.1] * 4
    assert all(not json.loads(path.read_text())["left_out"] for path in tmp_path.rglob("checkpoint.json"))


def test_the_users_own_entropy_bonus_may_change_between_calls_of_learn():
    model = make_model("PPO", CountEnv(), ent_coef=0.1)
    for ent_coef in (0.1, 0.3):
        model.ent_coef = ent_coef
        model.learn(32, [TaskSignal(switch_every=16), EntropyBonusRestart(0.5)], reset_num_timesteps=False)
        assert model.ent_coef == ent_coef


def test_the_loss_of_c_chain_has_the_raised_bonus():
    """In both forms, and wherever the callback stands: λ follows from it."""
    coefs = []
    for form, callbacks in (("CChainPPO", []), ("PPO", [0]), ("PPO", [1])):
        given = [TaskSignal(switch_at=[16]), EntropyBonusRestart(5.0, n_steps=10**9)]
        for position in callbacks:
            given.insert(2 * position, CChainCallback(churn_warmup=1))
        settings = dict(churn_warmup=1) if form == "CChainPPO" else {}
        model = make_model(form, CountEnv(), ent_coef=0.1, **settings).learn(64, given)
        coefs.append(model.logger.name_to_value["churn/coef"])
    assert coefs[0] == coefs[1] == coefs[2] > 0


@pytest.mark.parametrize(
    "make, model, message",
    [
        (ExplorationRateRestart, lambda: make_model("PPO", CountEnv()), "ExplorationRateRestart is for DQN, got PPO"),
        (LogStdRestart, lambda: make_model("PPO", CountEnv()), r"Box actions, got PPO with Discrete\(2\)"),
        (EntropyBonusRestart, lambda: SAC("MlpPolicy", "Pendulum-v1"), "EntropyBonusRestart is for PPO and A2C, got SAC"),
        (EntropyBonusRestart, lambda: OwnTrustRegion("MlpPolicy", "CartPole-v1"), "PPO and A2C, got OwnTrustRegion"),
    ],
)
def test_other_algorithms_are_refused(make, model, message):
    with pytest.raises(TypeError, match=message):
        model().learn(8, [TaskSignal(), make()])


def test_an_entropy_bonus_that_would_not_rise_is_refused():
    with pytest.raises(ValueError, match=r"give one above the model's own, 0\.1; got 0\.1"):
        make_model("PPO", CountEnv(), ent_coef=0.1).learn(8, [TaskSignal(), EntropyBonusRestart(0.1)])


@pytest.mark.parametrize(
    "make, name, value",
    [
        (ExplorationRateRestart, "initial_eps", 1.5),
        (ExplorationRateRestart, "final_eps", -0.1),
        (ExplorationRateRestart, "n_steps", 0),
        (LogStdRestart, "log_std", "0"),
        (EntropyBonusRestart, "ent_coef", -1),
        (EntropyBonusRestart, "n_steps", 1.5),
    ],
)
def test_bad_arguments(make, name, value):
    with pytest.raises(ValueError, match=f"`{name}` must be .*, got {value!r}"):
        make(**{name: value})


def test_means_stay():
    model = PPO("MlpPolicy", RandomEnv(action_space=BOX), n_steps=16, batch_size=8, device="cpu", seed=0)
    spy = Spy(lambda model: model.policy.predict_values(th.zeros(1, 4)).item())
    restart = LogStdRestart()
    model.learn(32, [TaskSignal(switch_at=[16]), spy, restart, other := Spy(spy.read)])
    assert spy.before_rollouts == other.before_rollouts


def test_the_exploration_rate_ends_where_it_is_told():
    model = make_model("DQN", CountEnv())
    model.learn(60, [TaskSignal(switch_at=[20]), ExplorationRateRestart(0.8, final_eps=0.3, n_steps=10)])
    assert model.exploration_rate == pytest.approx(0.3)
