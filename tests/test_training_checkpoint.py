"""Files and errors of TrainingCheckpoint, and what its signals do. That training goes on exactly is in ``test_resume.py``."""

import csv
import errno
import json
import math
import multiprocessing
import os
import random
import re
import shutil
import signal
import stat
import subprocess
import sys
import time
import warnings
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from sb3_contrib import MaskablePPO
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, CheckpointCallback, EvalCallback, EveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger, configure
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_cchain import CChainCallback, CChainPPO, ChurnMonitor, TaskSignal, TrainingCheckpoint, resume
from sb3_cchain.checkpoint import ResumableEnv, checkpoint_folder, find_checkpoint, load_model, training_checkpoint
from sb3_cchain.checkpoint.checkpoint_folder import CheckpointFolder
from sb3_cchain.checkpoint.checkpoint_info import FORMAT, write_info
from sb3_cchain.envs import TaskVecNormalize
from sb3_cchain.locked_file import open_locked
from tests.resume_cases import Record, Stop, Stopped, in_new_process

ARGUMENTS = dict(n_steps=16, batch_size=16, n_epochs=1, policy_kwargs=dict(net_arch=[4]), seed=0, device="cpu")
DQN_ARGUMENTS = dict(
    learning_starts=10, buffer_size=6000, batch_size=8, policy_kwargs=dict(net_arch=[4]), seed=0, device="cpu"
)
# Two checkpoints stay, of which this is the newest
STEPS, NEWEST, BEFORE = 160, 96, 64


def make_env(env_id="CartPole-v1", n_envs=1, **kwargs):
    return make_vec_env(env_id, n_envs, seed=0, **kwargs)


def make(env=None, **kwargs):
    return PPO("MlpPolicy", env or make_env(), **{**ARGUMENTS, **kwargs})


def make_dqn(env=None):
    return DQN("MlpPolicy", env or make_env(), **DQN_ARGUMENTS)


def train(model, path, *callbacks, stop=110, save_freq=32, **kwargs):
    """Until a step in which an error ends it."""
    checkpoint = TrainingCheckpoint(save_freq, path, **kwargs)
    with pytest.raises(Stopped):
        model.learn(STEPS, [checkpoint, *callbacks, Stop(stop)])
    checkpoint._release()  # as the end of the process does
    return checkpoint


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    th.set_num_threads(1)
    path = tmp_path_factory.mktemp("trained")
    train(make(), path)
    return path


@pytest.fixture(scope="module")
def trained_dqn(tmp_path_factory):
    th.set_num_threads(1)
    path = tmp_path_factory.mktemp("trained_dqn")
    train(make_dqn(), path)
    return path


@pytest.fixture
def path(trained, tmp_path):
    """A folder of checkpoints that may be changed."""
    return Path(shutil.copytree(trained, tmp_path / "checkpoints"))


@pytest.fixture
def dqn_path(trained_dqn, tmp_path):
    return Path(shutil.copytree(trained_dqn, tmp_path / "checkpoints"))


def names(path):
    return sorted(folder.name for folder in path.glob("step_*"))


def step(path, number):
    return path / f"step_{number:012d}"


def go_on(path, *callbacks, env=None, **kwargs):
    folder = path if (path / ".lock").exists() else path.parent
    given = [TrainingCheckpoint(32, folder), *callbacks, Stop(float("inf"))]
    return resume(path, env or make_env(), given, device="cpu", **kwargs)


def parameters(model):
    return [parameter.detach().clone() for parameter in model.policy.parameters()]


def assert_same(model, other):
    assert all(th.equal(one, two) for one, two in zip(parameters(model), parameters(other), strict=True))


# --- Files ---------------------------------------------------------------------------------------------------------------


def test_files(trained):
    assert names(trained) == [f"step_{BEFORE:012d}", f"step_{NEWEST:012d}"]
    assert {file.name for file in step(trained, NEWEST).iterdir()} == {"checkpoint.json", "model.zip", "training.pkl"}
    assert {file.name for file in trained.iterdir()} == {*names(trained), ".lock"}


@pytest.mark.parametrize("keep", [1, 3, 100])
def test_keep(tmp_path, keep):
    train(make(), tmp_path, keep=keep, save_freq=16)
    assert len(names(tmp_path)) == min(keep, 6) and names(tmp_path)[-1] == f"step_{NEWEST:012d}"


def test_save_freq_counts_steps_of_all_environments(tmp_path):
    train(make(make_env(n_envs=2)), tmp_path, save_freq=40, keep=9)
    assert names(tmp_path) == [f"step_{64:012d}"]


def test_the_checkpoint(trained):
    checkpoint = find_checkpoint(trained)
    assert checkpoint.path == step(trained, NEWEST)
    assert (checkpoint.num_timesteps, checkpoint.total_timesteps) == (NEWEST, STEPS)
    assert 0 < checkpoint.seconds < 100
    assert {"versions", "environment", "model", "callbacks", "left_out", "learn"} <= checkpoint.info.keys()
    assert find_checkpoint(step(trained, BEFORE)).num_timesteps == BEFORE


def test_the_model_is_one_of_stable_baselines3(trained):
    model = PPO.load(step(trained, NEWEST) / "model.zip", env=make_env(), device="cpu")
    assert model.num_timesteps == NEWEST
    model.learn(32)


class LevelEnv(gym.Wrapper):
    """Rewards by the level that somebody else decides on, in a list that both have."""

    def __init__(self, levels):
        super().__init__(gym.make("CartPole-v1"))
        self.levels = levels

    def step(self, action):
        observation, _, *rest = self.env.step(action)
        return observation, float(self.levels[-1]), *rest


class Curriculum(BaseCallback):
    def __init__(self, given):
        super().__init__()
        self.levels = given

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        self.levels.append(self.levels[-1] + 1)


class ArgumentCurriculum(Curriculum):
    """The attribute is named like the argument, so it stays the list of the present process."""

    def __init__(self, levels):
        super().__init__(levels)


@pytest.mark.parametrize("kind", [Curriculum, ArgumentCurriculum])
def test_what_a_callback_and_an_environment_share_stays_shared(tmp_path, kind):
    def setup():
        levels = [0]
        return make_vec_env(lambda: LevelEnv(levels), seed=0), kind(levels)

    env, curriculum = setup()
    expected = make(env)
    expected.learn(STEPS, curriculum)
    env, curriculum = setup()
    train(make(env), tmp_path, curriculum)
    env, curriculum = setup()
    assert_same(expected, go_on(tmp_path, curriculum, env=env))
    assert curriculum.levels == list(range(11))


class Decay(BaseCallback):
    """Changes an attribute that is named like an argument, and keeps the other one."""

    def __init__(self, rate, log_path):
        super().__init__()
        self.rate, self.log_path = rate, log_path

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        self.rate /= 2
        self.model.ent_coef = self.rate


def test_arguments_that_a_callback_changes_go_on(tmp_path):
    expected = make()
    expected.learn(STEPS, Decay(1.0, "first"))
    train(make(), tmp_path, Decay(1.0, "first"))
    callback = Decay(1.0, "second")
    assert_same(expected, go_on(tmp_path, callback))
    assert callback.rate == 2.0**-10 and callback.log_path == "second"


class Level:
    """Of this module, as the callback that has it."""

    def __init__(self):
        self.number = 0


class Leveller(BaseCallback):
    """Has an object, and another callback, that it was given."""

    def __init__(self, level, inner=None):
        super().__init__()
        self.level, self.inner = level, inner

    def _init_callback(self):
        self.inner.init_callback(self.model)

    def _on_step(self):
        self.inner.on_step()
        return True

    def _on_rollout_end(self):
        self.level.number += 1


def test_objects_that_a_callback_was_given_go_on(tmp_path):
    train(make(), tmp_path, Leveller(Level(), Decay(1.0, "first")))
    level, inner = Level(), Decay(1.0, "second")
    go_on(tmp_path, Leveller(level, inner))
    assert level.number == 10 and inner.n_calls == STEPS


class Late(BaseCallback):
    """Sets an attribute that is named like an argument."""

    def __init__(self, best=None, interval=None):
        super().__init__()
        self.best, self.interval = best, interval

    def _on_step(self):
        self.best = max(self.best or 0, self.num_timesteps if self.num_timesteps < 50 else 0)
        return True


def test_arguments_that_were_none(tmp_path):
    train(make(), tmp_path, Late())
    callback = Late(interval=5)
    go_on(tmp_path, callback)
    assert (callback.best, callback.interval) == (49, 5)


def test_training_with_it_is_training_without_it(tmp_path):
    for create in (make, make_dqn):
        models = []
        for callbacks in ([], [TrainingCheckpoint(16, tmp_path / create.__name__)]):
            models.append(create().learn(STEPS, callbacks))
        assert_same(*models)


def test_training_goes_on_to_the_end(path):
    model = go_on(path)
    assert model.num_timesteps == STEPS
    assert names(path) == [f"step_{number:012d}" for number in (NEWEST, 128)]
    assert_same(model, make().learn(STEPS))


def test_an_older_checkpoint_in_another_folder(path, tmp_path):
    checkpoint = find_checkpoint(step(path, BEFORE))
    model = load_model(checkpoint, make_env(), "cpu")
    callback = TrainingCheckpoint.resume_from(checkpoint, tmp_path / "others")
    assert (callback.save_freq, callback.keep, callback.exact) == (32, 2, True)
    model.learn(STEPS - BEFORE, [callback, Stop(float("inf"))], reset_num_timesteps=False)
    assert_same(model, make().learn(STEPS))
    assert names(tmp_path / "others") == [f"step_{number:012d}" for number in (96, 128)]
    assert names(path) == [f"step_{number:012d}" for number in (BEFORE, NEWEST)]


def test_more_steps_than_before(path):
    assert go_on(path, total_timesteps=STEPS + 64).num_timesteps == STEPS + 64


def test_seconds_go_on(path):
    change_info(step(path, NEWEST), seconds=5000.0)
    go_on(path)
    assert 5000 < find_checkpoint(path).seconds < 5100


def test_what_was_not_saved_is_named(tmp_path):
    class Holder(BaseCallback):
        def __init__(self):
            super().__init__()
            self.process_of_another_package = subprocess.Popen([sys.executable, "-c", ""])

        def _on_step(self):
            return True

    train(make(), tmp_path, Holder())
    assert "callback 1.process_of_another_package" in find_checkpoint(tmp_path).info["left_out"]


@pytest.fixture
def full_disk(monkeypatch):
    """From a step on, for some steps."""

    def fill(first, last):
        rename = os.rename

        def full(source, target):
            if f"step_{first:012d}" <= Path(target).name <= f"step_{last:012d}":
                raise OSError("No space left on device")
            rename(source, target)

        monkeypatch.setattr(os, "rename", full)

    return fill


def test_a_checkpoint_that_cannot_be_written_is_tried_again(tmp_path, full_disk):
    full_disk(96, 112)
    with pytest.warns(
        UserWarning, match="No checkpoint was saved at step .*: No space left.*the next rollout tries again"
    ) as all_:
        model = make().learn(STEPS, TrainingCheckpoint(32, tmp_path, keep=9))
    assert re.findall(r"saved at step (\d+)", " ".join(str(warning.message) for warning in all_)) == ["96", "112"]
    assert names(tmp_path) == [f"step_{number:012d}" for number in (32, 64, 128)]
    assert_same(model, make().learn(STEPS))


def test_what_could_not_be_written_takes_no_space(tmp_path, full_disk):
    full_disk(32, STEPS)
    with pytest.warns(UserWarning, match="No checkpoint was saved"):
        make_dqn().learn(STEPS, TrainingCheckpoint(32, tmp_path))
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == [".lock"]


@pytest.mark.parametrize("first", [16, NEWEST])
@pytest.mark.parametrize("number, error", [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)])
def test_the_last_checkpoint_cannot_be_written(tmp_path, full_disk, handlers, capsys, number, error, first):
    """It ends as the signal would, and leaves the checkpoints that are there."""
    full_disk(first, STEPS)
    with pytest.raises(error), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "No checkpoint was saved")
        make().learn(STEPS, [TrainingCheckpoint(64, tmp_path), Send((90, number))])
    saved = [BEFORE] if first == NEWEST else []
    assert names(tmp_path) == [f"step_{step:012d}" for step in saved]
    newest = f'The last checkpoint is of step {BEFORE}. Go on from there: sb3_cchain.resume("{tmp_path}", env=...)'
    expected = newest if saved else "There is no checkpoint"
    assert f"step 96 and not saved: No space left on device. {expected}\n" in capsys.readouterr().out


def test_folders_that_cannot_be_synchronised(tmp_path, monkeypatch):
    """As some network file systems have them."""
    fsync = os.fsync

    def for_files_only(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "Invalid argument")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", for_files_only)
    train(make(), tmp_path)
    assert find_checkpoint(tmp_path).num_timesteps == NEWEST


@pytest.mark.parametrize("algorithm", [PPO, CChainPPO])
def test_the_log_goes_on_in_its_folder(tmp_path, algorithm):
    pytest.importorskip("tensorboard")
    model = algorithm("MlpPolicy", make_env(), tensorboard_log=str(tmp_path / "logs"), **ARGUMENTS)
    train(model, tmp_path / "checkpoints")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        resumed = go_on(tmp_path / "checkpoints")
    assert not [warning for warning in caught if "logged" in str(warning.message)]
    assert resumed.logger.dir == model.logger.dir
    name = f"{algorithm.__name__}_1"
    assert [folder.name for folder in (tmp_path / "logs").iterdir()] == [name]
    assert len([file for file in (tmp_path / "logs" / name).iterdir() if file.name.startswith("events")]) == 2


def test_other_logs_go_on_in_new_files(tmp_path):
    model = make()
    model.set_logger(configure(str(tmp_path / "logs"), ["csv", "json", "log"]))
    train(model, tmp_path / "checkpoints")
    before = (tmp_path / "logs" / "progress.csv").read_text()
    go_on(tmp_path / "checkpoints")
    with open(tmp_path / "logs" / f"progress_from_step_{NEWEST}.csv") as file:
        rows = list(csv.DictReader(file))
    assert (tmp_path / "logs" / "progress.csv").read_text() == before
    assert [row["time/total_timesteps"] for row in rows] == ["112", "128", "144", "160"]
    assert len(list((tmp_path / "logs").iterdir())) == 6


def test_a_log_that_cannot_be_made_again(tmp_path):
    model = make()
    model.set_logger(Logger(None, [Record()]))
    train(model, tmp_path)
    with pytest.warns(UserWarning, match="also logged by Record, which only you can make again: give `logger`"):
        go_on(tmp_path)
    go_on(tmp_path, total_timesteps=STEPS + 16, logger=Logger(None, [Record()]))


def test_files_are_on_the_disk_before_what_they_replace_is_gone(tmp_path, monkeypatch):
    events, rmtree = [], shutil.rmtree
    monkeypatch.setattr(checkpoint_folder, "sync_folder", lambda folder: events.append("folder"))
    monkeypatch.setattr(training_checkpoint, "sync_files", lambda folder: events.append(folder.name))
    monkeypatch.setattr(shutil, "rmtree", lambda folder, **kw: (events.append("removed"), rmtree(folder, **kw)))
    model = make()
    model.set_logger(configure(str(tmp_path / "logs"), ["csv"]))
    model.learn(64, TrainingCheckpoint(16, tmp_path / "checkpoints", keep=1))
    assert events == ["logs", "folder", "logs", "folder", "removed", "logs", "folder", "removed"]


# --- Folders of others ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["step_best", f"step_{NEWEST:012d}_copy", f"step_{NEWEST}"])
def test_a_copy_beside_the_checkpoints_is_left_alone(path, name):
    shutil.copytree(step(path, NEWEST), path / name)
    assert find_checkpoint(path).num_timesteps == NEWEST
    go_on(path)
    assert names(path) == sorted([*(f"step_{number:012d}" for number in (NEWEST, 128)), name])
    assert find_checkpoint(path).num_timesteps == 128


def test_a_damaged_piece_is_written_again(dqn_path):
    """Training that goes on from before comes to the same content, and the file of its name is there."""
    checkpoint = find_checkpoint(dqn_path)
    other = set(find_checkpoint(min(dqn_path.glob("step_*"))).info["chunks"])
    piece = next(name for name in checkpoint.info["chunks"] if name not in other)
    damage(next((dqn_path / "chunks").rglob(f"{piece}.z")), "torn")
    with pytest.warns(UserWarning, match="An older checkpoint is taken instead"):
        resume(dqn_path, make_env(), [TrainingCheckpoint(32, dqn_path, keep=9), Stop(float("inf"))], device="cpu")
    again = find_checkpoint(checkpoint.path)
    assert piece in again.info["chunks"] and again.num_timesteps == checkpoint.num_timesteps


@pytest.mark.parametrize("name", ["step_best", "best"])
def test_a_copy_keeps_its_pieces(dqn_path, name):
    copy = Path(shutil.copytree(min(dqn_path.glob("step_*")), dqn_path / name))
    resume(dqn_path, make_env(), [TrainingCheckpoint(16, dqn_path, keep=1), Stop(float("inf"))], device="cpu")
    assert find_checkpoint(copy).num_timesteps < find_checkpoint(dqn_path).num_timesteps


def test_numbers_of_numpy(tmp_path):
    callback = TrainingCheckpoint(np.int64(32), tmp_path, keep=np.int32(2), exact=True)
    make().learn(np.int64(STEPS), callback, log_interval=np.int64(1), tb_log_name=Path("PPO"))
    checkpoint = find_checkpoint(tmp_path)
    assert (checkpoint.total_timesteps, checkpoint.info["learn"]["log_interval"]) == (STEPS, 1)
    assert resume(tmp_path, make_env(), device="cpu").num_timesteps == STEPS


def test_checkpoints_of_another_training_stay(path):
    before = names(path)
    with pytest.raises(ValueError, match=rf"`path` holds checkpoints of another training .*step_0*{NEWEST}"):
        make().learn(STEPS, TrainingCheckpoint(32, path))
    assert names(path) == before


def test_later_checkpoints_stay(path):
    before = names(path)
    with pytest.raises(ValueError, match=rf"goes on from step {BEFORE}, .* later checkpoints, .*step_0*{NEWEST}"):
        go_on(step(path, BEFORE))
    assert names(path) == before


def test_what_a_killed_process_left_is_removed(path):
    (path / ".step_000000000128").mkdir()
    (path / ".step_000000000128" / "model.zip").write_bytes(b"half")
    go_on(path)
    assert not list(path.glob(".step_*"))


def write_to(path):
    """For another process."""
    try:
        CheckpointFolder(path, 2, NEWEST).close()
    except ValueError as error:
        return str(error)
    return "free"


def test_one_process_at_a_time(path):
    folder = CheckpointFolder(path, 2, NEWEST)
    assert in_new_process(write_to, path).startswith(f"Another process is writing checkpoints to {path}")
    folder.close()
    assert in_new_process(write_to, path) == "free"


@pytest.mark.skipif(not hasattr(os, "register_at_fork"), reason="needs fork")
def test_processes_of_environments_do_not_hold_the_lock(path, tmp_path):
    """Those that were made meanwhile, after an error."""
    closed = open_locked(tmp_path / "closed", "")
    closed.close()
    folder = CheckpointFolder(path, 2, NEWEST)
    env = make_env(vec_env_cls=SubprocVecEnv, vec_env_kwargs={"start_method": "forkserver"})
    folder.close()
    CheckpointFolder(path, 2, NEWEST).close()
    env.close()


def test_one_that_was_refused_does_not_hold_the_lock(path):
    """While somebody looks at the error, say."""
    with pytest.raises(ValueError, match="checkpoints of another training") as error:
        CheckpointFolder(path, 2)
    assert in_new_process(write_to, path) == "free" and error.value.__traceback__ is not None


def test_after_an_error_the_same_process_may_train_again(path, tmp_path):
    """In a notebook, say."""
    model = make()
    with pytest.raises(Stopped):
        model.learn(STEPS, [TrainingCheckpoint(32, tmp_path / "new"), Stop(110)])
    assert go_on(tmp_path / "new").num_timesteps == STEPS


def test_after_an_error_the_same_callback_may_train_again(tmp_path, handlers):
    _, are_restored = handlers
    model, callback = make(), TrainingCheckpoint(32, tmp_path, keep=9)
    with pytest.raises(Stopped):
        model.learn(STEPS, [callback, Stop(110)])
    model.learn(STEPS - 110, [callback, Stop(math.inf)], reset_num_timesteps=False)
    # 32 steps after the last one, at the start of a rollout
    assert names(tmp_path) == [f"step_{number:012d}" for number in (32, 64, NEWEST, 142)] and are_restored()


def test_after_an_error_in_training_that_went_on(path):
    checkpoint = find_checkpoint(path)
    model, callback = load_model(checkpoint, make_env(), "cpu"), TrainingCheckpoint.resume_from(checkpoint)
    with pytest.raises(Stopped):
        model.learn(STEPS - NEWEST, [callback, Stop(NEWEST + 5)], reset_num_timesteps=False)
    model.learn(STEPS - model.num_timesteps, [callback, Stop(math.inf)], reset_num_timesteps=False)
    assert model.num_timesteps >= STEPS


def test_a_link_to_the_folder_is_the_folder(path, tmp_path):
    (tmp_path / "link").symlink_to(path)
    checkpoint = find_checkpoint(path)
    model = load_model(checkpoint, make_env(), "cpu")
    callback = TrainingCheckpoint.resume_from(checkpoint, tmp_path / "link")
    model.learn(STEPS - NEWEST, [callback, Stop(math.inf)], reset_num_timesteps=False)
    assert names(path)[-1] == f"step_{128:012d}"


# --- In several calls of learn() -----------------------------------------------------------------------------------------


def learn_in_pieces(model, make_callback, n_pieces=5):
    for _ in range(n_pieces):
        model.learn(STEPS // 5, make_callback(), reset_num_timesteps=False)
    return model


@pytest.mark.parametrize("create", [make, make_dqn])
@pytest.mark.parametrize("is_one", [True, False], ids=["one callback", "new callbacks"])
def test_several_calls_are_one_training(tmp_path, create, is_one):
    """Its checkpoints do not depend on where a call ends, and it goes on to the end of the present call."""
    expected = learn_in_pieces(create(), list)
    one = TrainingCheckpoint(48, tmp_path)
    model = learn_in_pieces(create(), lambda: [one if is_one else TrainingCheckpoint(48, tmp_path)])
    assert_same(model, expected)
    assert names(tmp_path) == [f"step_{number:012d}" for number in (NEWEST, 144)]
    assert find_checkpoint(tmp_path).seconds > find_checkpoint(step(tmp_path, NEWEST)).seconds
    shutil.rmtree(step(tmp_path, 144))
    resumed = resume(tmp_path, make_env(), TrainingCheckpoint(48, tmp_path), device="cpu")
    assert resumed.num_timesteps == 128
    resumed.learn(STEPS - 128, TrainingCheckpoint(48, tmp_path), reset_num_timesteps=False)
    assert_same(resumed, expected)
    assert names(tmp_path) == [f"step_{number:012d}" for number in (NEWEST, 144)]


def test_a_signal_in_the_last_rollout_of_a_call_stops_the_next_one(tmp_path, handlers):
    model, callback = make(), TrainingCheckpoint(10**6, tmp_path)
    model.learn(64, [callback, Send((60, signal.SIGTERM))])
    with pytest.raises(SystemExit):
        model.learn(64, [callback, Send()], reset_num_timesteps=False)
    assert names(tmp_path) == [f"step_{64:012d}"]
    model.learn(STEPS - 64, [callback, Send()], reset_num_timesteps=False)
    assert model.num_timesteps == STEPS


def test_a_signal_in_the_last_rollout_stops_no_other_training(tmp_path, handlers):
    callback = TrainingCheckpoint(10**6, tmp_path)
    make().learn(64, [callback, Send((60, signal.SIGTERM))])
    assert make().learn(64, [callback, Send()]).num_timesteps == 64


def test_another_training_of_the_same_model_is_refused(tmp_path):
    model = make()
    model.learn(64, TrainingCheckpoint(32, tmp_path))
    with pytest.raises(ValueError, match="`path` holds checkpoints of another training"):
        model.learn(64, TrainingCheckpoint(32, tmp_path))


def test_training_that_goes_on_does_not_begin_to_count(path):
    checkpoint = find_checkpoint(path)
    callbacks = [TrainingCheckpoint.resume_from(checkpoint), Stop(float("inf"))]
    with pytest.raises(ValueError, match="reset_num_timesteps=False"):
        load_model(checkpoint, make_env(), "cpu").learn(64, callbacks)


@pytest.mark.parametrize("log_interval, saved", [(1, [96, 144]), (2, [64, 128]), (5, [80]), (1000, [96]), (None, [96, 144])])
def test_it_waits_for_the_log_but_not_too_long(tmp_path, log_interval, saved):
    """Rollouts have 16 steps."""
    make().learn(STEPS, TrainingCheckpoint(48, tmp_path), log_interval=log_interval)
    assert names(tmp_path) == [f"step_{number:012d}" for number in saved]


def test_the_log_is_waited_for_in_each_call(tmp_path):
    """Whose iterations are counted from its beginning."""
    model, callback = make(), TrainingCheckpoint(48, tmp_path, keep=9)
    for n_steps in (48, STEPS):
        model.learn(n_steps, callback, log_interval=2, reset_num_timesteps=False)
    assert names(tmp_path) == [f"step_{number:012d}" for number in (48, 112, 176)]


# --- Damage --------------------------------------------------------------------------------------------------------------


def damage(file, kind):
    content = bytearray(file.read_bytes())
    if kind == "missing":
        file.unlink()
    elif kind == "torn":
        file.write_bytes(content[: len(content) // 2])
    elif kind == "empty":
        file.write_bytes(b"")
    else:
        content[len(content) // 2] ^= 1
        file.write_bytes(content)


@pytest.mark.parametrize(
    "name, kind",
    [
        (name, kind)
        for name in ("model.zip", "training.pkl", "checkpoint.json")
        for kind in ("missing", "torn", "empty", "flipped")
    ],
)
def test_a_damaged_checkpoint(path, name, kind):
    damage(step(path, NEWEST) / name, kind)
    with pytest.raises(ValueError, match=rf"{name}.*The newest whole checkpoint beside it is \S*step_0*{BEFORE}"):
        find_checkpoint(step(path, NEWEST))
    with pytest.warns(UserWarning, match=rf"{name}.*An older checkpoint is taken instead"):
        assert find_checkpoint(path).num_timesteps == BEFORE
    damage(step(path, BEFORE) / name, kind)
    with pytest.raises(ValueError, match=rf"holds no whole checkpoint: .*{NEWEST}.*{name}.*; .*{BEFORE}.*{name}"):
        find_checkpoint(path)
    with pytest.raises(ValueError, match=name) as raised:
        find_checkpoint(step(path, NEWEST))
    assert "beside it" not in str(raised.value)


@pytest.mark.filterwarnings("ignore:.*An older checkpoint is taken instead")
def test_training_goes_on_from_the_one_before_a_damaged_one(path):
    """Which does not stand in the way of new checkpoints, and is put aside."""
    damage(step(path, NEWEST) / "training.pkl", "torn")
    model = go_on(path)
    assert_same(model, make().learn(STEPS))
    assert names(path) == [f"step_{number:012d}" for number in (NEWEST, 128)]
    assert find_checkpoint(step(path, NEWEST)).num_timesteps == NEWEST
    assert [folder.name for folder in path.glob("damaged*")] == [f"damaged_step_{NEWEST:012d}"]


@pytest.mark.filterwarnings("ignore:.*An older checkpoint is taken instead")
def test_a_step_that_is_damaged_again(path):
    (path / f"damaged_step_{NEWEST:012d}" / "of an earlier time").mkdir(parents=True)
    damage(step(path, NEWEST) / "training.pkl", "torn")
    go_on(path)
    assert {file.name for file in (path / f"damaged_step_{NEWEST:012d}").iterdir()} >= {"model.zip"}


@pytest.mark.parametrize("kind", ["missing", "torn"])
def test_an_older_damaged_one_does_not_stop_training(dqn_path, kind):
    damage(min(dqn_path.glob("step_*")) / "checkpoint.json", kind)
    callback = TrainingCheckpoint(16, dqn_path, keep=5)
    resume(dqn_path, make_env(), [callback, Stop(float("inf"))], device="cpu")
    assert find_checkpoint(dqn_path).num_timesteps >= STEPS - 24


def test_the_replay_buffer_is_in_pieces(dqn_path):
    info = find_checkpoint(dqn_path).info
    assert info["chunks"]
    needed = {name for folder in dqn_path.glob("step_*") for name in find_checkpoint(folder).info["chunks"]}
    # Pieces of checkpoints that are gone are gone
    assert {file.stem for file in (dqn_path / "chunks").rglob("*.z")} == needed


@pytest.mark.parametrize("kind", ["missing", "torn", "flipped"])
def test_a_damaged_piece(dqn_path, kind):
    checkpoint = find_checkpoint(dqn_path)
    other = set(find_checkpoint(min(dqn_path.glob("step_*"))).info["chunks"])
    piece = next(name for name in checkpoint.info["chunks"] if name not in other)
    damage(next((dqn_path / "chunks").rglob(f"{piece}.z")), kind)
    with pytest.raises(ValueError, match=piece):
        go_on(checkpoint.path)
    with pytest.warns(UserWarning, match=f"{piece}.*An older checkpoint is taken instead"):
        assert find_checkpoint(dqn_path).num_timesteps < checkpoint.num_timesteps


def test_something_else_is_no_checkpoint(tmp_path):
    (tmp_path / "file").write_text("text")
    (tmp_path / "empty").mkdir()
    for path in (tmp_path / "file", tmp_path / "empty", tmp_path / "missing"):
        with pytest.raises(ValueError, match=f"{path} is not a checkpoint of a training"):
            find_checkpoint(path)
        with pytest.raises(ValueError, match=f"{path} is not a checkpoint of a training"):
            go_on(path)


def change_info(folder, **changes):
    """As another training would have written it."""
    content = json.loads((folder / "checkpoint.json").read_text())
    del content["checksum"]
    write_info(folder, {**content, **changes})


def test_another_format(path):
    change_info(step(path, NEWEST), format=FORMAT + 1)
    message = rf"has the format {FORMAT + 1} of sb3-cchain \S+; this version reads the format {FORMAT}\. To .* load (\S+zip)"
    with pytest.raises(ValueError, match=message) as error:
        find_checkpoint(step(path, NEWEST))
    PPO.load(re.search(message, str(error.value))[1], device="cpu")


def test_another_device(path):
    """The reference batch and the replay buffer are on it, so training would fail or differ."""
    with pytest.raises(ValueError, match=r"`device` must be cpu, on which .* was trained; got cuda\. To go on from its param"):
        resume(path, make_env(), device="cuda")
    assert find_checkpoint(path).device() == th.device("cpu")


def test_a_device_that_is_not_here(path):
    change_info(step(path, NEWEST), device="cuda:99")
    message = rf"was trained on cuda:99, which PyTorch does not find here \(.*load {step(path, NEWEST)}/model.zip on another"
    with pytest.raises(ValueError, match=message):
        resume(path, make_env())


def test_a_device_without_a_number(path, monkeypatch):
    """It is the first of its kind."""
    monkeypatch.setattr(th, "empty", lambda *_, **__: None)  # as where there is one
    change_info(step(path, NEWEST), device="cuda:0")
    checkpoint = find_checkpoint(path)
    assert checkpoint.device("cuda") == th.device("cuda:0")
    with pytest.raises(ValueError, match=r"`device` must be cuda:0.*got cuda:1"):
        checkpoint.device("cuda:1")


def test_a_changed_number_is_noticed(path):
    file = step(path, NEWEST) / "checkpoint.json"
    file.write_text(file.read_text().replace(f'"num_timesteps": {NEWEST}', f'"num_timesteps": {NEWEST - 1}'))
    with pytest.raises(ValueError, match=f"{file} is damaged: it is not what was written"):
        find_checkpoint(step(path, NEWEST))


def test_other_versions(path):
    versions = find_checkpoint(path).info["versions"]
    change_info(step(path, NEWEST), versions={**versions, "torch": "1.0", "sb3-contrib": "0.1"})
    with pytest.warns(UserWarning, match=r"was made with .*torch 1\.0 \(now \S+\).* not exactly"):
        assert go_on(path).num_timesteps == STEPS


def test_a_later_numpy(path):
    versions = find_checkpoint(path).info["versions"]
    change_info(step(path, NEWEST), versions={**versions, "numpy": "99.1.0"})
    with pytest.raises(
        ValueError, match=r"was made with NumPy 99\.1\.0, .* NumPy \S+ cannot read: go on with NumPy 99 or later"
    ):
        go_on(path)


# --- Another training than the one that was saved ------------------------------------------------------------------------


class Changed(gym.Wrapper):
    """Another environment by its wrappers."""


@pytest.mark.parametrize(
    "kwargs, message",
    [
        (dict(n_envs=2), "number of environments was 1 and is 2"),
        (dict(wrapper_class=Changed), r"environment was CartPole-v1 \(.*\) and is CartPole-v1 \(Changed "),
        (
            dict(env_kwargs=dict(sutton_barto_reward=True, render_mode="rgb_array")),
            r"environment was CartPole-v1 \(.*\) and is CartPole-v1 with sutton_barto_reward=True \(",
        ),
    ],
    ids=["number", "wrappers", "arguments"],
)
def test_another_environment(path, kwargs, message):
    before = names(path)
    with pytest.raises(ValueError, match=f"differs from this one: {message}.*Make the training as it was"):
        go_on(path, env=make_env(**kwargs))
    assert names(path) == before


def test_an_environment_that_is_normalised(path):
    with pytest.raises(ValueError, match="vectorised wrappers was none and is VecNormalize"):
        go_on(path, env=VecNormalize(make_env()))


def test_an_environment_of_other_spaces(path):
    with pytest.raises(ValueError, match="spaces do not match"):
        go_on(path, env=make_env("Acrobot-v1"))


def test_other_hyperparameters(path):
    checkpoint = find_checkpoint(path)
    model = PPO.load(checkpoint.model_path, env=make_env(), device="cpu", learning_rate=1e-4, gamma=0.5)
    callbacks = [TrainingCheckpoint.resume_from(checkpoint), Stop(float("inf"))]
    before = parameters(model)
    with pytest.raises(ValueError, match=r"gamma was 0\.99 and is 0\.5; learning_rate was 0\.0003 and is 0\.0001"):
        model.learn(64, callbacks, reset_num_timesteps=False)
    assert all(map(th.equal, before, parameters(model)))


def test_other_callbacks(path):
    with pytest.raises(ValueError, match=r"callback 1 was Stop and is ChurnMonitor.*same callbacks in the same order"):
        resume(path, make_env(), [TrainingCheckpoint(32, path), ChurnMonitor()], device="cpu")
    with pytest.raises(ValueError, match=r"callback 1 was Stop and is absent"):
        resume(path, make_env(), device="cpu")
    with pytest.raises(ValueError, match=r"callback 0 was TrainingCheckpoint and is Stop"):
        resume(path, make_env(), [Stop(1), TrainingCheckpoint(32, path)], device="cpu")


class Counter:
    """In a callback."""

    count = 0


class Count(BaseCallback):
    def _init_callback(self):
        self.counter = Counter()
        self.counter.count = 1

    def _on_step(self):
        return True


def test_a_callback_of_other_code(tmp_path, monkeypatch):
    train(make(), tmp_path, Count())
    monkeypatch.setattr(Count, "_init_callback", lambda self: None)
    monkeypatch.delattr(sys.modules[__name__], "Counter")
    with pytest.raises(ValueError, match=r"cannot be put back \(.*Counter.*other code"):
        go_on(tmp_path, Count())


def test_a_finished_training(path):
    for folder in (BEFORE, NEWEST):
        change_info(step(path, folder), total_timesteps=NEWEST)
    with pytest.raises(ValueError, match=rf"`total_timesteps` must be more than {NEWEST}, .*; got {NEWEST}"):
        go_on(path)
    with pytest.raises(ValueError, match=rf"`total_timesteps` must be more than {NEWEST}, .*; got 50"):
        go_on(path, total_timesteps=50)
    assert go_on(path, total_timesteps=STEPS).num_timesteps == STEPS


# --- Arguments -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments, message",
    [
        (dict(save_freq=0), "`save_freq` must be .*got 0"),
        (dict(save_freq=1.5), "`save_freq` must be .*got 1.5"),
        (dict(keep=0), "`keep` must be .*got 0"),
        (dict(exact="yes"), "`exact` must be .*got 'yes'"),
        (dict(path=None), "`path` must be a path, got None"),
    ],
)
def test_wrong_arguments(tmp_path, arguments, message):
    with pytest.raises((ValueError, TypeError), match=message):
        TrainingCheckpoint(**{"save_freq": 10, "path": tmp_path, **arguments})


def test_a_file_in_the_place_of_the_folder(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "inside"):
        with pytest.raises(ValueError, match=rf"`path` must be a folder that can be written to, got '{path}'"):
            make().learn(STEPS, TrainingCheckpoint(16, path))


def test_a_class_that_cannot_be_found_again(tmp_path):
    class Local(PPO):
        pass

    with pytest.raises(ValueError, match=r"Local could not be resumed, because there is no such class in its module"):
        Local("MlpPolicy", make_env(), **ARGUMENTS).learn(32, TrainingCheckpoint(16, tmp_path))


class Outer:
    class Nested(PPO):
        pass


def test_a_class_within_a_class(tmp_path):
    train(Outer.Nested("MlpPolicy", make_env(), **ARGUMENTS), tmp_path)
    assert type(go_on(tmp_path)) is Outer.Nested


def test_masks_stay_unused(tmp_path):
    model = MaskablePPO("MlpPolicy", make_env(), **ARGUMENTS)
    with pytest.raises(Stopped):
        model.learn(STEPS, [TrainingCheckpoint(32, tmp_path), Stop(110)], use_masking=False)
    # The environment has no masks, and would be refused
    assert go_on(tmp_path).num_timesteps == STEPS


def test_two_of_them(tmp_path):
    with pytest.raises(ValueError, match="2 callbacks TrainingCheckpoint"):
        make().learn(STEPS, [TrainingCheckpoint(16, tmp_path / "a"), TrainingCheckpoint(16, tmp_path / "b")])


def test_environments_in_processes_need_a_wrapper(tmp_path, handlers):
    env = make_env(vec_env_cls=SubprocVecEnv, vec_env_kwargs={"start_method": "forkserver"})
    model = make(env)
    before = parameters(model)
    with pytest.raises(ValueError, match="ResumableEnv"):
        model.learn(STEPS, TrainingCheckpoint(16, tmp_path))
    assert model.num_timesteps == 0 and all(map(th.equal, before, parameters(model)))
    # Nothing is left of it: neither files nor handlers
    assert names(tmp_path) == [] and handlers[1]()
    train(model, tmp_path, exact=False)
    assert names(tmp_path)[-1] == f"step_{NEWEST:012d}"
    env.close()


class Watch(BaseCallback):
    """What training finds at the start of its first rollout."""

    def __init__(self, look):
        super().__init__()
        self.looks, self.found = look, None

    def _on_rollout_start(self):
        if self.found is None:
            self.found = self.looks(self.model)

    def _on_step(self):
        return True


def begin_new_episodes(path, make_model, make_training_env, look):
    """Train, go on with new episodes, and look at the beginning."""
    env = make_training_env()
    make_model(env).learn(STEPS, [TrainingCheckpoint(NEWEST, path, exact=False), Watch(lambda model: None)])
    env.close()
    env, watch = make_training_env(), Watch(look)
    with pytest.warns(UserWarning, match="begin new episodes"):
        model = resume(path, env, [TrainingCheckpoint(NEWEST, path, exact=False), watch], device="cpu")
    env.close()
    assert model.num_timesteps == STEPS
    assert find_checkpoint(path).info["training_checkpoint"]["exact"] is False
    return watch.found


def test_new_episodes_where_exactness_is_not_wanted(tmp_path):
    def look(model):
        return model.env.envs[0].unwrapped.state, model._last_obs[0], model._last_episode_starts

    state, observation, starts = begin_new_episodes(tmp_path, make, make_env, look)
    # The environment and the model agree on where the episode is, and it is at its beginning
    assert abs(state - observation).max() < 1e-6 and abs(state).max() <= 0.05 and starts.all()


@pytest.mark.filterwarnings("ignore:All environments begin new episodes")
@pytest.mark.parametrize("exact", [True, False])
def test_the_checkpoint_says_whether_it_is_exact(tmp_path, exact):
    """Not the callback that goes on from it."""
    train(make(), tmp_path, exact=exact)
    callbacks = [TrainingCheckpoint(32, tmp_path, exact=not exact), Stop(math.inf)]
    model, expected = resume(tmp_path, make_env(), callbacks, device="cpu"), make().learn(STEPS)
    are_equal = all(map(th.equal, parameters(model), parameters(expected)))
    assert model.num_timesteps == STEPS and are_equal is exact


@pytest.mark.parametrize("wrapper", [VecNormalize, TaskVecNormalize])
@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_tasks_and_statistics_outlast_episodes(tmp_path, wrapper, vec_env_cls):
    def make_training_env():
        kwargs = dict(env_kwargs=dict(steps_per_task=60, n_tasks=3, n_envs=2))
        if vec_env_cls is SubprocVecEnv:
            kwargs["vec_env_kwargs"] = {"start_method": "forkserver"}
        return wrapper(make_env("Continual/CartPole-v1", n_envs=2, vec_env_cls=vec_env_cls, **kwargs))

    def look(model):
        clocks = model.env.get_attr("clock")
        times = [(clock.n_steps, clock.task_id) for clock in clocks]
        return times, model.env.obs_rms.count, model.env.returns.tolist(), model._last_episode_starts

    times, count, returns, starts = begin_new_episodes(tmp_path, make, make_training_env, look)
    # The second of tasks of 60 steps
    assert times == [(NEWEST, 1)] * 2
    # Observations of all steps, or of those of the task; and those at the start of the training and of the new episodes
    assert count == pytest.approx(NEWEST + 4 if wrapper is VecNormalize else NEWEST - 60 + 4, abs=1e-3)
    assert returns == [0, 0] and starts.all()


def test_new_episodes_do_not_follow_on_the_replay_buffer(tmp_path):
    def look(model):
        buffer = model.replay_buffer
        return buffer.pos, buffer.dones[buffer.pos - 1].tolist(), buffer.timeouts[buffer.pos - 1].tolist()

    position, done, timeout = begin_new_episodes(tmp_path, make_dqn, make_env, look)
    assert (position, done, timeout) == (NEWEST, [1], [1])


# --- Signals -------------------------------------------------------------------------------------------------------------


class Send(BaseCallback):
    """Signals to this process, each at a step."""

    def __init__(self, *signals):
        super().__init__()
        self.left = list(signals)

    def _on_step(self):
        while self.left and self.num_timesteps >= self.left[0][0]:
            os.kill(os.getpid(), self.left.pop(0)[1])
        return True


class AtStart(BaseCallback):
    """A signal to this process when training starts."""

    def _on_training_start(self):
        os.kill(os.getpid(), signal.SIGTERM)

    def _on_step(self):
        return True


@pytest.fixture
def handlers():
    """Of the process, in the place of those of the interpreter."""
    heard = []
    before = {number: signal.signal(number, lambda *what: heard.append(what[0])) for number in (signal.SIGINT, signal.SIGTERM)}
    present = {number: signal.getsignal(number) for number in before}
    yield heard, lambda: {number: signal.getsignal(number) for number in present} == present
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize(
    "number, error", [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)], ids=["SIGINT", "SIGTERM"]
)
@pytest.mark.parametrize("create", [make, make_dqn])
def test_a_signal_saves_and_stops(tmp_path, capsys, handlers, create, number, error):
    heard, are_restored = handlers
    model = create()
    with pytest.raises(error) as raised:
        model.learn(STEPS, [TrainingCheckpoint(10**6, tmp_path), Send((70, number))])
    if error is SystemExit:
        assert raised.value.code == 143
    assert heard == [] and are_restored()
    checkpoint = find_checkpoint(tmp_path)
    # The rollout was completed and learned from
    assert checkpoint.num_timesteps == model.num_timesteps == (80 if create is make else 72)
    printed = capsys.readouterr().out
    assert f"saved to {checkpoint.path}" in printed and f'sb3_cchain.resume("{tmp_path}", env=...)' in printed
    resumed = resume(tmp_path, make_env(), [TrainingCheckpoint(10**6, tmp_path), Send()], device="cpu")
    assert resumed.num_timesteps == STEPS and are_restored()
    assert_same(resumed, create().learn(STEPS))


def test_a_signal_before_anything_is_trained(tmp_path, handlers):
    """Twice, as one who starts it again and stops it again."""
    model, callback = make(), TrainingCheckpoint(10**6, tmp_path)
    model.learn(64, callback)
    for _ in range(2):
        with pytest.raises(SystemExit):
            model.learn(64, [callback, AtStart()], reset_num_timesteps=False)
        assert names(tmp_path) == [f"step_{64:012d}"]


def test_a_signal_in_an_episode_that_was_not_recorded(tmp_path, capsys, handlers):
    env = make_env("LunarLander-v3")
    model = make(env).learn(16)  # without the callback, so that the episode is under way
    with pytest.raises(SystemExit):
        model.learn(64, [TrainingCheckpoint(16, tmp_path), Send((20, signal.SIGTERM))], reset_num_timesteps=False)
    assert names(tmp_path) == [] and "There is no checkpoint" in capsys.readouterr().out


def test_a_signal_that_is_ignored_stays_ignored(tmp_path, handlers):
    """As Ctrl-C in a job that a shell script has put in the background."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    make().learn(STEPS, [TrainingCheckpoint(10**6, tmp_path), Send((70, signal.SIGINT))])
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN and names(tmp_path) == []


def test_a_second_signal_stops_at_once(tmp_path, handlers):
    def hear(number, frame):
        raise Stopped

    signal.signal(signal.SIGINT, hear)
    model = make()
    with pytest.raises(Stopped):
        model.learn(STEPS, [TrainingCheckpoint(10**6, tmp_path), Send((70, signal.SIGINT), (72, signal.SIGINT))])
    assert model.num_timesteps == 72 and signal.getsignal(signal.SIGINT) is hear and names(tmp_path) == []


def test_a_second_signal_that_is_not_heeded(tmp_path, handlers):
    """By the handler that was there before. The first one is then."""
    heard, are_restored = handlers
    with pytest.raises(KeyboardInterrupt):
        make().learn(STEPS, [TrainingCheckpoint(10**6, tmp_path), Send((70, signal.SIGINT), (72, signal.SIGINT))])
    assert heard == [signal.SIGINT] and are_restored() and find_checkpoint(tmp_path).num_timesteps == 80


def test_a_second_sigterm_changes_nothing(tmp_path, handlers):
    heard, _ = handlers
    with pytest.raises(SystemExit):
        make().learn(STEPS, [TrainingCheckpoint(10**6, tmp_path), Send((70, signal.SIGTERM), (71, signal.SIGTERM))])
    assert names(tmp_path) == [f"step_{80:012d}"] and heard == []


def test_a_second_ctrl_c_stops_at_once(tmp_path, handlers):
    heard, _ = handlers
    signals = Send((70, signal.SIGTERM), (71, signal.SIGINT))
    with pytest.raises(SystemExit):
        make().learn(STEPS, [TrainingCheckpoint(10**6, tmp_path), signals])
    assert heard == [signal.SIGINT]  # whose former handler ends nothing here


def test_handlers_are_restored_at_the_end(tmp_path, handlers):
    heard, are_restored = handlers
    make().learn(32, TrainingCheckpoint(16, tmp_path))
    assert are_restored() and heard == []


def test_signals_after_a_training_that_an_error_ended_are_not_kept(tmp_path, handlers):
    heard, are_restored = handlers
    model = make()
    with pytest.raises(Stopped):
        model.learn(STEPS, [TrainingCheckpoint(16, tmp_path), Stop(40)])
    os.kill(os.getpid(), signal.SIGTERM)
    assert heard == [signal.SIGTERM] and are_restored()


def test_signals_in_another_training_after_an_error(tmp_path, handlers):
    """Of the same process, without the callback."""
    heard, _ = handlers
    model = make()
    with pytest.raises(Stopped):
        model.learn(STEPS, [TrainingCheckpoint(16, tmp_path), Stop(40)])
    make().learn(32, Send((5, signal.SIGINT)))
    assert heard == [signal.SIGINT]


class InStep(BaseCallback):
    """What happens to training in its twentieth step."""

    def __init__(self, action):
        super().__init__()
        self.happens = action

    def _on_step(self):
        if self.n_calls == 20:
            self.happens()
        return True


def fail():
    raise Stopped


def kill():
    os.kill(os.getpid(), signal.SIGKILL)


def run_group(path, exact, action):
    """Training in a group of processes with those of its environments, which the script does not close."""
    os.setpgrp()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL if number == signal.SIGTERM else signal.default_int_handler)
    wrapper = dict(wrapper_class=ResumableEnv) if exact else {}
    env = make_env(n_envs=2, vec_env_cls=SubprocVecEnv, vec_env_kwargs={"start_method": "fork"}, **wrapper)
    make(env).learn(STEPS, [TrainingCheckpoint(10**6, path, exact=exact), InStep(action)])


def is_there(group):
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


# What happens, the exit code, and whether training is saved
GROUP_CASES = {
    "Ctrl-C": (partial(os.killpg, 0, signal.SIGINT), 1, True),
    "SIGTERM": (partial(os.killpg, 0, signal.SIGTERM), 143, True),
    "error": (fail, 1, False),
    "kill": (kill, -signal.SIGKILL, False),
}


@pytest.mark.skipif(os.name != "posix", reason="needs groups of processes")
@pytest.mark.parametrize("exact", [True, False], ids=["exact", "new episodes"])
@pytest.mark.parametrize("name", GROUP_CASES)
def test_processes_of_environments_live_as_long_as_training(tmp_path, name, exact):
    """Not shorter, so that it can be saved, and not longer."""
    action, exit_code, is_saved = GROUP_CASES[name]
    process = multiprocessing.get_context("forkserver").Process(target=run_group, args=(tmp_path, exact, action))
    process.start()
    process.join(60)
    assert process.exitcode == exit_code
    assert names(tmp_path) == ([f"step_{64:012d}"] if is_saved else [])
    deadline = time.monotonic() + 10
    while is_there(process.pid):
        assert time.monotonic() < deadline, "a process of an environment is left"
        time.sleep(0.01)


# --- Kills ---------------------------------------------------------------------------------------------------------------

N_KILLS = 20
SAVE_WITHOUT_END = f"""
import os, sys
import torch._dynamo
from stable_baselines3.common.callbacks import BaseCallback
from sb3_cchain import TrainingCheckpoint, resume
from tests.test_training_checkpoint import make_dqn, make_env
torch.set_num_threads(1)
path = sys.argv[1]
for _ in range({N_KILLS}):
    pid = os.fork()
    if pid == 0:
        if any(name.startswith("step_") for name in os.listdir(path)):
            resume(path, make_env(), total_timesteps=10**9, device="cpu")
        else:
            make_dqn().learn(10**9, TrainingCheckpoint(1, path))
    print(pid, flush=True)
    os.waitpid(pid, 0)
"""


def newest_step(path):
    return max((int(name[5:]) for name in names(path)), default=0)


@pytest.mark.skipif(os.name != "posix", reason="needs fork")
def test_a_kill_while_it_saves_leaves_a_whole_checkpoint(tmp_path):
    rng = random.Random(0)
    command = [sys.executable, "-c", SAVE_WITHOUT_END, str(tmp_path)]
    reached = [0]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[1]) as program:
        assert program.stdout is not None
        for _ in range(N_KILLS):
            pid = int(program.stdout.readline())
            deadline = time.monotonic() + 60
            # It saves all the time, so that it is killed at any point of that
            while newest_step(tmp_path) <= reached[-1]:
                assert time.monotonic() < deadline
                time.sleep(0.005)
            time.sleep(rng.uniform(0, 0.05))
            os.kill(pid, signal.SIGKILL)
            reached.append(find_checkpoint(tmp_path).num_timesteps)
    assert sorted(set(reached)) == reached
    assert resume(tmp_path, make_env(), total_timesteps=reached[-1] + 100, device="cpu").num_timesteps >= reached[-1] + 100


# --- Other callbacks -----------------------------------------------------------------------------------------------------


def test_settings_are_those_of_the_new_process_and_counters_of_the_old(tmp_path):
    def callbacks(folder):
        evaluation = EvalCallback(
            make_env(), eval_freq=30, n_eval_episodes=1, verbose=0, warn=False,
            log_path=str(tmp_path / folder), best_model_save_path=str(tmp_path / folder),
        )  # fmt: skip
        inside = CheckpointCallback(10, str(tmp_path / folder), name_prefix="often")
        every = EveryNTimesteps(40, CheckpointCallback(1, str(tmp_path / folder), name_prefix="every"))
        return [CallbackList([evaluation, inside]), every]

    train(make(), tmp_path / "checkpoints", *callbacks("old"))
    new = callbacks("new")
    resume(
        tmp_path / "checkpoints",
        make_env(),
        [TrainingCheckpoint(32, tmp_path / "checkpoints"), *new, Stop(float("inf"))],
        device="cpu",
    )
    (evaluation, inside), every = new[0].callbacks, new[1]
    whole = callbacks("whole")
    make().learn(STEPS, whole)
    (expected, expected_inside), expected_every = whole[0].callbacks, whole[1]
    assert (inside.n_calls, every.n_calls, evaluation.n_calls) == (STEPS,) * 3
    assert every.last_time_trigger == expected_every.last_time_trigger
    assert evaluation.evaluations_timesteps == expected.evaluations_timesteps == [30, 60, 90, 120, 150]
    assert evaluation.evaluations_results == expected.evaluations_results
    assert evaluation.best_mean_reward == expected.best_mean_reward
    assert Path(evaluation.log_path).parent == tmp_path / "new"

    def files(folder):
        return {file.name for file in (tmp_path / folder).glob("*_steps.zip")}

    # From the checkpoint on, and with the old counters
    assert files("new") == {name for name in files("whole") if int(name.split("_")[1]) > NEWEST}
    assert files("old") | files("new") == files("whole")
    assert inside.save_path == str(tmp_path / "new") and expected_inside.save_freq == inside.save_freq


def test_lambda_of_the_callback_form(tmp_path):
    def churn():
        return CChainCallback(churn_warmup=2, churn_window=3)

    train(make(), tmp_path, churn())
    resumed, whole = churn(), churn()
    checkpoint = TrainingCheckpoint(32, tmp_path)
    model = resume(tmp_path, make_env(), [checkpoint, resumed, Stop(float("inf"))], device="cpu")
    assert_same(model, make().learn(STEPS, whole))
    found, expected = resumed.churn_reducer.coefficient, whole.churn_reducer.coefficient
    assert found.value == expected.value and found.n_seen == expected.n_seen > 4
    assert all(th.equal(found.state_dict()[name], value) for name, value in expected.state_dict().items())


def test_resume_from_keeps_the_settings(tmp_path):
    make().learn(32, TrainingCheckpoint(16, tmp_path, keep=5, exact=False))
    found = TrainingCheckpoint.resume_from(find_checkpoint(tmp_path))
    assert (found.save_freq, found.keep, found.exact) == (16, 5, False)


def test_the_second_task_sequence_of_a_training_goes_on(tmp_path):
    def make(offset_seed):
        return gym.make("Continual/CartPole-v1", n_tasks=2, steps_per_task=32, offset_seed=offset_seed)

    model = CChainPPO("MlpPolicy", make(0), n_steps=16, batch_size=8, device="cpu", seed=0).learn(64, TaskSignal())
    model.set_env(make(1))
    model.learn(64, [TaskSignal(), TrainingCheckpoint(32, tmp_path)], reset_num_timesteps=False)
    resumed = resume(tmp_path, make(1), TaskSignal())
    assert resumed.continual_returns == model.continual_returns
    assert {row["task_id"] for row in resumed.continual_returns} == {0, 1, 2, 3}
    with pytest.raises(ValueError, match="The training that was saved differs from this one: environment was"):
        resume(tmp_path, make(2), TaskSignal())
