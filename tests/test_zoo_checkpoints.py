"""Checkpoints of ``sb3-cchain train``, and training that goes on exactly from them."""

import os
import shlex
import shutil
import signal
from unittest import mock

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise

from sb3_cchain import CChainPPO, DoubleDQN
from sb3_cchain.callbacks import read_returns
from sb3_cchain.checkpoint import resumable_env, saved_timesteps
from sb3_cchain.checkpoint.training_checkpoint import TrainingCheckpoint
from sb3_cchain.zoo.training_record import plain
from tests.zoo_command import FAST, NO_EVALUATION, SHORT_PPO, command

ENV = "Continual/CartPole-v1"
NAME = "Continual-CartPole-v1"
EVALUATION = ("--eval-freq", "48", "--eval-episodes", "2")
CALLBACKS = "callback:['sb3_cchain.TaskSync', 'sb3_cchain.ContinualMetrics']"
SHORT_DQN = (
    *("-params", "learning_starts:20", "buffer_size:150", "train_freq:8", "policy_kwargs:dict(net_arch=[8])", CALLBACKS),
)


class Killed(BaseException):
    """In the place of a signal that ends the process."""


def train(folder, *arguments, n=192, algo="ppo_cchain", seed=("--seed", "0"), evaluation=EVALUATION, params=SHORT_PPO):
    command(
        *("train", "--algo", algo, "--env", ENV, "-f", folder / "logs", "-tb", folder / "tb", *FAST, *seed, "-n", n),
        *(*evaluation, "--env-kwargs", "steps_per_task:64", "n_tasks:3", *arguments, *params),
    )


def run_folder(folder, number, algo="ppo_cchain"):
    return folder / "logs" / algo / f"{NAME}_{number}"


def returns_file(folder, number, cls=CChainPPO):
    return folder / "tb" / NAME / f"{cls.__name__}_{number}" / "returns.csv"


@pytest.fixture
def at_step(monkeypatch):
    """Does something at a step of training with checkpoints, once."""

    def set_action(step, action):
        def on_step(self):
            if self.num_timesteps == step:
                monkeypatch.setattr(TrainingCheckpoint, "_on_step", lambda self: True)
                action()
            return True

        monkeypatch.setattr(TrainingCheckpoint, "_on_step", on_step)

    return set_action


def kill():
    raise Killed


def origin_of(run):
    """The checkpoint that a run went on from."""
    return (run / (run / "resumed_from").read_text().strip()).resolve()


def content(folder):
    """Of all files in it."""
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def assert_same_end(folder, one, other, cls=CChainPPO, algo="ppo_cchain"):
    assert returns_file(folder, one, cls).read_bytes() == returns_file(folder, other, cls).read_bytes()
    models = [cls.load(run_folder(folder, number, algo) / f"{NAME}.zip", device="cpu") for number in (one, other)]
    assert models[0].num_timesteps == models[1].num_timesteps
    for parameter, same in zip(*(model.policy.parameters() for model in models), strict=True):
        assert th.equal(parameter, same)
    evaluations = [run_folder(folder, number, algo) / "evaluations.npz" for number in (one, other)]
    assert evaluations[0].exists() == evaluations[1].exists()
    if evaluations[0].exists():
        first, second = (dict(np.load(path)) for path in evaluations)
        assert first.keys() == second.keys() and all((first[name] == second[name]).all() for name in first)


@pytest.mark.parametrize(
    "algo, cls, options, params",
    [
        ("ppo_cchain", CChainPPO, ["--save-freq", "48"], [*SHORT_PPO, "normalize:True"]),
        ("ppo_cchain", CChainPPO, ["--vec-env", "subproc"], SHORT_PPO),
        ("double_dqn", DoubleDQN, [], SHORT_DQN),
    ],
    ids=["normalised", "subproc", "off-policy"],
)
def test_training_that_was_killed_goes_on_exactly(tmp_path, at_step, algo, cls, options, params):
    arguments = dict(algo=algo, params=params)
    train(tmp_path, *options, **arguments)
    at_step(140, kill)
    with pytest.raises(Killed):
        train(tmp_path, *options, "--checkpoint-freq", 32, "--checkpoint-keep", 3, **arguments)
    killed = run_folder(tmp_path, 2, algo)
    folders = [path.name for path in sorted((killed / "checkpoints").glob("step_*"))]
    assert len(folders) == 3 and not (killed / f"{NAME}.zip").exists()
    before = content(killed)
    # A random seed, if none is given, would be another training
    train(tmp_path, *options, "--resume", killed, seed=(), **arguments)
    assert_same_end(tmp_path, 1, 3, cls, algo)
    assert content(killed) == before
    resumed = run_folder(tmp_path, 3, algo)
    assert origin_of(resumed) == killed / "checkpoints" / folders[-1]
    # As many and as often as before
    assert len(list((resumed / "checkpoints").glob("step_*"))) >= 1
    # Once more, from an older one, less often
    train(tmp_path, *options, "--resume", killed / "checkpoints" / folders[0], "--checkpoint-freq", 1000, **arguments)
    assert_same_end(tmp_path, 1, 4, cls, algo)
    assert not list((run_folder(tmp_path, 4, algo) / "checkpoints").glob("step_*"))


def test_the_best_model_and_evaluations_come_along(tmp_path, at_step):
    """At once, in case that the training is killed before the next evaluation."""
    params = (*SHORT_PPO, "normalize:True")
    train(tmp_path, "--checkpoint-freq", 32, params=params)
    finished, come = run_folder(tmp_path, 1), []
    at_step(161, lambda: come.extend(run_folder(tmp_path, 2).rglob("*.*")))
    # Though the training is finished, one may go on from a checkpoint of it
    train(tmp_path, "--resume", finished / "checkpoints" / "step_000000000160", params=params)
    assert {"evaluations.npz", "best_model.zip", "vecnormalize.pkl"} <= {path.name for path in come}
    steps = np.load(run_folder(tmp_path, 2) / "evaluations.npz")["timesteps"].tolist()
    assert steps == [48, 96, 144, 192]


@pytest.mark.parametrize("number, code", [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_training_that_is_told_to_stop_says_how_to_go_on(tmp_path, at_step, capsys, number, code):
    train(tmp_path, evaluation=NO_EVALUATION)
    at_step(100, lambda: os.kill(os.getpid(), number))
    with pytest.raises(SystemExit) as stopped:
        train(tmp_path, "--checkpoint-freq", 1000, evaluation=NO_EVALUATION)
    assert stopped.value.code == code
    # The rollout is completed. On Ctrl-C RL Zoo saves the model, too
    folder = run_folder(tmp_path, 2)
    assert [path.name for path in (folder / "checkpoints").glob("step_*")] == ["step_000000000128"]
    assert (folder / f"{NAME}.zip").exists() == (number == signal.SIGINT)
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("Go on:")]
    assert line.endswith(f"--resume {folder}")
    command(*shlex.split(line)[3:])  # without "Go on: sb3-cchain"
    assert_same_end(tmp_path, 1, 3)


def test_a_finished_training_says_so_and_can_be_made_longer(tmp_path, capsys):
    train(tmp_path, "--checkpoint-freq", 64, n=128, evaluation=NO_EVALUATION)
    run = run_folder(tmp_path, 1)
    with pytest.raises(SystemExit) as finished:
        train(tmp_path, "--resume", run, n=128, evaluation=NO_EVALUATION)
    assert finished.value.code == 0
    assert f"The training in {run} is finished: it made 128 of 128 steps." in capsys.readouterr().out
    assert not run_folder(tmp_path, 2).exists()
    train(tmp_path, "--resume", run, n=192, evaluation=NO_EVALUATION)
    assert saved_timesteps(run_folder(tmp_path, 2) / f"{NAME}.zip") == 192
    rows = read_returns(returns_file(tmp_path, 2))
    assert rows[: len(read_returns(returns_file(tmp_path, 1)))] == read_returns(returns_file(tmp_path, 1))
    assert rows[-1]["timesteps"] == 192


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    """A run folder with checkpoints, of training that is not finished."""
    folder = tmp_path_factory.mktemp("checkpoints")
    train(folder, "--checkpoint-freq", 32, n=96, evaluation=NO_EVALUATION)
    os.remove(run_folder(folder, 1) / f"{NAME}.zip")
    return run_folder(folder, 1)


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(seed=("--seed", "7")), r"had --seed 0, not 7\. Give the options that it had"),
        (dict(algo="ppo"), r"had --algo ppo_cchain, not ppo; .*target_churn_ratio 10000.0, not None"),
        (dict(params=(*SHORT_PPO, "gamma:0.5")), r"had gamma 0.99, not 0.5\. Give"),
        (dict(params=(*SHORT_PPO[:-1], "policy_kwargs:dict(net_arch=[9])")), r"had policy_kwargs {'net_arch': \[8\]}, not "),
        (dict(params=(*SHORT_PPO, "target_kl:0.3")), r"had target_kl None, not 0.3\. Give"),
        (dict(evaluation=EVALUATION), r"had --eval-freq -1, not 48; --eval-episodes 5, not 2"),
        (dict(evaluation=(*NO_EVALUATION, "--save-freq", "32")), r"had --save-freq -1, not 32\. Give"),
        (
            dict(evaluation=(*NO_EVALUATION, "--eval-env-kwargs", "n_tasks:3")),
            r"had --eval-env-kwargs None, not {'n_tasks': 3}\. Give",
        ),
    ],
)
def test_another_training_is_refused(checkpoints, tmp_path, changes, message):
    with pytest.raises(SystemExit, match=f"--resume: the training in {checkpoints}.* {message}"):
        train(tmp_path, "--resume", checkpoints, **{"evaluation": NO_EVALUATION, **changes})
    assert list(tmp_path.iterdir()) == []


def test_another_device_is_refused(checkpoints, tmp_path):
    with pytest.raises(SystemExit, match=r"--resume: `device` must be cpu, on which .* was trained; got cuda"):
        train(tmp_path, "--resume", checkpoints, "--device", "cuda", evaluation=NO_EVALUATION)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "options, message",
    [
        (["--checkpoint-freq", "0"], "--checkpoint-freq must be at least 1; got 0"),
        (["--checkpoint-freq", "8", "--checkpoint-keep", "0"], "--checkpoint-keep must be at least 1; got 0"),
        (["--checkpoint-keep", "2"], "give --checkpoint-freq STEPS, too"),
        (["--checkpoint-inexact"], "--checkpoint-inexact is about checkpoints: give --checkpoint-freq STEPS, too"),
        (["--checkpoint-freq", "8", "-optimize"], "--checkpoint-freq does not go with -optimize"),
        (["--resume", "{}", "-optimize"], "--resume does not go with -optimize"),
        (["--resume", "{}", "-i", "model.zip"], r"--resume and -i are both given, .* and model.zip: --resume goes on exactly"),
        (["--resume", "nowhere"], "--resume: nowhere is not a checkpoint"),
        (["--resume", "last"], "--resume last begins a training where .*: give --checkpoint-freq STEPS, too"),
    ],
)
def test_options_that_cannot_be_are_refused_before_any_work(checkpoints, tmp_path, options, message):
    with pytest.raises(SystemExit, match=message):
        train(tmp_path, *[option.format(checkpoints) for option in options])
    assert list(tmp_path.iterdir()) == []


def test_one_command_begins_and_goes_on_until_the_training_is_finished(tmp_path, at_step, capsys):
    """As a job that a cluster kills and starts again."""
    train(tmp_path)
    job = ("--checkpoint-freq", 32, "--resume", "last")
    for step in (20, 80, 90, 120):
        at_step(step, kill)
        with pytest.raises(Killed):
            train(tmp_path, *job)
    at_step(0, kill)
    train(tmp_path, *job)
    assert_same_end(tmp_path, 1, 6)
    origins = [run_folder(tmp_path, number) / "resumed_from" for number in range(2, 7)]
    # Killed before its first checkpoint, the first job begins again; the third one made none of its own
    assert [origin.exists() for origin in origins] == [False, False, True, True, True]
    steps = [int(origin.read_text().rpartition("_")[2]) for origin in origins[2:]]
    assert steps == [64, 64, 96]
    capsys.readouterr()
    with pytest.raises(SystemExit) as finished:
        train(tmp_path, *job)
    assert finished.value.code == 0 and "is finished: it made 192 of 192 steps" in capsys.readouterr().out


def test_the_last_run_is_that_of_the_environment_and_the_algorithm(checkpoints, tmp_path):
    parent = tmp_path / "logs" / "ppo_cchain"
    for name in (f"{NAME}_9", f"{NAME}_10", f"{NAME}-slippery_11"):
        shutil.copytree(checkpoints, parent / name)
    (parent / f"{NAME}_12").mkdir()
    train(tmp_path, "--checkpoint-freq", 32, "--resume", "last", n=160, evaluation=NO_EVALUATION)
    assert origin_of(run_folder(tmp_path, 13)).is_relative_to(f"{parent / NAME}_10")


def test_a_log_folder_that_was_moved(tmp_path, at_step):
    """The second run, killed before it made a checkpoint, went on from one of the first."""
    job = ("--checkpoint-freq", 64, "--resume", "last")
    for where, step in ((tmp_path / "old", 80), (tmp_path / "old", 90)):
        at_step(step, kill)
        with pytest.raises(Killed):
            train(where, *job)
    shutil.copytree(tmp_path / "old", tmp_path / "new")
    at_step(0, kill)
    train(tmp_path / "new", *job)
    (saved,) = run_folder(tmp_path / "new", 1).glob("checkpoints/step_*")
    origin = run_folder(tmp_path / "new", 3) / "resumed_from"
    assert (origin.parent / origin.read_text().strip()).resolve() == saved
    # As a machine that stops may leave it
    os.remove(run_folder(tmp_path / "new", 3) / f"{NAME}.zip")
    shutil.rmtree(run_folder(tmp_path / "new", 3) / "checkpoints")
    origin.write_text("")
    train(tmp_path / "new", *job)
    assert origin_of(run_folder(tmp_path / "new", 4)) == saved


@pytest.mark.parametrize("has_checkpoint", [True, False])
def test_a_run_that_another_process_trains(checkpoints, tmp_path, monkeypatch, has_checkpoint):
    run = tmp_path / "logs" / "ppo_cchain" / f"{NAME}_1"
    if has_checkpoint:
        shutil.copytree(checkpoints, run)
    else:
        (run / "checkpoints").mkdir(parents=True)
    monkeypatch.setattr("fcntl.flock", mock.Mock(side_effect=BlockingIOError))
    with pytest.raises(SystemExit, match=f"--resume last: another process is training in {run}"):
        train(tmp_path, "--checkpoint-freq", 32, "--resume", "last", n=160, evaluation=NO_EVALUATION)


def test_a_run_that_ended_before_its_first_checkpoint(tmp_path, at_step):
    at_step(20, kill)
    with pytest.raises(Killed):
        train(tmp_path, "--checkpoint-freq", 32)
    with pytest.raises(SystemExit, match=f"{run_folder(tmp_path, 1)} ended before its first checkpoint: start it again"):
        train(tmp_path, "--resume", run_folder(tmp_path, 1))


def test_checkpoints_that_the_command_did_not_make(checkpoints, tmp_path):
    shutil.copytree(checkpoints / "checkpoints", tmp_path / "own")
    os.remove(tmp_path / "own" / "command.json")
    with pytest.raises(SystemExit, match=r"were not made by `sb3-cchain train`.*: go on in Python, by sb3_cchain"):
        train(tmp_path, "--resume", tmp_path / "own")


def test_a_torn_checkpoint_is_passed_over(checkpoints, tmp_path):
    shutil.copytree(checkpoints, tmp_path / "run")
    torn = tmp_path / "run" / "checkpoints" / "step_000000000064" / "training.pkl"
    torn.write_bytes(torn.read_bytes()[:100])
    with pytest.warns(UserWarning, match=f"{torn.parent} is damaged: .* An older checkpoint is taken instead"):
        train(tmp_path, "--resume", tmp_path / "run", n=96, evaluation=NO_EVALUATION)
    assert (run_folder(tmp_path, 1) / "resumed_from").read_text().endswith("step_000000000032\n")
    assert saved_timesteps(run_folder(tmp_path, 1) / f"{NAME}.zip") == 96


def test_a_resumed_run_without_a_checkpoint_of_its_own(checkpoints, tmp_path, capsys):
    """It is finished, or was killed before it saved one. Then training goes on from where it went on from."""
    train(tmp_path, "--resume", checkpoints, "--checkpoint-freq", 10**6, n=128, evaluation=NO_EVALUATION)
    for resume in ("last", run_folder(tmp_path, 1)):
        with pytest.raises(SystemExit) as finished:
            train(tmp_path, "--resume", resume, "--checkpoint-freq", 10**6, n=128, evaluation=NO_EVALUATION)
        assert finished.value.code == 0
        told = capsys.readouterr().out
        assert f"The training in {run_folder(tmp_path, 1)} is finished: it made 128 of 128 steps." in told
    os.remove(run_folder(tmp_path, 1) / f"{NAME}.zip")
    train(tmp_path, "--resume", run_folder(tmp_path, 1), n=128, evaluation=NO_EVALUATION)
    assert (run_folder(tmp_path, 2) / "resumed_from").read_text().startswith(str(checkpoints))
    assert saved_timesteps(run_folder(tmp_path, 2) / f"{NAME}.zip") == 128


class Own(BaseCallback):
    """Of the user's code."""

    def _on_step(self):
        return True


def test_objects_in_a_python_file_are_the_same_in_another_process(tmp_path):
    assert plain(
        {"callback": [Own()], "kind": Own, "wrapper": [{Own: {"n": 1}}], "noise": NormalActionNoise(np.zeros(1), np.ones(1))}
    ) == {
        "callback": ["Own"],
        "kind": "Own",
        "wrapper": [{"Own": {"n": 1}}],
        "noise": "NormalActionNoise(mu=[0.], sigma=[1.])",
    }


@pytest.mark.parametrize("options, kept", [((), 3), (("--checkpoint-keep", "1"), 1)])
def test_as_many_checkpoints_stay_as_before(options, kept, tmp_path):
    train(tmp_path, "--checkpoint-freq", 32, "--checkpoint-keep", 3, evaluation=NO_EVALUATION)
    folder = run_folder(tmp_path, 1) / "checkpoints"
    train(tmp_path, "--resume", folder.parent, *options, n=320, evaluation=NO_EVALUATION)
    assert len(list((run_folder(tmp_path, 2) / "checkpoints").glob("step_*"))) == kept


@pytest.mark.parametrize("options", [(), ("--vec-env", "subproc")])
def test_environments_that_cannot_be_resumed_exactly(options, tmp_path, monkeypatch):
    monkeypatch.setattr(resumable_env, "is_inexact", lambda env: True)
    train(tmp_path, *options, "--checkpoint-freq", 32, "--checkpoint-inexact", n=96, evaluation=NO_EVALUATION)
    for number in (1, 2):  # further checkpoints are as the first ones
        with pytest.warns(UserWarning, match="All environments begin new episodes"):
            n = 96 * (number + 1)
            train(tmp_path, *options, "--resume", run_folder(tmp_path, number), n=n, evaluation=NO_EVALUATION)
        assert saved_timesteps(run_folder(tmp_path, number + 1) / f"{NAME}.zip") == n


def test_checkpoints_change_nothing(tmp_path):
    train(tmp_path)
    train(tmp_path, "--checkpoint-freq", 1)
    assert_same_end(tmp_path, 1, 2)


@pytest.mark.parametrize("arguments", [("--help",), ("--algo", "ppo_redo", "-h"), ("--resume", "nowhere", "-h")])
def test_help_lists_the_options(arguments, capsys):
    with pytest.raises(SystemExit) as ended:
        command("train", *arguments)
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    for option in ("--checkpoint-freq STEPS", "--checkpoint-keep N", "--checkpoint-inexact", "--resume PATH", "--n-timesteps"):
        assert option in shown


def test_without_the_options_a_keyboard_interrupt_is_rl_zoos(tmp_path, monkeypatch):
    def interrupted(self, *args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(BaseAlgorithm, "_setup_learn", interrupted)
    train(tmp_path, evaluation=NO_EVALUATION)
    assert (run_folder(tmp_path, 1) / f"{NAME}.zip").exists()
