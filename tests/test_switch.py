"""The clock that says which task is due, and the signal that it has switched."""

import warnings
from functools import partial

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from sb3_cchain import CChainCallback, CChainPPO, ContinualMetrics, TaskSync
from sb3_cchain.callbacks import TaskLearningStarts
from sb3_cchain.methods import Oracle
from sb3_cchain.tasks.clock import TaskClock
from sb3_cchain.tasks.signal import TaskSwitch
from tests.envs import CountEnv
from tests.method_models import ALGORITHMS, make_env, make_model

SETTINGS = dict(n_steps=16, batch_size=8, n_epochs=1, device="cpu", seed=0)


def test_the_clock_counts_the_steps_of_all_environments():
    clock, due = TaskClock([4, 2, 4], n_envs=2), []
    for _ in range(5):
        due.append(clock.due_task)
        clock.advance()
    assert due == [0, 0, 1, 2, 2]
    assert clock.due_task == 2  # the last task goes on
    assert clock.task_id == 0 and clock.is_over
    assert clock.begin() and clock.task_id == 2
    assert not clock.is_over and not clock.begin()


def test_the_clock_begins_with_the_first_task():
    clock = TaskClock([4, 2, 4], first_task=1)
    assert (clock.task_id, clock.due_task, clock.first_task) == (1, 1, 1)
    clock.advance()
    assert clock.n_steps == 1
    clock.set(2)
    assert clock.due_task == 2


def test_a_pinned_clock_stays_until_it_is_set():
    clock = TaskClock([4, 4])
    clock.pin(1)
    assert clock.due_task == 1 and not clock.is_over
    clock.set(0)
    assert clock.due_task == 0


def test_setting_the_time_keeps_the_number_of_environments():
    clock = TaskClock([4, 4], n_envs=4)
    clock.set(0)
    clock.advance()
    assert clock.due_task == 1


@pytest.mark.parametrize(
    "first, second, switched", [(0, 0, False), (0, 1, True), ("a", "a", False), ("a", "b", True), (None, 3, False)]
)
def test_a_listener_hears_of_a_switch_once(first, second, switched):
    switch = TaskSwitch(first)
    assert switch.happened(second) == switched
    assert not switch.happened(second)


def test_tasks_may_be_numbered_by_arrays():
    switch = TaskSwitch(np.array([1, 0]))
    assert not switch.happened(np.array([1, 0]))
    assert switch.happened(np.array([0, 1]))


@pytest.mark.parametrize("as_callback", [False, True])
@pytest.mark.parametrize("reset", [False, True])
def test_another_environment_resets_the_coefficient(as_callback, reset):
    arguments = dict(churn_warmup=0, reset_churn_coef=reset)
    if as_callback:
        callback = CChainCallback(**arguments)
        model = PPO("MlpPolicy", CountEnv(), **SETTINGS)
    else:
        callback, model = None, CChainPPO("MlpPolicy", CountEnv(), **arguments, **SETTINGS)
    worlds, n_seen = [CountEnv(), CountEnv(1)], []
    for world in (worlds[0], worlds[0], worlds[1]):
        model.set_env(world)
        model.learn(32, callback=callback, reset_num_timesteps=False)
        n_seen.append(int((callback or model).churn_reducer.coefficient.n_seen))
    assert n_seen == [2, 4, 2 if reset else 6]


@pytest.mark.parametrize("make", [CChainCallback, partial(CChainPPO, "MlpPolicy", "CartPole-v1")])
def test_the_reset_of_the_coefficient_is_a_boolean(make):
    for value in ("False", 0, None):
        with pytest.raises(TypeError, match=f"`reset_churn_coef` must be True or False, got {value!r}"):
            make(reset_churn_coef=value)


def test_an_environment_that_comes_again_is_a_new_task():
    worlds = [CountEnv(), CountEnv()]
    model, metrics = CChainPPO("MlpPolicy", worlds[0], **SETTINGS), ContinualMetrics()
    for world in (worlds[0], worlds[0], worlds[1], worlds[0]):
        model.set_env(world)
        model.learn(16, callback=metrics, reset_num_timesteps=False)
    assert list(dict.fromkeys(row["task_id"] for row in metrics.rows)) == [0, 1, 2]


FOLLOWERS = pytest.mark.parametrize(
    "algorithm, cls", [("PPO", ContinualMetrics), ("PPO", Oracle), ("DQN", TaskLearningStarts)]
)


@FOLLOWERS
def test_environments_side_by_side_without_task_sync_are_warned_of(algorithm, cls):
    envs = make_vec_env(make_env, 2)
    with pytest.warns(UserWarning, match=r"count 1 environment\(s\) side by side, but there are 2.*TaskSync"):
        make_model(algorithm, envs).learn(32, callback=cls())


@FOLLOWERS
def test_training_that_goes_on_without_task_sync_is_warned_of(tmp_path, algorithm, cls):
    make_model(algorithm).learn(40, callback=TaskSync()).save(tmp_path / "model")
    model = ALGORITHMS[algorithm].func.load(tmp_path / "model", env=make_env(), device="cpu")
    with pytest.warns(UserWarning, match=r"are at step 0, but training is at step 4\d.*TaskSync"):
        model.learn(16, callback=cls(), reset_num_timesteps=False)


@FOLLOWERS
def test_a_new_model_in_an_environment_that_goes_on_is_not_warned_of(algorithm, cls):
    env = make_env()
    make_model(algorithm, env).learn(40, callback=TaskSync())
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="The continual environments")
        make_model(algorithm, env).learn(16, callback=cls())


@FOLLOWERS
@pytest.mark.parametrize("n_envs, with_sync", [(1, False), (2, True)])
def test_environments_that_know_the_time_are_not_warned_of(algorithm, cls, n_envs, with_sync):
    model = make_model(algorithm, make_vec_env(make_env, n_envs))
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="The continual environments")
        for reset in (True, False):
            model.learn(32, callback=[cls(), *([TaskSync()] if with_sync else [])], reset_num_timesteps=reset)
