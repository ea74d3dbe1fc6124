"""``sb3-cchain inspect``: saved models, looked at after the fact."""

import hashlib
import json
import sys

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import CheckpointCallback, ConvertCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.save_util import save_to_zip_file

import sb3_cchain.zoo.__main__
import sb3_cchain.zoo.inspect
from sb3_cchain import CChainCallback, CChainDQN, CChainPPO, ContinualMetrics, DoubleDQN, TaskSignal, TaskSync
from sb3_cchain.analysis import EvalAllTasks, EvalTrainedTask, NetworkHealth
from sb3_cchain.analysis.inspection import inspect_model
from sb3_cchain.analysis.inspection_report import report
from sb3_cchain.analysis.saved_algorithm import algorithm_of
from sb3_cchain.callbacks import TaskLearningStarts
from sb3_cchain.checkpoint.training_checkpoint import TrainingCheckpoint
from sb3_cchain.envs import TaskVecNormalize
from sb3_cchain.methods import Oracle
from sb3_cchain.zoo.inspect import _forget_task

OF_PPO = dict(n_steps=32, batch_size=16)
OF_DQN = dict(learning_starts=10, buffer_size=100)
ALGORITHMS = {PPO: OF_PPO, CChainPPO: OF_PPO, DQN: OF_DQN, DoubleDQN: OF_DQN, CChainDQN: OF_DQN}


def make(algorithm, env="CartPole-v1"):
    settings = ALGORITHMS.get(algorithm, {})
    return algorithm("MlpPolicy", env, policy_kwargs=dict(net_arch=[8]), seed=0, device="cpu", **settings)


OF_ALL = {"ntk/srank", "ntk/off_diagonal_sum", "health/dormant_share", "health/weight_norm", "health/gradient_norm"}
OF_ALL |= {"churn_monitor/fresh/value_churn", "churn_monitor/fresh/greedy_action_changes", "rollout/mean_return"}


def inspect(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["sb3-cchain", "inspect", *map(str, arguments)])
    sb3_cchain.zoo.__main__.main()


@pytest.mark.parametrize("algorithm", list(ALGORITHMS))
def test_from_the_command_line(algorithm, tmp_path, monkeypatch, capsys):
    path, output = tmp_path / "model.zip", tmp_path / "output"
    make(algorithm).learn(64).save(path)
    before = hashlib.sha256(path.read_bytes()).hexdigest()
    inspect(monkeypatch, path, "--env", "CartPole-v1", "--n-steps", 60, "--n-updates", 10, "--output", output)
    assert hashlib.sha256(path.read_bytes()).hexdigest() == before
    assert (output / "inspection.png").stat().st_size > 10_000
    (figures,) = json.loads((output / "inspection.json").read_text())
    assert figures.pop("model") == str(path)
    assert figures.keys() >= OF_ALL
    assert ("churn_monitor/fresh/policy_churn" in figures) == issubclass(algorithm, PPO)
    assert all(np.isfinite(figures[tag]) for tag in OF_ALL)
    # A model does not know how it began unless it was trained with NetworkHealth
    assert not any("distance_from_init" in tag for tag in figures)
    printed = capsys.readouterr().out
    assert f"{algorithm.__name__}, 64 steps of training" in printed
    assert "srank" in printed and "dormant share" in printed


def test_two_models_side_by_side(tmp_path, monkeypatch, capsys):
    model = make(PPO).learn(32, callback=NetworkHealth())
    model.save(tmp_path / "a.zip")
    before = {name: parameter.clone() for name, parameter in model.policy.named_parameters()}
    model.learn(64, reset_num_timesteps=False).save(tmp_path / "b.zip")
    inspect(monkeypatch, tmp_path / "a.zip", tmp_path / "b.zip", "--env", "CartPole-v1", "--output", tmp_path)
    a, b = json.loads((tmp_path / "inspection.json").read_text())
    assert 0 < a["health/distance_from_init"] < b["health/distance_from_init"]
    moved = sum(((p - before[name]) ** 2).sum() for name, p in model.policy.named_parameters()).sqrt().item()
    printed = capsys.readouterr().out
    rows = [line.split("│") for line in printed.splitlines() if line.startswith("│ together ")]
    assert float(rows[0][2]) == pytest.approx(moved, rel=1e-3)


def test_equals_what_the_monitors_log_in_training_that_goes_on(tmp_path):
    """The report's numbers are those of the next iteration of the same training."""
    model = make(PPO).learn(64)
    model.save(tmp_path / "model")
    reports = []
    for _ in range(2):
        loaded = PPO.load(tmp_path / "model", env=make_vec_env("CartPole-v1", seed=3), device="cpu")
        loaded.set_random_seed(3)
        reports.append(inspect_model(loaded))
    assert reports[0].figures == reports[1].figures
    assert th.equal(reports[0].ntk, reports[1].ntk)
    assert reports[0].figures["rollout/n_steps"] == 32
    norm = sum((parameter.double() ** 2).sum() for parameter in model.policy.parameters()).sqrt().item()
    assert reports[0].figures["health/weight_norm"] == pytest.approx(norm)
    assert len(report(reports)) == 6


@pytest.mark.parametrize("algorithm", [PPO, CChainPPO])
def test_task_of_a_continual_environment(algorithm, tmp_path, monkeypatch, capsys):
    env = make_vec_env("Continual/CartPole-v1", env_kwargs=dict(n_tasks=3, steps_per_task=32))
    make(algorithm, env).learn(64).save(tmp_path / "model.zip")
    seen = []
    original = sb3_cchain.zoo.inspect.inspect_model

    def spy(model, *args):
        inspection = original(model, *args)
        seen.append(model.env.get_attr("task_id")[0])
        return inspection

    monkeypatch.setattr("sb3_cchain.zoo.inspect.inspect_model", spy)
    arguments = (tmp_path / "model.zip", "--env", "Continual/CartPole-v1", "--output", tmp_path)
    kwargs = ("--env-kwargs", "n_tasks:3", "steps_per_task:50")
    inspect(monkeypatch, *arguments, *kwargs)
    assert seen == [1]  # steps 64 to 96
    inspect(monkeypatch, *arguments, *kwargs, "--task", 0)
    assert seen[-1] == 0
    for env_id, task, message in (
        ("CartPole-v1", 0, "unexpected keyword argument"),
        ("Continual/CartPole-v1", 9, "first_task"),
    ):
        with pytest.raises(SystemExit):
            inspect(monkeypatch, tmp_path / "model.zip", "--env", env_id, "--task", task, "--env-kwargs", "n_tasks:3")
        assert message in capsys.readouterr().err


def make_continual_env(**kwargs):
    return make_vec_env("Continual/CartPole-v1", env_kwargs={"n_tasks": 3, "steps_per_task": 32, **kwargs})


@pytest.mark.parametrize("algorithm", [PPO, CChainPPO])
def test_a_model_of_two_task_sequences(algorithm):
    model = make(algorithm, make_continual_env()).learn(64, [TaskSync(), TaskSignal()])
    model.set_env(make_continual_env(offset_seed=1, n_tasks=4))
    model.learn(32, [TaskSync(), TaskSignal()], reset_num_timesteps=False)
    sequence = model.trained_sequence
    inspect_model(model)
    # 64 steps after the beginning of the second one
    assert model.env.get_attr("task_id") == [2] and model.trained_sequence == sequence
    # In other tasks than it was trained in
    model.set_env(make_continual_env(offset_seed=2))
    inspect_model(model)
    assert model.trained_sequence == sequence


@pytest.mark.parametrize(
    "make_callback",
    [
        lambda folder: ContinualMetrics(folder / "returns.csv"),
        lambda folder: EvalAllTasks(make_continual_env(), n_eval_episodes=1, path=folder / "returns.csv"),
        lambda folder: EvalTrainedTask(make_continual_env(), n_eval_episodes=1, path=folder / "returns.csv"),
        lambda folder: EvalCallback(make_continual_env(), eval_freq=16, best_model_save_path=str(folder), verbose=0),
        lambda folder: CheckpointCallback(16, str(folder)),
        lambda folder: TrainingCheckpoint(16, folder, exact=False),
    ],
    ids=["ContinualMetrics", "EvalAllTasks", "EvalTrainedTask", "EvalCallback", "CheckpointCallback", "TrainingCheckpoint"],
)
def test_the_files_of_the_training_stay_as_they_are(make_callback, tmp_path):
    def content():
        return {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    model = make(PPO, make_continual_env()).learn(64, callback=[TaskSync(), make_callback(tmp_path)])
    before = content()
    inspect_model(model, callbacks=[make_callback(tmp_path)])
    assert before and content() == before


def n_losses(reduces_churn):
    return int(reduces_churn.churn_reducer.coefficient.n_seen)


@pytest.mark.parametrize(
    "algorithm, make_callback, count, expected",
    [
        (PPO, Oracle, lambda _, callback: callback.n_resets, 0),
        (DQN, lambda: TaskLearningStarts(100), lambda model, _: model._n_updates, 3),
        # Of the last iteration, and of the inspection's
        (CChainPPO, TaskSync, lambda model, _: n_losses(model), 2),
        (PPO, lambda: CChainCallback(reset_churn_coef=True), lambda _, callback: n_losses(callback), 2),
    ],
    ids=["Oracle", "TaskLearningStarts", "CChainPPO", "CChainCallback"],
)
def test_to_choose_a_task_is_no_switch(algorithm, make_callback, count, expected, tmp_path, monkeypatch):
    model = make(algorithm, make_continual_env())
    model.reset_churn_coef = True
    model.learn(64, callback=[TaskSync(), make_callback()]).save(tmp_path / "model.zip")
    loaded, original = [], sb3_cchain.zoo.inspect.load_as_trained

    def load(*args):
        loaded.extend([original(*args)[0], make_callback()])
        return loaded[0], loaded[1:]

    monkeypatch.setattr("sb3_cchain.zoo.inspect.load_as_trained", load)
    arguments = ("--env", "Continual/CartPole-v1", "--output", tmp_path, "--env-kwargs", "n_tasks:3")
    inspect(monkeypatch, tmp_path / "model.zip", *arguments, "--task", 0, "--n-steps", 32, "--n-updates", 3)
    assert count(*loaded) == expected


def test_the_statistics_stay_where_a_task_is_chosen():
    env = TaskVecNormalize(make_continual_env())
    model = make(PPO, env).learn(64, TaskSync())
    count = env.obs_rms.count
    _forget_task(model, [])
    env.env_method("set_task", 0)
    env.reset()
    assert env.obs_rms.count == count + 1


def test_a_callback_that_ends_the_training_at_once():
    inspection = inspect_model(make(PPO), callbacks=[ConvertCallback(lambda *_: False)])
    assert inspection.ntk is None and inspection.findings == [] and len(report([inspection])) == 1


@pytest.mark.parametrize("option", ["--n-steps", "--n-updates"])
def test_numbers_are_checked_before_work_starts(option, tmp_path, monkeypatch, capsys):
    with pytest.raises(SystemExit):
        inspect(monkeypatch, tmp_path / "no model", "--env", "CartPole-v1", option, 0)
    assert f"{option} must be at least 1; got 0" in capsys.readouterr().err


def test_model_of_rl_zoo(tmp_path, monkeypatch):
    """Wrappers, arguments and statistics are those of training."""
    settings = tmp_path / "settings.yml"
    settings.write_text(
        "Continual/CartPole-v1:\n"
        "  policy: MlpPolicy\n  n_timesteps: 64\n  n_envs: 2\n  n_steps: 32\n  batch_size: 32\n  normalize: True\n"
        "  env_wrapper:\n    - sb3_cchain.envs.RewardScale:\n        scale: 0.5\n"
        "  callback:\n    - sb3_cchain.callbacks.EpisodicRollouts\n    - sb3_cchain.ChurnMonitor\n"
        f"    - rl_zoo3.callbacks.SaveVecNormalizeCallback:\n        save_freq: 16\n        save_path: {tmp_path}/statistics\n"
        "  normalize_advantage: False\n"
    )
    monkeypatch.setattr(
        sys,
        "argv",
        "sb3-cchain train --algo ppo --env Continual/CartPole-v1 --device cpu --seed 0 --eval-freq -1".split()
        + f"-conf {settings} -f {tmp_path} --env-kwargs n_tasks:2".split(),
    )
    sb3_cchain.zoo.__main__.main()
    seen = []
    original = sb3_cchain.zoo.inspect.inspect_model
    monkeypatch.setattr(
        "sb3_cchain.zoo.inspect.inspect_model", lambda m, *args: (seen.append((m.env, args[-1])), original(m, *args))[1]
    )
    path = tmp_path / "ppo" / "Continual-CartPole-v1_1" / "Continual-CartPole-v1.zip"
    inspect(monkeypatch, path, "--env", "Continual/CartPole-v1", "--output", tmp_path)
    ((env, callbacks),) = seen
    assert [type(callback).__name__ for callback in callbacks] == ["EpisodicRollouts", "ChurnMonitor"]
    assert env.num_envs == 2
    assert env.get_attr("n_tasks") == [2, 2]
    assert env.training and env.norm_reward and env.obs_rms.count > 64
    assert any(type(wrapper).__name__ == "RewardScale" for wrapper in _wrappers(env.venv.envs[0]))


def _wrappers(env):
    while hasattr(env, "env"):
        yield env
        env = env.env


def test_errors(tmp_path, monkeypatch, capsys):
    with pytest.raises(SystemExit):
        inspect(monkeypatch, tmp_path / "none.zip", "--env", "CartPole-v1")
    assert "no such file" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        inspect(monkeypatch, "a.zip", "b.zip", "c.zip", "--env", "CartPole-v1")
    assert "two to compare; got 3" in capsys.readouterr().err
    make(PPO).save(tmp_path / "model")
    for arguments, message in (
        (["--env", "NoSuchEnv-v0"], "NoSuchEnv"),
        (["--env", "Pendulum-v1"], "spaces do not match"),
        (["--env", "CartPole-v1", "--algo", "no_such"], "invalid choice"),
    ):
        with pytest.raises(SystemExit):
            inspect(monkeypatch, tmp_path / "model.zip", *arguments)
        assert message in capsys.readouterr().err
    model = make(DQN)
    with pytest.raises(ValueError, match=r"`n_updates` must be .* got 0"):
        inspect_model(model, n_updates=0)


def test_models_that_cannot_be_inspected():
    without_env = make(PPO)
    without_env.env = None
    with pytest.raises(ValueError, match=r"has no environment: load it with one, PPO\.load\(path, env\)"):
        inspect_model(without_env)


@pytest.mark.parametrize("data", [None, {}, {"policy_class": "PPO"}])
def test_files_that_hold_no_model(data, tmp_path):
    save_to_zip_file(tmp_path / "model.zip", data=data)
    with pytest.raises(ValueError, match=r"model\.zip is not a model saved by Stable-Baselines3"):
        algorithm_of(tmp_path / "model.zip")


def test_schedules_stay_where_they_were(tmp_path, monkeypatch, capsys):
    def at(share):
        model = PPO("MlpPolicy", "CartPole-v1", learning_rate=lambda progress: 1e-2 * progress, seed=0, device="cpu", **OF_PPO)
        model.learn(128, callback=lambda local, _: local["self"].num_timesteps < 128 * share)
        model.save(tmp_path / f"at_{share}.zip")
        return tmp_path / f"at_{share}.zip"

    halfway, end = at(0.5), at(2.0)
    inspect(monkeypatch, halfway, end, "--env", "CartPole-v1", "--output", tmp_path)
    a, b = json.loads((tmp_path / "inspection.json").read_text())
    assert a["churn_monitor/fresh/value_churn"] > 0
    assert b["churn_monitor/fresh/value_churn"] == 0
    assert "B was saved when its learning rate had come down to 0" in capsys.readouterr().out


def test_models_with_nothing_in_common():
    reports = []
    for net_arch in ([8], [4]):
        model = PPO("MlpPolicy", "CartPole-v1", policy_kwargs=dict(net_arch=net_arch), seed=0, device="cpu", **OF_PPO)
        reports.append(inspect_model(model))
    distances = report(reports)[-1]
    rows = dict(zip(*(list(column.cells) for column in distances.columns), strict=True))
    assert rows.pop("together") == ""
    assert set(rows.values()) == {"not of the same shape"}


@pytest.mark.parametrize("algorithm", [PPO, DQN])
def test_a_model_goes_on_with_its_own_settings_and_logger(algorithm, tmp_path):
    model = make(algorithm).learn(64)
    logger = configure(str(tmp_path), ["csv"])
    model.set_logger(logger)
    settings = {
        name: vars(model).get(name) for name in ("train_freq", "gradient_steps", "learning_starts", "_stats_window_size")
    }
    model.ep_success_buffer.append(True)
    episodes = list(model.ep_info_buffer)
    inspect_model(model, n_steps=16, n_updates=2)
    assert settings == {name: vars(model).get(name) for name in settings}
    assert model.logger is logger and list(model.ep_info_buffer) == episodes
    assert list(model.ep_success_buffer) == [True] and model.ep_success_buffer.maxlen == 100
    model.learn(64, log_interval=1, reset_num_timesteps=False)
    assert "rollout/ep_rew_mean" in (tmp_path / "progress.csv").read_text()


def test_a_model_that_has_not_been_trained_logs_as_ever(tmp_path):
    model = PPO("MlpPolicy", "CartPole-v1", tensorboard_log=str(tmp_path), device="cpu", **OF_PPO)
    inspect_model(model)
    model.learn(64, reset_num_timesteps=False)
    assert len(list(tmp_path.rglob("events.*"))) == 1
