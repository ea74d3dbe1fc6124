"""Schedules that go on from one call of learn() to the next."""

import warnings

import pytest
import torch as th
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule

from sb3_cchain import CChainPPO, ContinualMetrics, DoubleDQN, TaskSignal, TrainingCheckpoint, resume
from sb3_cchain.callbacks import OverallSchedule, TaskSchedule
from sb3_cchain.callbacks.replaced_methods import wrapped
from sb3_cchain.callbacks.training_hooks import TrainingHooks
from sb3_cchain.methods import ExplorationRateRestart
from tests.envs import CountEnv
from tests.method_models import OFF_POLICY, ON_POLICY

LINEAR = LinearSchedule(1e-3, 0.0, 1.0)


def make(cls, **kwargs):
    settings = ON_POLICY if issubclass(cls, PPO) else OFF_POLICY
    env = "Pendulum-v1" if cls is SAC else CountEnv()
    settings = {**settings, "policy_kwargs": dict(net_arch=[8])}  # of its own: SAC writes into it
    return cls("MlpPolicy", env, **{"seed": 0, "device": "cpu", "learning_rate": LINEAR, **settings, **kwargs})


class Rates(BaseCallback):
    """The learning rate of each train(), by the step after which it was made."""

    def __init__(self):
        super().__init__()
        self.rates = {}

    def _on_rollout_start(self):
        self._look()

    def _on_training_end(self):
        self._look()

    def _look(self):
        if self.model._n_updates > 0:
            self.rates[self.num_timesteps] = self.model.policy.optimizer.param_groups[0]["lr"]

    def _on_step(self):
        return True


def rates_of(model, callback, chunks):
    rates = Rates()
    for steps in chunks:
        model.learn(steps, callback=[callback, rates], reset_num_timesteps=False)
    return rates.rates


@pytest.mark.parametrize("cls", [PPO, CChainPPO, DQN, SAC])
def test_chunks_are_equal_to_one_training(cls):
    whole = make(cls).learn(64)
    parts = make(cls)
    for steps in (32, 16, 16):
        parts.learn(steps, callback=OverallSchedule(64), reset_num_timesteps=False)
    for one, other in zip(whole.policy.parameters(), parts.policy.parameters(), strict=True):
        assert th.equal(one, other)
    assert whole._current_progress_remaining == parts._current_progress_remaining == 0
    assert getattr(whole, "exploration_rate", 0) == getattr(parts, "exploration_rate", 0)


def test_the_rates_of_chunks():
    """By hand: 1e-3 times the share of 64 steps that remains."""
    assert rates_of(make(PPO), OverallSchedule(64), [32, 32]) == pytest.approx({16: 7.5e-4, 32: 5e-4, 48: 2.5e-4, 64: 0})


@pytest.mark.parametrize("chunks", [[96], [32, 64], [48, 48]])
def test_each_task_begins_its_schedule_again(chunks):
    model, rates = make(PPO), Rates()
    for steps in chunks:
        callbacks = [TaskSignal(switch_at=[48]), TaskSchedule(32), rates]
        model.learn(steps, callback=callbacks, reset_num_timesteps=False)
    # The first task lasts for 48 steps, of which the last 16 are after the end of the schedule
    assert rates.rates == pytest.approx({16: 5e-4, 32: 0, 48: 0, 64: 5e-4, 80: 0, 96: 0})


def test_another_training_begins_its_first_task_again():
    model = make(PPO)
    for _ in range(2):
        rates = Rates()
        model.learn(64, [TaskSignal(switch_at=[48]), TaskSchedule(32), rates])
        rates.rates.pop(0, None)  # of the training before
        assert rates.rates == pytest.approx({16: 5e-4, 32: 0, 48: 0, 64: 5e-4})


def test_exploration_begins_again_with_the_task():
    model, rates = make(DQN, exploration_fraction=0.5), []

    class Spy(BaseCallback):
        def _on_step(self):
            rates.append(self.model.exploration_rate)
            return True

    model.learn(42, [TaskSignal(switch_every=40), TaskSchedule(40), Spy()])
    assert rates[11] == pytest.approx(1 - 0.95 * 11 / 20) and rates[39] == 0.05
    assert rates[41] == pytest.approx(1 - 0.95 * 1 / 20)


@pytest.mark.parametrize("cls", [PPO, DQN])
def test_saved_in_the_middle_and_loaded(tmp_path, cls):
    model = make(cls)

    class Save(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 32:
                self.model.save(tmp_path / "model")
            return True

    model.learn(48, [OverallSchedule(96), Save()])
    assert "_update_current_progress_remaining" not in vars(model) and "_excluded_save_params" not in vars(model)
    loaded = cls.load(tmp_path / "model", env=CountEnv(), device="cpu")
    assert "_update_current_progress_remaining" not in vars(loaded) and "_excluded_save_params" not in vars(loaded)
    loaded.learn(16, OverallSchedule(96), reset_num_timesteps=False)
    assert loaded._current_progress_remaining == 0.5


def test_beside_another_callback_that_watches_the_model(tmp_path):
    class SaveAtTheEnd(BaseCallback):
        def _on_step(self):
            return True

        def _on_training_end(self):
            self.model.save(tmp_path / "model")

    model = make(DQN)
    model.learn(48, [OverallSchedule(96), SaveAtTheEnd(), TaskSignal(switch_at=[16]), ExplorationRateRestart()])
    replaced = {"_update_current_progress_remaining", "_on_step", "_excluded_save_params"}
    assert not replaced & vars(model).keys() and not replaced & vars(DQN.load(tmp_path / "model", device="cpu")).keys()


class WrapAsUsersDo(BaseCallback):
    def _on_training_start(self):
        step = self.model._on_step
        self.model._on_step = lambda: step()

    def _on_step(self):
        return True


@pytest.mark.parametrize("is_last", [False, True])
def test_beside_a_callback_that_replaces_the_method_by_hand(is_last):
    model, callbacks = make(DQN), [TaskSignal(switch_at=[16]), ExplorationRateRestart(), WrapAsUsersDo()]
    model.learn(48, callbacks if is_last else [callbacks[2], *callbacks[:2]])
    assert model.num_timesteps == 48 and model._n_calls == 48


def wrapper(order, name):
    return lambda call: (order.append(name), call())[1]


def test_the_last_wrapper_comes_first_and_the_innermost_one_last():
    class Owner:
        def method(self):
            order.append("method")

    owner, order = Owner(), []
    with (
        wrapped(owner, "method", wrapper(order, "first")),
        wrapped(owner, "method", wrapper(order, "second")),
        wrapped(owner, "method", wrapper(order, "innermost"), innermost=True),
    ):
        owner.method()
    assert order == ["second", "first", "innermost", "method"] and vars(owner) == {}


def test_what_the_user_puts_in_the_place_of_a_method_stays():
    model = make(PPO)
    with wrapped(model, "get_vec_normalize_env", lambda call: call()):
        model.get_vec_normalize_env = own = lambda: None
    assert model.get_vec_normalize_env is own


def test_two_that_watch_the_same_method():
    model, seen = make(PPO), []
    first, second = TrainingHooks(), TrainingHooks()
    model.get_vec_normalize_env = own = lambda: None  # the user's
    for name, hooks in (("first", first), ("second", second)):
        hooks.begin(model)
        hooks.after_call(model, "get_vec_normalize_env", lambda _, name=name: seen.append(name))
    model.get_vec_normalize_env()
    first.remove()
    model.get_vec_normalize_env()
    assert seen == ["first", "second", "second"]
    second.remove()
    assert model.get_vec_normalize_env is own


@pytest.mark.parametrize("make_schedule", [lambda: OverallSchedule(128), lambda: TaskSchedule(24)])
def test_resumed_exactly(tmp_path, make_schedule):
    def callbacks(folder):
        return [TaskSignal(switch_at=[16]), make_schedule(), TrainingCheckpoint(32, folder, keep=9)]

    whole = make(PPO).learn(64, callbacks(tmp_path / "whole"))
    (checkpoint,) = (tmp_path / "whole").glob("step_*32")
    resumed = resume(checkpoint, CountEnv(), callbacks(tmp_path / "resumed"), device="cpu")
    assert resumed.num_timesteps == 64 and resumed._current_progress_remaining == whole._current_progress_remaining
    for one, other in zip(whole.policy.parameters(), resumed.policy.parameters(), strict=True):
        assert th.equal(one, other)


def test_an_interrupted_training_leaves_nothing():
    class Stop(BaseCallback):
        def _on_step(self):
            raise KeyboardInterrupt

    model = make(PPO)
    with pytest.raises(KeyboardInterrupt):
        model.learn(32, [OverallSchedule(1000), Stop()])
    model.learn(32)
    assert model._current_progress_remaining == 0 and "_update_current_progress_remaining" not in vars(model)


def test_training_beyond_the_end_is_warned_of():
    # A schedule that does not stay at 0 by itself
    model = make(PPO, learning_rate=lambda left: 1e-3 * left)
    with pytest.warns(UserWarning, match=r"trains up to step 48, but OverallSchedule has `total_timesteps=32`"):
        assert rates_of(model, OverallSchedule(32), [48])[48] == 0
    assert model._current_progress_remaining == 0


@pytest.mark.parametrize("value", [0, -1, 1.5, "1e6", None])
def test_bad_lengths(value):
    for cls, name in ((OverallSchedule, "total_timesteps"), (TaskSchedule, "steps_per_task")):
        with pytest.raises(ValueError, match=f"`{name}` must be an integer greater than or equal to 1, got {value!r}"):
            cls(value)


@pytest.mark.parametrize("cls", [CChainPPO, DoubleDQN])
def test_a_schedule_that_is_at_0_too_early_warns_once(cls):
    schedule = LinearSchedule(1e-3, 0.0, 0.25)
    model = make(cls, learning_rate=schedule)
    with pytest.warns(UserWarning, match="learning rate is 0 from step 32 on") as caught:
        model.learn(128)
    # There may be others: files that earlier tests left open are closed at any time
    assert sum("learning rate" in str(warning.message) for warning in caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make(cls).learn(64, OverallSchedule(64))


@pytest.mark.parametrize("second", [lambda: OverallSchedule(128), lambda: TaskSchedule(64)])
def test_one_callback_moves_schedules(second):
    model = PPO("MlpPolicy", "CartPole-v1", n_steps=32, batch_size=32, device="cpu")
    with pytest.raises(ValueError, match="was given OverallSchedule and "):
        model.learn(64, [TaskSignal(switch_every=64), OverallSchedule(128), second()])


@pytest.mark.parametrize(
    "learning_rate, schedule, warned",
    [
        (LinearSchedule(1e-3, 0.0, 1.0), [], True),
        (LinearSchedule(1e-3, 0.0, 1.0), [OverallSchedule], False),
        (1e-3, [], False),
    ],
)
def test_stock_models_are_warned_of_schedules_that_end_in_each_call(learning_rate, schedule, warned):
    model = PPO("MlpPolicy", "CartPole-v1", learning_rate=learning_rate, n_steps=32, batch_size=32, device="cpu")
    for call in range(2):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            model.learn(64, [TaskSignal(), ContinualMetrics(), *(kind(256) for kind in schedule)], reset_num_timesteps=False)
        found = [warning for warning in caught if "goes to 0 within each" in str(warning.message)]
        assert len(found) == (1 if warned and call == 1 else 0)
