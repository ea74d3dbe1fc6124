"""Continual metrics: what is logged, what is written, that nothing scales it."""

import os
import sys

import numpy as np
import pytest
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_cchain import CChainPPO, ContinualEnv, ContinualMetrics, TaskSignal, TaskSync
from sb3_cchain.callbacks import TaskLearningStarts, read_returns
from sb3_cchain.callbacks.continual_metrics import task_averages
from sb3_cchain.callbacks.returns_file import ReturnsFile
from sb3_cchain.envs import RewardScale
from sb3_cchain.methods import Oracle
from tests.envs import CountEnv
from tests.method_models import make_model
from tests.resume_cases import in_new_process

SETTINGS = dict(n_steps=16, batch_size=8, device="cpu", seed=0)


def make_env(**kwargs):
    """Three tasks of 32 steps in episodes of 8 with returns of 8, 16 and 24."""
    tasks = [lambda reward=reward: CountEnv(length=8, reward=reward) for reward in (1.0, 2.0, 3.0)]
    return ContinualEnv(tasks, 32, **kwargs)


class Spy(BaseCallback):
    """What was logged at the end of each rollout."""

    def __init__(self):
        super().__init__()
        self.logged = []

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        values = self.logger.name_to_value
        self.logged.append({key.removeprefix("continual/"): values[key] for key in values if key.startswith("continual/")})


def test_by_hand(tmp_path):
    spy = Spy()
    model = CChainPPO("MlpPolicy", make_env(), **SETTINGS)
    model.set_logger(configure(str(tmp_path), []))
    model.learn(96, callback=spy)
    assert [row["task_id"] for row in spy.logged] == [0, 0, 1, 1, 2, 2]
    assert [row["n_switches"] for row in spy.logged] == [0, 0, 1, 1, 2, 2]
    assert [row["mean_return"] for row in spy.logged] == [8, 8, 16, 16, 24, 24]
    assert [row["reward_per_step"] for row in spy.logged] == [1, 1, 2, 2, 3, 3]
    # J(T) so far: mean over the tasks
    assert [row["average_performance"] for row in spy.logged] == pytest.approx([8, 8, 12, 12, 16, 16])
    assert [spy.logged[2 * task + 1][f"average_task_{task}"] for task in range(3)] == [8, 16, 24]
    assert (tmp_path / "returns.csv").read_text().splitlines() == [
        "timesteps,task_id,n_episodes,mean_return",
        *("16,0,2,8.0", "32,0,2,8.0", "48,1,2,16.0", "64,1,2,16.0", "80,2,2,24.0", "96,2,2,24.0"),
    ]


def test_neither_scaling_nor_normalisation_touches_the_returns(tmp_path):
    def scaled():
        return RewardScale(make_env(), 0.05)

    path = tmp_path / "folder" / "r.csv"
    env = VecNormalize(make_vec_env(scaled, n_envs=2, wrapper_class=RewardScale, wrapper_kwargs=dict(scale=3.0)))
    PPO("MlpPolicy", env, **SETTINGS).learn(96, callback=[TaskSync(), ContinualMetrics(path)])
    # Two environments: 16 of the 32 steps of a task each
    assert [(row["timesteps"], row["task_id"], row["n_episodes"], row["mean_return"]) for row in read_returns(path)] == [
        (32, 0, 4, 8.0),
        (64, 1, 4, 16.0),
        (96, 2, 4, 24.0),
    ]


def test_a_rollout_across_a_switch_has_a_row_for_each_task(tmp_path):
    path = tmp_path / "returns.csv"
    CChainPPO("MlpPolicy", make_env(), n_steps=48, batch_size=8, device="cpu").learn(96, callback=ContinualMetrics(path))
    assert path.read_text().splitlines()[1:] == ["48,0,4,8.0", "48,1,2,16.0", "96,1,2,16.0", "96,2,4,24.0"]


def test_resumed_training_continues_the_file(tmp_path):
    path = tmp_path / "returns.csv"
    spy = Spy()
    model = CChainPPO("MlpPolicy", make_env(), **SETTINGS).learn(48, callback=ContinualMetrics(path))
    model.save(tmp_path / "model")
    model.learn(16, callback=ContinualMetrics(path), reset_num_timesteps=False)  # lost: not saved
    loaded = CChainPPO.load(tmp_path / "model", env=make_env(), device="cpu")
    loaded.learn(48, callback=[ContinualMetrics(path), spy], reset_num_timesteps=False)
    assert [row["timesteps"] for row in read_returns(path)] == [16, 32, 48, 64, 80, 96]
    assert spy.logged[-1]["average_performance"] == 16
    assert [row["n_switches"] for row in spy.logged] == [1, 2, 2]
    # From 0 again it is a new file
    loaded.learn(16, callback=ContinualMetrics(path))
    assert [row["timesteps"] for row in read_returns(path)] == [16]
    # and the old one is kept
    assert [row["timesteps"] for row in read_returns(tmp_path / "returns.csv.1")] == [16, 32, 48, 64, 80, 96]
    loaded.learn(16, callback=ContinualMetrics(path))
    assert [row["timesteps"] for row in read_returns(tmp_path / "returns.csv.2")] == [16]


HEADER = "timesteps,task_id,n_episodes,mean_return\r\n"


@pytest.mark.parametrize(
    "text, message",
    [
        ("name,price\r\nscrews,3\r\n", "is not a file of returns: its first line must be .* got 'name,price"),
        (HEADER + "16,0,2,8.0\r\n32,0,2,1", "is damaged: line 3 .* got '32,0,2,1'"),  # of 16.0
        (HEADER + "16,0,2,8.0\r\n32,0", "is damaged: line 3"),
        (HEADER + "16,zero,2,8.0\r\n", "is damaged: line 2"),
    ],
)
def test_a_foreign_or_torn_file_is_refused_before_training(tmp_path, text, message):
    path = tmp_path / "returns.csv"
    with open(path, "w", newline="") as file:
        file.write(text)
    model = PPO("MlpPolicy", make_env(), **SETTINGS)
    model.num_timesteps = 48  # resumed, without returns of its own
    with pytest.raises(ValueError, match=message):
        model.learn(16, callback=[TaskSync(), ContinualMetrics(path)], reset_num_timesteps=False)
    assert model.num_timesteps == 48
    assert path.read_bytes() == text.encode()


def test_a_fresh_run_does_not_touch_a_foreign_file(tmp_path):
    path = tmp_path / "shopping.csv"
    path.write_text("name,price\nscrews,3\n")
    with pytest.raises(ValueError, match="is not a file of returns"):
        CChainPPO("MlpPolicy", make_env(), **SETTINGS).learn(16, callback=ContinualMetrics(path))
    assert path.read_text() == "name,price\nscrews,3\n"


def write_returns(path):
    """For another process, which ends while the file is open."""
    try:
        OPEN.append(ReturnsFile(path, [], keep_old=True))
        return "open"
    except ValueError as error:
        return str(error)


OPEN = []


@pytest.mark.skipif(sys.platform == "win32", reason="files are not locked there")
def test_two_processes_cannot_write_one_file(tmp_path):
    path, heard = tmp_path / "returns.csv", []

    class Meanwhile(Spy):
        def _on_step(self):
            if self.n_calls == 1:
                heard.append(in_new_process(write_returns, path))
            return True

    model = CChainPPO("MlpPolicy", make_env(), **SETTINGS)
    model.learn(16, callback=[ContinualMetrics(path), Meanwhile()])
    assert heard[0].startswith(f"Another process is writing {path}") and len(read_returns(path)) == 1
    assert in_new_process(write_returns, path) == "open"
    model.learn(16, callback=ContinualMetrics(path))  # it has ended
    assert len(read_returns(path)) == 1


class Interrupt(BaseCallback):
    def _on_step(self):
        if self.num_timesteps == 20:
            raise KeyboardInterrupt
        return True


def test_the_file_of_interrupted_training_can_be_written_again(tmp_path):
    model, metrics = CChainPPO("MlpPolicy", make_env(), **SETTINGS), ContinualMetrics(tmp_path / "returns.csv")
    with pytest.raises(KeyboardInterrupt):
        model.learn(32, callback=[metrics, Interrupt()])
    model.learn(32, callback=ContinualMetrics(metrics.path))
    assert [row["timesteps"] for row in read_returns(metrics.path)] == [16, 32]


# --- Episodes that never end ----------------------------------------------------------------------------------------------


def never_ending(reward=1.0):
    return CountEnv(length=10**9, reward=reward)


def test_the_reward_per_step_is_the_return_of_a_task_without_ends(tmp_path):
    """The middle task's episodes end."""
    path = tmp_path / "returns.csv"
    tasks = [never_ending, lambda: CountEnv(length=8, reward=2.0), lambda: never_ending(3.0)]
    model, spy = CChainPPO("MlpPolicy", ContinualEnv(tasks, 32), **SETTINGS), Spy()
    model.learn(80, callback=[ContinualMetrics(path), spy])
    assert [row["reward_per_step"] for row in spy.logged] == [1, 1, 2, 2, 3]
    finished = ["48,1,2,16.0", "64,1,2,16.0"]
    assert path.read_text().splitlines()[1:] == ["32,0,0,1.0", *finished, "80,2,0,3.0"]
    # A task that goes on has one row
    model.save(tmp_path / "model")
    loaded = CChainPPO.load(tmp_path / "model", env=ContinualEnv(tasks, 32), device="cpu")
    loaded.learn(16, callback=ContinualMetrics(path), reset_num_timesteps=False)
    assert path.read_text().splitlines()[1:] == ["32,0,0,1.0", *finished, "96,2,0,3.0"]


class BackAgain(CountEnv):
    """Tasks 0, 1 and 0 again, of 32 steps each. From then on no episode ends."""

    n_steps_so_far = 0

    def step(self, action):
        self.n_steps_so_far += 1
        observation, reward, is_end, *_ = super().step(action)
        task_id = (self.n_steps_so_far - 1) // 32
        return observation, reward, is_end and task_id < 2, False, {"task_id": task_id % 2}


def test_a_task_that_comes_again_keeps_the_rows_of_its_first_visit(tmp_path):
    path, model = tmp_path / "returns.csv", PPO("MlpPolicy", BackAgain(length=8), **SETTINGS)
    first_visits = ["16,0,2,8.0", "32,0,2,8.0", "48,1,2,8.0", "64,1,2,8.0"]
    for n_steps, end in ((80, 80), (16, 96)):
        metrics = ContinualMetrics(path)
        model.learn(n_steps, metrics, reset_num_timesteps=False)
        metrics.on_training_end()  # as RL Zoo does once more
        assert path.read_text().splitlines()[1:] == [*first_visits, f"{end},0,0,1.0"]
    assert len(model.continual_returns) == 5


class AlwaysEnds(BackAgain):
    """The episodes of the second visit end, too."""

    def step(self, action):
        observation, reward, _, _, info = super().step(action)
        return observation, reward, self.n_steps >= self.length, False, info


def test_a_task_that_comes_again_has_its_row_after_that_of_the_task_before(tmp_path):
    # The third rollout is of steps 48 to 72, with the switch from 1 to 0 at 64
    path = tmp_path / "returns.csv"
    PPO("MlpPolicy", AlwaysEnds(length=8), **{**SETTINGS, "n_steps": 24}).learn(72, ContinualMetrics(path))
    assert [(row["timesteps"], row["task_id"]) for row in read_returns(path)] == [(24, 0), (48, 0), (48, 1), (72, 1), (72, 0)]


def test_an_episode_that_a_switch_cuts_counts_where_others_ended(tmp_path):
    path = tmp_path / "returns.csv"
    env = ContinualEnv([lambda: CountEnv(length=10)] * 2, 16)
    CChainPPO("MlpPolicy", env, **SETTINGS).learn(16, callback=ContinualMetrics(path))
    assert path.read_text().splitlines()[1:] == ["16,0,2,8.0"]  # of 10 and 6


class TruncatedEnv(CountEnv):
    """Episodes end by a limit of 8 steps. The info of a step has the number of the task, that of a reset has not."""

    n_steps_so_far = 0

    def step(self, action):
        observation, reward, end = super().step(action)[:3]
        self.n_steps_so_far += 1
        return observation, reward, False, end, {"task_id": (self.n_steps_so_far - 1) // 16}


@pytest.mark.parametrize("callbacks", [[], [TaskSignal()]])
def test_an_episode_that_a_limit_ends_was_not_cut_by_a_switch(callbacks):
    metrics = ContinualMetrics()
    PPO("MlpPolicy", TruncatedEnv(length=8), **SETTINGS).learn(48, [*callbacks, metrics])
    assert [(row["task_id"], row["n_episodes"], row["mean_return"]) for row in metrics.rows] == [(i, 2, 8) for i in range(3)]


def test_a_limit_that_falls_on_a_switch_is_an_end():
    metrics, env = ContinualMetrics(), make_vec_env(lambda: TruncatedEnv(length=8), 2)
    PPO("MlpPolicy", env, **SETTINGS).learn(32, [TaskSignal(switch_every=16), metrics])
    assert [(row["task_id"], row["n_episodes"], row["mean_return"]) for row in metrics.rows] == [(0, 2, 8), (1, 2, 8)]


def test_a_switch_within_an_episode_that_does_not_end(tmp_path):
    metrics = ContinualMetrics(tmp_path / "r.csv")
    model = PPO("MlpPolicy", CountEnv(length=10**6, reward=3.0), **SETTINGS)
    model.learn(48, [TaskSignal(switch_at=[16, 24]), metrics])
    assert [tuple(row.values()) for row in metrics.rows] == [(32, 0, 0, 3), (32, 1, 0, 3), (48, 2, 0, 3)]
    # The row of a task that another environment ended is written once
    model.set_env(CountEnv(length=10**6))
    model.learn(16, [TaskSignal(switch_at=[16, 24]), metrics], reset_num_timesteps=False)
    assert [row["task_id"] for row in read_returns(tmp_path / "r.csv")] == [0, 1, 2, 3]


@pytest.mark.parametrize("algorithm", ["PPO", "DQN"])
def test_an_episode_that_goes_on_over_calls_of_learn_is_whole(algorithm):
    model = make_model(algorithm, DummyVecEnv([lambda: CountEnv(length=24)]))
    for _ in range(3):
        metrics = ContinualMetrics()
        model.learn(16, metrics, reset_num_timesteps=False)
    assert [row["mean_return"] for row in metrics.rows] == [24, 24]


@pytest.mark.parametrize("algorithm", ["PPO", "DQN"])
def test_an_environment_that_was_reset_has_a_new_episode(algorithm):
    env = DummyVecEnv([lambda: CountEnv(length=20)])
    metrics, model = ContinualMetrics(), make_model(algorithm, env)
    model.learn(16, metrics)
    model.set_env(env)
    model.learn(24, metrics, reset_num_timesteps=False)
    assert [row["mean_return"] for row in metrics.rows if row["n_episodes"]] == [20.0]


def test_the_return_of_a_monitor_is_taken():
    """Which also knows of a reset that is not at the end of an episode."""

    class ResetByHand(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 10:
                self.training_env.envs[0].reset()
            return True

    metrics = ContinualMetrics()
    PPO("MlpPolicy", CountEnv(length=20), **SETTINGS).learn(32, [metrics, ResetByHand()])
    assert [row["mean_return"] for row in metrics.rows if row["n_episodes"]] == [20.0]


def test_steps_of_all_environments_count():
    metrics = ContinualMetrics()
    PPO("MlpPolicy", make_vec_env(never_ending, 2), **SETTINGS).learn(32, metrics)
    assert [row["mean_return"] for row in metrics.rows] == [1.0]


def test_rows_that_were_lost_come_again(tmp_path):
    """After a save, of which the file of a killed training has more."""
    model = PPO("MlpPolicy", make_env(), **SETTINGS).learn(32, [TaskSync(), ContinualMetrics()])
    model.continual_returns.append({"timesteps": 48, "task_id": 1, "n_episodes": 2, "mean_return": -1.0})
    model.learn(32, [TaskSync(), ContinualMetrics()], reset_num_timesteps=False)
    assert [(row["timesteps"], row["mean_return"]) for row in model.continual_returns] == [
        (16, 8),
        (32, 8),
        (48, 16),
        (64, 16),
    ]


def test_reward_per_step_is_of_one_rollout():
    spy = Spy()
    CChainPPO("MlpPolicy", ContinualEnv([lambda: Rising(length=16)] * 2, 64), **SETTINGS).learn(48, spy)
    assert [row["reward_per_step"] for row in spy.logged] == [1, 2, 3]


def test_the_file_is_as_it_was_when_training_goes_on(tmp_path):
    row = {"timesteps": 8, "task_id": 0, "n_episodes": 1, "mean_return": 3.0}
    file = ReturnsFile(tmp_path / "r.csv", [row], keep_old=False)
    state = file.state_dict()
    file.append([row])
    file.load_state_dict(state)
    file.close()
    assert read_returns(tmp_path / "r.csv") == [row]


def test_one_environment_after_the_other(tmp_path):
    path, spy = tmp_path / "returns.csv", Spy()
    worlds = [never_ending(), CountEnv(length=8, reward=2.0), VecNormalize(make_vec_env(never_ending))]
    model = PPO("MlpPolicy", worlds[0], **SETTINGS)
    for world in worlds:
        model.set_env(world)
        for _ in range(2):
            model.learn(16, callback=[ContinualMetrics(path), spy], reset_num_timesteps=False)
    assert [row["task_id"] for row in spy.logged] == [row["n_switches"] for row in spy.logged] == [0, 0, 1, 1, 2, 2]
    assert [row["reward_per_step"] for row in spy.logged] == [1, 1, 2, 2, 1, 1]
    rows = ["32,0,0,1.0", "48,1,2,16.0", "64,1,2,16.0", "96,2,0,1.0"]
    assert path.read_text().splitlines()[1:] == rows


@pytest.mark.parametrize("algorithm, kwargs", [(A2C, dict(n_steps=16)), (DQN, dict(learning_starts=1000))])
def test_any_algorithm(tmp_path, algorithm, kwargs):
    path = tmp_path / "returns.csv"
    model = algorithm("MlpPolicy", make_env(), device="cpu", **kwargs)
    model.learn(96, callback=[TaskSync(), ContinualMetrics(path)])
    rows = read_returns(path)
    assert [row["task_id"] for row in rows] == sorted(row["task_id"] for row in rows)
    assert sum(row["n_episodes"] for row in rows) == 12
    assert np.mean([row["mean_return"] for row in rows]) == 16


def test_tensorboard_and_default_place_of_the_file(tmp_path):
    CChainPPO("MlpPolicy", make_env(), tensorboard_log=str(tmp_path), **SETTINGS).learn(32)
    assert len(read_returns(tmp_path / "CChainPPO_1" / "returns.csv")) == 2


def test_history_goes_on_over_several_calls_of_learn(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))  # where SB3's logger goes when it has no folder
    model, spy = CChainPPO("MlpPolicy", make_env(), **SETTINGS), Spy()
    for _ in range(3):
        model.learn(32, callback=spy, reset_num_timesteps=False)
    assert [row["average_performance"] for row in spy.logged] == [8, 8, 12, 12, 16, 16]
    assert [row["n_switches"] for row in spy.logged] == [0, 0, 1, 1, 2, 2]
    assert not list(tmp_path.rglob("returns.csv"))
    model.save(tmp_path / "model")
    assert CChainPPO.load(tmp_path / "model", device="cpu").continual_returns == model.continual_returns


@pytest.mark.parametrize("path", [3, 1.5, b"returns.csv", ["returns.csv"]])
def test_a_path_that_is_none(path):
    with pytest.raises(TypeError, match=r"`path` must be a path, got "):
        ContinualMetrics(path)


def test_a_path_that_is_a_folder(tmp_path):
    with pytest.raises(ValueError, match=r"must be a file, but .* is a folder"):
        make_model("PPO").learn(16, callback=[TaskSync(), ContinualMetrics(tmp_path)])


@pytest.mark.parametrize("algorithm, cls", [("PPO", ContinualMetrics), ("PPO", Oracle), ("DQN", TaskLearningStarts)])
def test_a_callback_that_is_given_twice(algorithm, cls):
    model = make_model(algorithm)
    with pytest.raises(ValueError, match=rf"`learn\(\)` was given 2 callbacks {cls.__name__}: give it one"):
        model.learn(16, callback=[TaskSync(), cls(), CallbackList([cls()])])
    assert model.num_timesteps == 0


def test_a_file_is_locked_while_it_is_moved_aside(tmp_path, monkeypatch):
    fcntl = pytest.importorskip("fcntl")
    path, rename, moved = tmp_path / "returns.csv", os.rename, []
    row = dict(timesteps=1, task_id=0, n_episodes=1, mean_return=0.0)
    ReturnsFile(path, [row], keep_old=True).close()

    def rename_locked(old, new):
        with open(old) as other, pytest.raises(BlockingIOError):
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        moved.append(new.name)
        rename(old, new)

    monkeypatch.setattr(os, "rename", rename_locked)
    file = ReturnsFile(path, [], keep_old=True)
    file.append([row])
    file.close()
    assert moved == ["returns.csv.1"] and read_returns(path) == read_returns(tmp_path / "returns.csv.1") == [row]


class Rising(CountEnv):
    n_episodes = 0

    def reset(self, **kwargs):
        self.n_episodes += 1
        self.task_reward = float(self.n_episodes)
        return super().reset(**kwargs)


def test_averages_of_returns_that_differ():
    spy = Spy()
    env = ContinualEnv([lambda: Rising(length=8)] * 2, 64)
    model = CChainPPO("MlpPolicy", env, n_steps=16, batch_size=8, seed=0, device="cpu")
    for n_steps in (16, 16, 64):  # goes on within the first task
        model.learn(n_steps, spy, reset_num_timesteps=False)
    averages = task_averages(model.continual_returns)
    assert spy.logged[3]["average_task_0"] == pytest.approx(averages[0])
    assert spy.logged[-1]["average_task_1"] == pytest.approx(averages[1])
    assert spy.logged[-1]["average_performance"] == pytest.approx(np.mean(list(averages.values())))


def test_reward_per_step_of_a_rollout_across_a_switch():
    spy = Spy()
    CChainPPO("MlpPolicy", make_env(), n_steps=48, batch_size=8, device="cpu").learn(48, spy)
    assert spy.logged[0]["reward_per_step"] == 2  # of the 16 steps in the second task
