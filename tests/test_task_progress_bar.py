"""The progress bar that shows the tasks."""

import io
import sys
import time

import numpy as np
import pytest
from rich import get_console
from rich.console import Console
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_cchain import ContinualEnv, TaskSignal, TaskSync
from sb3_cchain.callbacks import TaskProgressBar
from sb3_cchain.tasks.names import task_names
from tests.envs import CountEnv
from tests.method_models import OFF_POLICY, ON_POLICY


class Named(ContinualEnv):
    """Three tasks of 32 steps, with names; their episodes of 7 steps have the returns 7, 14 and 21."""

    @property
    def task_sequence(self):
        return [("count", name) for name in ("one", "two", "three")]


def make_env(n_envs=1, **kwargs):
    tasks = [lambda reward=reward: CountEnv(reward=reward) for reward in (1.0, 2.0, 3.0)]
    return make_vec_env(lambda: Named(tasks, steps_per_task=32, **kwargs), n_envs)


def make(env, cls=PPO):
    settings = OFF_POLICY if cls is DQN else ON_POLICY
    return cls("MlpPolicy", env, seed=0, device="cpu", **{**settings, "policy_kwargs": dict(net_arch=[8])})


def shown(bar):
    console = Console(file=io.StringIO(), width=80)
    console.print(bar.render())
    return [" ".join(line.split()) for line in console.file.getvalue().splitlines()]


class Look(BaseCallback):
    """What the bar shows after some steps."""

    def __init__(self, bar, *steps):
        super().__init__()
        self.bar, self.steps, self.seen = bar, steps, {}

    def _on_step(self):
        if self.num_timesteps in self.steps:
            self.seen[self.num_timesteps] = (self.bar.describe(), shown(self.bar)[-1])
        return True


@pytest.fixture
def bar():
    bar = TaskProgressBar()
    yield bar
    bar.close()


def test_what_it_says_by_hand(bar, monkeypatch):
    now = 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    model = make(make_env())
    model.env.reset()
    bar.init_callback(model)
    bar.on_training_start({"total_timesteps": 2000}, {})

    def step(done, **info):
        bar.update_locals({"infos": [info], "dones": np.array([done])})
        bar.on_step()

    bar.on_rollout_start()
    model.num_timesteps = 10
    step(False)
    assert bar.describe() == "task 0 (1 of 3) count one, next in 22 steps (-:--:--)"
    step(True, episode_return=7.0, episode={"r": 0.1})
    step(True, episode={"r": -8.0})
    assert bar.describe() == "task 0 (1 of 3) count one, next in 22 steps (-:--:--), return -0.5"
    now = 1005.0
    bar.on_rollout_start()  # 10 steps in 5 seconds
    model.num_timesteps, now = 14, 1006.0
    assert shown(bar) == [
        "task 0 (1 of 3) count one, next in 18 steps (0:00:10), return -0.5",
        "1% 14/2,000 0:00:06 < 0:16:34, 2 steps/s",
    ]
    # The returns of a task that is over say nothing of the next one
    model.env.reset_infos[0] = {"task_id": 2}
    model.num_timesteps = 64
    step(True, episode_return=14.0)
    assert bar.describe() == "task 2 (3 of 3) count three"


@pytest.mark.parametrize("cls, n_envs", [(PPO, 1), (PPO, 2), (DQN, 1)])
def test_it_follows_the_environment(bar, cls, n_envs):
    model, look = make(make_env(n_envs), cls), Look(bar, 30, 32, 80)
    model.learn(80, callback=[TaskSync(), bar, look])
    words = {steps: words for steps, (words, _) in look.seen.items()}
    assert words[30].startswith("task 0 (1 of 3) count one, next in 2 steps (")
    assert words[32].startswith("task 1 (2 of 3) count two, next in 32 steps (") and "return" not in words[32]
    assert words[80] == "task 2 (3 of 3) count three, return 21"


def test_chunks_and_first_task(bar):
    model, look = make(make_env(first_task=1)), Look(bar, 16, 48)
    for _ in range(2):
        model.learn(32, callback=[TaskSync(), bar, look], reset_num_timesteps=False)
    (first, first_bar), (second, second_bar) = look.seen[16], look.seen[48]
    assert first.startswith("task 1 (2 of 3) count two, next in 16 steps") and " 16/32 " in first_bar
    assert second.startswith("task 2 (3 of 3) count three") and " 48/64 " in second_bar


@pytest.mark.parametrize(
    "callbacks, words",
    [
        ([], "return 7"),
        ([TaskSignal()], "task 0, return 7"),
        ([TaskSignal(switch_every=20)], "task 2, next in 12 steps (0:00:00), return 7"),
        ([TaskSignal(switch_at=[20, 60])], "task 1, next in 12 steps (0:00:00), return 7"),
        ([TaskSignal(switch_at=[20])], "task 1, return 7"),
        ([TaskSignal(switch_every=32)], "task 1, return 7"),  # another would begin at the end
    ],
    ids=["no tasks", "unknown", "every", "at", "the last", "the last of many"],
)
def test_an_environment_without_tasks(bar, callbacks, words):
    model, look = make(make_vec_env(CountEnv)), Look(bar, 48)
    model.learn(64, callback=[*callbacks, bar, look])
    assert look.seen[48][0] == words
    assert callbacks or not hasattr(model, "task_count")  # which would be saved with the model


def test_names():
    assert task_names(make_env()) == ["count one", "count two", "count three"]
    for env in ("Continual/CartPole-v1", "CartPole-v1"):  # tasks that differ in a number, and none
        assert task_names(make_vec_env(env)) == []


def test_no_steps_at_all(bar, capsys):
    make(make_env()).learn(0, callback=bar)
    assert "100% ━" in capsys.readouterr().out


def test_a_model_that_has_a_bar_can_be_saved(bar, tmp_path):
    model = make(make_env())
    model.bar = bar
    model.learn(16, callback=[TaskSync(), bar, CheckpointCallback(8, str(tmp_path))])
    assert PPO.load(tmp_path / "rl_model_8_steps").bar._live is None


class Fail(BaseCallback):
    """An error in the first rollout."""

    def _on_step(self):
        raise KeyboardInterrupt


@pytest.mark.parametrize("error_in_update", [False, True])
def test_no_bar_is_left_after_an_error(bar, monkeypatch, error_in_update):
    console = get_console()
    monkeypatch.setattr(console, "_force_terminal", True)
    stdout, model, callbacks = sys.stdout, make(make_env()), [bar]
    if error_in_update:
        monkeypatch.setattr(model, "train", lambda: 1 / 0)
    else:
        callbacks.append(Fail())
    with pytest.raises(ZeroDivisionError if error_in_update else KeyboardInterrupt):
        model.learn(64, callback=callbacks)
    end = time.monotonic() + 10
    while bar._live is not None or console._live_stack or sys.stdout is not stdout:
        assert time.monotonic() < end
        time.sleep(0.05)


def test_a_bar_that_an_error_left_gives_way_to_the_next_one_at_once(bar):
    class Shown(BaseCallback):
        def _on_step(self):
            assert get_console()._live_stack == [bar._live]
            return True

    model = make(make_env())
    with pytest.raises(KeyboardInterrupt):
        model.learn(16, callback=[TaskProgressBar(), Fail()])
    model.learn(16, callback=[bar, Shown()])


def test_a_log_file_gets_the_end_alone(bar, capsys):
    make(make_env()).learn(48, callback=[TaskSync(), bar])
    first, second = capsys.readouterr().out.splitlines()
    assert first == "task 1 (2 of 3) count two, next in 16 steps (0:00:00), return 14"
    assert second.startswith("100% ━") and " 48/48 " in second


def test_the_next_switch_in_another_task_sequence(bar):
    model = make(make_env()).learn(96, TaskSync())
    model.set_env(make_vec_env(lambda: ContinualEnv([CountEnv] * 2, 32)))
    look = Look(bar, 100)
    model.learn(64, [TaskSync(), TaskSignal(), bar, look], reset_num_timesteps=False)
    assert "next in 28 steps" in look.seen[100][0]
