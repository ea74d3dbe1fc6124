"""The grid: its runs, their results, and that neither is lost or made twice when something dies."""

import ast
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from benchmarks.grid.attempts import Attempt, new_attempt
from benchmarks.grid.executor import RETRIES, LocalBackend, complete, gpu_places
from benchmarks.grid.plan import Rates, grid_runs, run_length
from benchmarks.grid.ray_backend import RayBackend, count_slots
from benchmarks.grid.results import METRIC_PREFIXES, Result, find_result, read_result, read_results, write_result
from benchmarks.grid.run import (
    ROOT,
    Run,
    as_json,
    make_run,
    other_strength,
    paper_methods,
    strength_of,
    suite_methods,
)
from benchmarks.grid.score_table import score_table
from benchmarks.grid.strengths import split_line
from benchmarks.grid.suites import SUITES, task_names
from benchmarks.grid.training import evaluation_metrics, metrics_rows
from benchmarks.grid.view import Failure, Progress, View, duration
from benchmarks.run import main
from sb3_cchain.envs.registration import CONTINUAL_ENVS
from tests.extras import needs_dm_control, needs_procgen
from tests.fake_training import fake_program, save_checkpoint

RUN = Run("gym_control", "Continual/CartPole-v1", "cchain", 0, 2, 800, "smoke")
ROWS = [
    {"timesteps": 800, "task_id": 0, "n_episodes": 4, "mean_return": 20.0},
    {"timesteps": 1600, "task_id": 0, "n_episodes": 2, "mean_return": 30.0},
]


def make_result(folder, run=RUN, **fields):
    """As of a finished run."""
    settings = {name: value for name, value in fields.items() if name in vars(run)}
    changed = replace(run, **settings)
    return Result(
        **{
            **vars(changed),
            "path": run.path_in(folder),
            "task_names": [f"task {task}" for task in range(changed.n_tasks)],
            "hyperparameters": run.settings["hyperparameters"],
            "command": ["sb3-cchain", "train"],
            "versions": {"sb3-cchain": "0", "stable-baselines3": "0", "gymnasium": "0", "torch": "0", "numpy": "0"},
            "git_commit": None,
            "started": "2026-01-01T00:00:00+00:00",
            "finished": "2026-01-01T00:00:10+00:00",
            "seconds": 10.0,
            "peak_memory": None,
            **fields,
        }
    )


# --- Results ------------------------------------------------------------------------------------------------------------


def test_results_are_read_as_they_were_written(tmp_path):
    result = make_result(tmp_path)
    assert result.path == tmp_path / "smoke" / "gym_control" / "Continual-CartPole-v1" / "cchain" / "seed_0"
    write_result(result, ROWS, [{"timesteps": 800, "name": "churn/coef", "value": "1.5"}])
    assert read_results(tmp_path) == read_results(tmp_path / "smoke") == ([result], {})
    assert read_result(result.path) == result == find_result(RUN, tmp_path) and result.steps_per_second == 160.0
    assert result.returns == ROWS and result.metrics == {"churn/coef": [(800, 1.5)]}
    averages = result.task_averages()
    assert averages[0] == 25.0 and averages[1] != averages[1]
    assert sorted(file.name for file in result.path.iterdir()) == ["metrics.csv", "returns.csv", "run.json"]
    assert (result.path / "returns.csv").read_text() == (
        "timesteps,task_id,n_episodes,mean_return\n800,0,4,20.0\n1600,0,2,30.0\n"
    )


def test_json_without_infinity():
    assert as_json({"a": float("inf"), "b": [1.5, (2,)], 3: None}) == {"a": "inf", "b": [1.5, [2]], "3": None}


def test_a_result_is_whole_or_not_there(tmp_path, monkeypatch):
    result = make_result(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", lambda *paths: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            write_result(result, ROWS, [])
    # What it left is no result, and in nobody's way
    assert (
        len(list(result.path.parent.iterdir())) == 1
        and read_results(tmp_path) == ([], {})
        and find_result(RUN, tmp_path) is None
    )
    write_result(result, ROWS, [])
    assert read_results(tmp_path) == ([result], {})


def test_the_first_of_equal_results_stays_and_one_of_other_settings_is_replaced(tmp_path):
    first = make_result(tmp_path)
    write_result(first, ROWS, [])
    write_result(make_result(tmp_path, seconds=99.0), [], [])
    assert read_results(tmp_path) == ([first], {}) and first.returns == ROWS
    other = make_result(tmp_path, steps_per_task=400)
    write_result(other, [], [])
    assert read_results(tmp_path) == ([other], {}) and other.returns == []
    assert [path.name for path in first.path.parent.iterdir()] == ["seed_0"]


@pytest.mark.parametrize("same", [True, False])
def test_writers_at_once_leave_one_whole_result(tmp_path, same):
    results = [make_result(tmp_path, steps_per_task=800 if same else 100 + i) for i in range(16)]
    with ThreadPoolExecutor(16) as pool:
        list(pool.map(lambda result: write_result(result, ROWS, []), results))
    (written,), _ = read_results(tmp_path)
    assert written in results and written.returns == ROWS
    assert [path.name for path in written.path.parent.iterdir()] == ["seed_0"]


def test_a_result_counts_under_its_settings_alone(tmp_path):
    result = make_result(tmp_path)
    write_result(result, ROWS, [])
    # Evaluations besides do not change the training
    assert find_result(RUN, tmp_path) == result == find_result(replace(RUN, eval_freq=5), tmp_path)
    for change in (
        *(dict(seed=1), dict(method="vanilla"), dict(experiment="paper"), dict(n_tasks=3), dict(steps_per_task=801)),
        *(dict(overrides=("n_epochs:1",)), dict(variant="orthogonal")),
    ):
        assert find_result(replace(RUN, **change), tmp_path) is None
    hyperparameters = {**RUN.settings["hyperparameters"], "learning_rate": 1.0}
    write_result(make_result(tmp_path, hyperparameters=hyperparameters), ROWS, [])
    assert find_result(RUN, tmp_path) is None


def test_a_variant_has_a_folder_of_its_own(tmp_path):
    variant = replace(RUN, variant="orthogonal", overrides=("churn_component:'orthogonal'",))
    for run in (RUN, variant):
        write_result(make_result(tmp_path, run), ROWS, [])
    assert find_result(variant, tmp_path).path == tmp_path / "smoke/gym_control/Continual-CartPole-v1/orthogonal/seed_0"
    assert find_result(variant, tmp_path).overrides == variant.overrides and find_result(RUN, tmp_path).line == "cchain"


def test_the_committed_results_count(capsys):
    arguments = ["--suite", "gym_control", "--budget", "reduced", "--method", "cchain", "vanilla", "oracle"]
    arguments += ["--seeds", "0", "1"]
    assert main([*arguments, "--dry-run", "--results", str(ROOT / "benchmarks" / "results")]) == 0
    assert "24 runs, 24 of them done." in capsys.readouterr().out


def test_an_evaluation_after_the_last_rollout_of_a_task_is_of_that_task():
    evaluations = [
        {"timesteps": steps, "task_id": task, "n_episodes": 10, "mean_return": value}
        for steps, task, value in ((0, 0, 1.0), (1024, 0, 2.0), (1536, 0, 4.0), (2048, 1, 1 / 3))
    ]
    rows = evaluation_metrics(evaluations, replace(RUN, steps_per_task=1100))
    assert [(row["timesteps"], row["value"]) for row in rows] == [(0, "1"), (1024, "2"), (1100, "4"), (2048, "0.333333")]


# --- The grid -----------------------------------------------------------------------------------------------------------


def test_methods():
    of_the_paper = ["oracle", "vanilla", "trac", "weight_clipping", "l2_init", "layer_norm", "redo", "adam_rel", "cchain"]
    assert paper_methods("procgen") == of_the_paper
    assert [(name, suite_methods("gym_control")[name].algo) for name in paper_methods("gym_control")] == [
        ("oracle", "ppo_oracle"),
        ("vanilla", "ppo"),
        ("trac", "ppo_trac"),
        ("weight_clipping", "ppo_weight_clipping"),
        ("l2_init", "ppo_l2_init"),
        ("cchain", "ppo_cchain"),
    ]
    minatar = {name: suite_methods("minatar")[name].algo for name in paper_methods("minatar")}
    assert minatar == {"oracle": "double_dqn_oracle", "vanilla": "double_dqn", "cchain": "dqn_cchain"}
    # Methods that the paper does not have, too, but of the suite's algorithm alone
    assert "crelu" in suite_methods("gym_control") and "trac" not in suite_methods("minatar")


def test_the_grid_of_gym_control():
    grid = grid_runs(["gym_control"], budget="reduced")
    assert len(grid) == len(set(grid)) == 4 * 6 * 3
    assert [run.seed for run in grid] == [0] * 24 + [1] * 24 + [2] * 24
    # A suite in 6 hours on two cores
    assert sum(map(Rates([]).seconds, grid)) < 2 * 6 * 3600
    grid = grid_runs(
        ["gym_control"], ["Continual/MountainCar-v0", "Continual/CartPole-v1"], ["cchain", "vanilla", "cchain"], [1, 0, 1]
    )
    assert [(run.seed, run.method, run.env_id, run.n_tasks, run.steps_per_task) for run in grid] == [
        (seed, method, *env)
        for seed in (0, 1)
        for method in ("cchain", "vanilla")
        for env in (("Continual/CartPole-v1", 10, 160_000), ("Continual/MountainCar-v0", 5, 320_000))
    ]
    assert len(grid_runs(["gym_control"], ["Continual/CartPole-v1"], ["vanilla"])) == 6


def test_another_strength_is_a_line_of_its_own(tmp_path):
    cartpole = ["Continual/CartPole-v1"]
    grid = grid_runs(["gym_control"], cartpole, ["cchain@1000", "vanilla", "cchain@0.05", "cchain@1e3", "cchain"], [0, 1])
    assert [(run.seed, run.line, run.method) for run in grid] == [
        (seed, *line)
        for seed in (0, 1)
        for line in (("cchain@1e3", "cchain"), ("vanilla", "vanilla"), ("cchain@0.05", "cchain"), ("cchain", "cchain"))
    ]
    run, plain = grid[0], grid[3]
    assert run.overrides == ("target_churn_ratio:1e3",) and run.arguments(Path("logs"))[-1] == run.overrides[0]
    assert (other_strength(run), other_strength(plain)) == ({"target_churn_ratio": 1000.0}, {})
    assert (strength_of(run), strength_of(plain)) == ("1e3", "1e4")
    assert run.path_in(tmp_path).parts[-2:] == ("cchain@1e3", "seed_0") and run.name == "CartPole-v1 cchain@1e3 seed 0"
    # It takes as long as the shipped one
    result = make_result(tmp_path, replace(plain, n_tasks=1, steps_per_task=100), seconds=50.0)
    assert Rates([result]).seconds(replace(run, n_tasks=1, steps_per_task=200)) == 100.0
    write_result(make_result(tmp_path, run), ROWS, [])
    assert find_result(run, tmp_path).line == "cchain@1e3" and find_result(plain, tmp_path) is None
    # The shipped strength is the method itself
    assert make_run("gym_control", *cartpole, "cchain@10000", 0, 10, 16_000, "reduced") == make_run(
        "gym_control", *cartpole, "cchain", 0, 10, 16_000, "reduced"
    )
    assert [run.line for run in grid_runs(["gym_control"], cartpole, ["cchain@1e4", "vanilla", "cchain"], [0])] == [
        *("cchain", "vanilla")
    ]
    grid = grid_runs(["gym_control"], cartpole, ["cchain@all", "l2_init@all", "cchain"], [0])
    l2_init = ["l2_init@0.1", "l2_init@1", "l2_init", "l2_init@100", "l2_init@1e3"]
    assert [run.line for run in grid] == ["cchain@1e3", "cchain", "cchain@1e5", *l2_init]
    evaluated = make_run("minatar", "Continual/MinAtar-v0", "cchain@0.1", 0, 3, 3000, "smoke")
    assert (evaluated.eval_freq, evaluated.line, evaluated.algo) == (100, "cchain@0.1", "dqn_cchain")


@pytest.mark.parametrize("env_id", ["Continual/CartPole-v1", "Continual/Starpilot-v0"])
@pytest.mark.parametrize(
    "line, shipped, argument", [("weight_clipping@.5", "1", "clip_ratio"), ("l2_init@1000", "10", "coef")]
)
def test_the_strength_of_an_optimizer_is_in_its_arguments(env_id, line, shipped, argument, tmp_path):
    suite = "gym_control" if env_id == "Continual/CartPole-v1" else "procgen"
    run = make_run(suite, env_id, line, 0, 2, 800, "smoke")
    plain = make_run(suite, env_id, run.method, 0, 2, 800, "smoke")
    strength = split_line(run.line)[1]
    assert (strength_of(plain), strength_of(run)) == (shipped, strength) and other_strength(plain) == {}
    # All else is as shipped
    text, shipped_text = other_strength(run)["policy_kwargs"], plain.settings["hyperparameters"]["policy_kwargs"]
    old = next(part for part in (f"{argument}={shipped}.0", f"{argument}={shipped}") if part in shipped_text)
    assert text == shipped_text.replace(old, f"{argument}={strength}") != shipped_text
    # RL Zoo evaluates what is given after --hyperparams, and takes a text for `policy_kwargs`, as in the YAML file
    name, _, value = run.overrides[0].partition(":")
    assert name == "policy_kwargs" and ast.literal_eval(value) == text
    write_result(make_result(tmp_path, run, hyperparameters=run.settings["hyperparameters"]), ROWS, [])
    assert find_result(run, tmp_path).line == run.line and strength_of(find_result(run, tmp_path)) == strength


def test_the_shipped_strengths():
    shipped = {
        (suite, method): {strength_of(Run(suite, env_id, method, 0, 2, 800, "smoke")) for env_id in SUITES[suite].env_ids}
        for suite in ("gym_control", "procgen")
        for method in ("weight_clipping", "l2_init", "cchain")
    }
    assert set(map(tuple, shipped.values())) == {("1",), ("10",), ("1e4",)}
    walker, dog = (Run("dmc", f"Continual/{name}-v0", "cchain", 0, 2, 800, "smoke") for name in ("Walker", "Dog"))
    assert (strength_of(walker), strength_of(dog)) == ("0.5", "0.05")


@pytest.mark.parametrize("number, text", [(1e3, "1e3"), (100, "100"), (0.05, "0.05"), (12345, "12345"), (1 / 3, repr(1 / 3))])
def test_each_strength_has_one_name(number, text):
    assert split_line(f"cchain@{number!r}") == ("cchain", text) and float(text) == number


def test_lengths():
    assert run_length("gym_control", "Continual/Acrobot-v1", "reduced") == (4, 64_000)
    assert run_length("gym_control", "Continual/MountainCar-v0", "reduced") == (2, 128_000)
    assert run_length("minatar", "Continual/MinAtar-v0", "paper") == (3, 1_500_000)
    assert run_length("minatar", "Continual/MinAtar-v0", "reduced") == (3, 150_000)
    assert run_length("minatar", "Continual/MinAtar-v0", "smoke") == (2, 200)


@needs_dm_control
@needs_procgen
def test_the_grid_of_all_suites():
    grid = grid_runs(list(SUITES), budget="paper")
    expected = dict(gym_control=4 * 6 * 6, procgen=16 * 9 * 6, dmc=3 * 3 * 12, minatar=1 * 3 * 12)
    assert {suite: sum(run.suite == suite for run in grid) for suite in expected} == expected
    assert {run.env_id for run in grid} == {f"Continual/{name}" for name in CONTINUAL_ENVS}
    assert all(run.settings["hyperparameters"] for run in grid)


def test_suites_cover_the_environments():
    env_ids = [env_id for suite in SUITES.values() for env_id in suite.env_ids]
    assert sorted(env_ids) == sorted(f"Continual/{name}" for name in CONTINUAL_ENVS)
    expected = dict(gym_control=4, procgen=16, dmc=3, minatar=1)
    assert {name: len(SUITES[name].env_ids) for name in expected} == expected
    for suite in SUITES.values():
        assert suite.demo.env_id in suite.env_ids and "vanilla" in suite.rates


@pytest.mark.parametrize(
    "suite, env_id, names",
    [
        pytest.param("procgen", "Continual/Maze-v0", ("level 20", "level 21"), marks=needs_procgen),
        pytest.param("dmc", "Continual/Walker-v0", ("stand", "walk"), marks=needs_dm_control),
        ("gym_control", "Continual/CartPole-v1", ("task 0", "task 1")),
        ("minatar", "Continual/MinAtar-v0", ("SpaceInvaders", "Asterix")),
    ],
)
def test_names_of_tasks(suite, env_id, names):
    assert task_names(suite, env_id, 2) == names


def test_a_run_is_the_command_that_a_user_would_type():
    arguments = RUN.arguments(Path("logs"))
    assert " ".join(arguments) == (
        "train --algo ppo_cchain --env Continual/CartPole-v1 --seed 0 --n-timesteps 1600 --num-threads 1 --device cpu "
        "--eval-freq -1 --eval-episodes 10 --log-folder logs --tensorboard-log logs/tensorboard --verbose 0 "
        "--env-kwargs steps_per_task:800 n_tasks:2 offset_seed:0"
    )
    overridden = replace(RUN, overrides=("n_epochs:1",)).arguments(Path("logs"), "cuda")
    assert overridden[-2:] == ["--hyperparams", "n_epochs:1"] and overridden[9:13] == [
        "--num-threads",
        "1",
        "--device",
        "cuda",
    ]
    recorded = make_run("procgen", "Continual/Maze-v0", "vanilla", 0, 5, 200_000, "reduced")
    assert recorded.arguments(Path("logs"))[-2:] == ["--hyperparams", "stats_window_size:5"]
    assert "stats_window_size" not in str(recorded.settings)


@pytest.mark.parametrize(
    "suite, env_id, steps, interval, deterministic",
    [
        ("minatar", "Continual/MinAtar-v0", 1_500_000, 50_000, True),
        ("minatar", "Continual/MinAtar-v0", 150_000, 5000, True),
        pytest.param("dmc", "Continual/Walker-v0", 1_000_000, 20_000, False, marks=needs_dm_control),
        # Evaluations of 10 000 steps are not affordable more often
        pytest.param("dmc", "Continual/Walker-v0", 100_000, 20_000, False, marks=needs_dm_control),
        pytest.param("dmc", "Continual/Walker-v0", 4096, 4096, False, marks=needs_dm_control),
    ],
)
def test_evaluations_are_the_papers(suite, env_id, steps, interval, deterministic):
    run = make_run(suite, env_id, "oracle", 0, 2, steps, "paper")
    *_, option, callbacks = run.arguments(Path("logs"))
    sync, evaluation, *others = ast.literal_eval(callbacks.removeprefix("callback:"))
    arguments = {"interval": interval, "n_eval_episodes": 10, "deterministic": deterministic}
    assert option == "--hyperparams" and evaluation == {"sb3_cchain.analysis.EvalTrainedTask": arguments}
    # Before the Oracle's fresh networks; all others as shipped
    assert [sync, *others] == run.settings["hyperparameters"]["callback"] and "Oracle" in str(others)
    # Beside callbacks of the run's own
    own = replace(run, overrides=("callback:['sb3_cchain.TaskSync', 'mine']", "n_epochs:1")).hyperparams
    assert own == ["n_epochs:1", f"callback:{['sb3_cchain.TaskSync', evaluation, 'mine']}"]
    assert run.eval_freq == interval and run.arguments(Path("logs"))[13:15] == ["--eval-freq", "-1"]


@pytest.mark.parametrize(
    "changes, message",
    [
        pytest.param(
            *(
                dict(suite="dmc", env_id="Continual/Walker-v0", n_tasks=5),
                "`n_tasks` must be at most 3, the tasks of .*; got 5",
            ),
            marks=needs_dm_control,
        ),
        (dict(seed=-1), "`seed` must be at least 0; got -1"),
        (dict(steps_per_task=0), "`steps_per_task` must be at least 1; got 0"),
        (dict(env_id="Continual/Maze-v0"), "`env_id` must be one of Continual/CartPole-v1, .*; got Continual/Maze-v0"),
        (dict(method="reset"), "`method` must be one of oracle, vanilla, .*; got reset"),
        (
            dict(suite="minatar", env_id="Continual/MinAtar-v0", method="vanilla", steps_per_task=100, eval_freq=200),
            "between 1 and `steps_per_task`, which is 100; got 200",
        ),
        (
            dict(suite="minatar", env_id="Continual/MinAtar-v0", method="vanilla", steps_per_task=20),
            "between 1 and `steps_per_task`, which is 20; got None",
        ),
    ],
)
def test_runs_that_cannot_be_are_refused(changes, message):
    arguments = {name: getattr(RUN, name) for name in ("suite", "env_id", "method", "seed", "n_tasks", "steps_per_task")}
    with pytest.raises(ValueError, match=message):
        make_run(**{**arguments, "experiment": "smoke", **changes})


@pytest.mark.parametrize(
    "arguments, message",
    [
        (
            ["--env", "Continual/Maze-v0"],
            "--env must be one of Continual/CartPole-v1, .* in gym_control; got Continual/Maze-v0",
        ),
        (["--method", "reset"], "--method must be one of oracle, vanilla, trac, .*, cchain in gym_control; got reset"),
        (["--method", "vanilla@all"], "`method` can have a strength after @ for .* only; got vanilla@all"),
        (["--suite", "dmc", "--method", "cchain@all"], "@all in gym_control and procgen only; got cchain@all in dmc"),
        (["--method", "cchain@x"], "`method` must have β after @, a number greater than 0, as in cchain@10; got cchain@x"),
        (["--method", "cchain@-1"], "a number greater than 0, .*; got cchain@-1"),
        (["--method", "l2_init@0"], "`method` must have c after @, a number greater than 0, as in l2_init@10; got l2_init@0"),
        (
            ["--method", "trac@1"],
            r"a strength after @ for weight_clipping \(κ\), l2_init \(c\), cchain \(β\) only; got trac@1",
        ),
        (["--seeds", "0", "-1"], "`seeds` must be an integer greater than or equal to 0, got -1"),
        (["--gpus-per-run", "-1"], "--gpus-per-run: must be from 0.0001 to 1, or a whole number; got -1"),
        (["--gpus-per-run", "1.5"], "--gpus-per-run: must be .*; got 1.5"),
        (["--gpus-per-run", "1e-5"], "--gpus-per-run: must be .*; got 1e-5"),
        (["--gpus-per-run", "nan"], "--gpus-per-run: must be .*; got nan"),
        (["--gpus-per-run", "half"], "--gpus-per-run: must be .*; got half"),
        (["--results", __file__], "--results must be a folder that can be written to; got .*test_grid.py"),
        (["--cpus", "0"], "--cpus must be at least 1"),
        (["--cpus", "2", "--address", "auto"], "goes without --address"),
        (["--address", "auto"], r'--address needs Ray .*: pip install -e ".\[cluster\]"'),
        (["--gpus-per-run", "99"], "--gpus-per-run must be at most the GPUs of this machine, .*; got 99"),
    ],
)
def test_errors_come_before_any_work(arguments, message, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    folders = ["--results", str(tmp_path / "results"), "--logs", str(tmp_path / "logs")]
    with pytest.raises(SystemExit) as error:
        main(["--suite", "gym_control", *folders, *arguments])
    assert error.value.code == 2 and re.search(message, capsys.readouterr().err)
    assert list(tmp_path.iterdir()) == []


@needs_procgen
def test_an_empty_grid_is_an_error(capsys):
    with pytest.raises(SystemExit):
        main(["--suite", "all", "--method", "parseval", "--env", "Continual/Starpilot-v0"])
    assert "--method must be one with hyperparameters for Continual/Starpilot-v0; got parseval" in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_to_is_found_before_any_work(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(
        "sb3_cchain.checkpoint.files.TemporaryFile", lambda dir: (_ for _ in ()).throw(OSError("Read-only file system"))
    )
    with pytest.raises(SystemExit):
        main(["--suite", "gym_control", "--results", str(tmp_path / "new")])
    expected = f"--results must be a folder that can be written to; got {tmp_path / 'new'}: Read-only file system"
    assert expected in capsys.readouterr().err


def test_a_damaged_result_is_named(tmp_path, capsys):
    RUN.path_in(tmp_path).mkdir(parents=True)
    for text in ("", "{}"):
        (RUN.path_in(tmp_path) / "run.json").write_text(text)
        with pytest.raises(SystemExit):
            main(["--suite", "gym_control", "--budget", "smoke", "--dry-run", "--results", str(tmp_path)])
        assert f"{RUN.path_in(tmp_path) / 'run.json'} is not a result" in capsys.readouterr().err


def test_results_that_will_be_replaced_are_told(tmp_path, capsys):
    result = make_result(tmp_path, hyperparameters={}, seed=0)
    write_result(result, ROWS, [])
    assert main(["--suite", "gym_control", "--budget", "smoke", "--dry-run", "--results", str(tmp_path)]) == 0
    assert f"{result.path} has other hyperparameters, and will be replaced." in capsys.readouterr().out


def test_dry_run(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    arguments = ["--suite", "gym_control", "--env", "Continual/CartPole-v1", "--method", "vanilla", "cchain"]
    arguments += ["--budget", "smoke", "--results", str(tmp_path)]
    write_result(make_result(tmp_path), ROWS, [])
    assert main([*arguments, "--dry-run", "--logs", str(tmp_path / "logs")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == "CartPole-v1 vanilla seed 0 2 x 800 steps 4 s".split()
    assert lines[1].split() == "CartPole-v1 cchain seed 0 2 x 800 steps done in 10 s".split()
    assert lines[2].startswith("2 runs, 1 of them done. The other 1 take 4 s on a core")
    assert lines[3].startswith("1 of the results were made with sb3-cchain 0")
    # A run of which there is a checkpoint: a quarter is left
    (run,) = grid_runs(["gym_control"], ["Continual/CartPole-v1"], ["vanilla"], None, "smoke")
    attempt, _ = new_attempt(run, tmp_path / "logs", None)
    save_checkpoint(attempt.folder, 1200)
    assert main([*arguments, "--dry-run", "--logs", str(tmp_path / "logs")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == "CartPole-v1 vanilla seed 0 2 x 800 steps 1 s; goes on from step 1 200".split()
    assert lines[2].startswith("2 runs, 1 of them done. The other 1 take 1 s on a core")
    # Nothing to do needs no Ray
    write_result(make_result(tmp_path, replace(RUN, method="vanilla")), ROWS, [])
    assert main(arguments) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("All 2 runs are done.") and "Report:  python -m benchmarks.report --budget smoke" in shown


def test_scores_by_hand(tmp_path):
    """J(T) is 25 and 5 of the one method, and -1 of the other."""
    returns = {("cchain", 0): (20.0, 30.0), ("cchain", 1): (10.0, 0.0), ("vanilla", 0): (-3.0, 1.0)}
    for (method, seed), task_returns in returns.items():
        rows = [{**ROWS[0], "task_id": task, "mean_return": value} for task, value in enumerate(task_returns)]
        write_result(make_result(tmp_path, replace(RUN, method=method, seed=seed)), rows, [])
    console = Console(record=True, width=80)
    console.print(score_table(read_results(tmp_path)[0]))
    shown = [line.replace("|", " ").split() for line in console.export_text().splitlines()]
    assert sorted(shown[3:-1]) == [["CartPole-v1", "cchain", "2", "15", "10"], ["CartPole-v1", "vanilla", "1", "-1"]]


# --- Time ---------------------------------------------------------------------------------------------------------------


def test_rates_by_hand(tmp_path):
    acrobot = replace(RUN, env_id="Continual/Acrobot-v1", experiment="reduced")
    paper = replace(RUN, experiment="paper", n_tasks=1, steps_per_task=1000)
    # Nothing known: 510 steps per second, 500 of Vanilla
    assert Rates([]).seconds(paper) == pytest.approx(1000 / 510)
    assert Rates([]).seconds(replace(paper, method="weight_clipping")) == pytest.approx(2.0)
    results = [make_result(tmp_path, RUN, seconds=1000.0), make_result(tmp_path, acrobot, seconds=16.0)]
    results.append(make_result(tmp_path, replace(acrobot, seed=1), seconds=48.0))
    # On another device
    results.append(make_result(tmp_path, replace(paper, seed=2), seconds=1.0, command=["train", "--device", "cuda"]))
    # Of the suite, 3200 steps in 64 seconds, not of smoke runs, though of the same environment
    assert Rates(results).seconds(paper) == pytest.approx(20.0)
    results.append(make_result(tmp_path, replace(RUN, experiment="reduced"), seconds=16.0))
    assert Rates(results).seconds(paper) == pytest.approx(10.0)
    assert Rates(results).seconds(RUN) == pytest.approx(1000.0)


def test_durations():
    assert [duration(seconds) for seconds in (0, 3.2, 61, 89 * 60, 5400, 71 * 3600, 4 * 86400)] == [
        *("0 s", "4 s", "1 min", "89 min", "1.5 h", "71.0 h", "4 days"),
    ]


def test_time_left_by_hand(monkeypatch):
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    some = [replace(RUN, seed=seed, steps_per_task=5100) for seed in range(5)]  # 20 seconds each at 510 steps per second
    console = Console(record=True, width=200)
    view = View(some, n_done=3, rates=Rates([]), console=console)
    view.slots = 2
    assert view.time_left() == pytest.approx(50.0)
    view.start(some[0])
    view.start(some[1])
    now = 115.0
    assert view.time_left() == pytest.approx((5 + 5 + 60) / 2)
    now = 130.0
    view.finish(some[0], 30.0)
    # They take one and a half times as long as estimated: nothing is left of the second
    assert view.time_left() == pytest.approx((0 + 3 * 30) / 2)
    view.fail(Failure(some[1], "ValueError: [no]", "/logs/log.txt", "elsewhere"), again=True)
    assert view.waiting[0] == some[1]
    view.start(some[1])
    view.fail(Failure(some[1], "ValueError: [no]", "/logs/log.txt", "elsewhere"), again=False)
    view.start(some[2])
    view.skip(some[3])
    assert view.time_left() == pytest.approx(30.0)
    now = 140.0
    view.progress = {some[2]: Progress(0.4, "40%, task 1, return -3")}
    # Ten seconds for 40 % of it: 15 for the rest, whatever the estimate
    assert view.time_left() == pytest.approx((15 + 30) / 2)
    console.print(view.render())
    shown = console.export_text().splitlines()
    assert shown[0] == "4 of 8: CartPole-v1 cchain seed 0 done in 30 s, 45 s left"
    failure = "CartPole-v1 cchain seed 1 failed: ValueError: [no]; see elsewhere:/logs/log.txt"
    assert shown[1].strip() == f"{failure} (tried again)"
    assert shown[2].strip() == failure and shown[-1].strip() == failure
    assert shown[3].strip("━╸╺ ") == "5 done (3 before), 1 running, 1 waiting, 1 failed, 23 s left"
    assert shown[4].split() == "CartPole-v1 cchain seed 2 10 s 40%, task 1, return -3 15 s left".split()


def test_an_address_at_which_nothing_answers():
    pytest.importorskip("ray")
    with pytest.raises(ConnectionError, match=r"--address must be that of a Ray cluster; got 127.0.0.1:1: .*refused"):
        RayBackend("127.0.0.1:1")


def test_slots_by_hand():
    assert count_slots({"CPU": 8.0, "GPU": 1.0}, 0.0) == 8
    assert count_slots({"CPU": 8.0, "GPU": 1.0}, 0.25) == 4
    assert count_slots({"CPU": 2.0, "GPU": 1.0}, 0.1) == 2
    assert count_slots({}, 0.0) == 1


def test_places_on_gpus_by_hand():
    assert gpu_places(["0", "1"], 0.5) == ["0", "1", "0", "1"]
    assert gpu_places(["0", "1"], 1.0) == ["0", "1"]
    assert gpu_places(["0", "1", "2", "3", "4"], 2.0) == ["0,1", "2,3"]
    assert gpu_places(["3"], 0.3) == ["3"] * 3


# --- Training -----------------------------------------------------------------------------------------------------------


def silent():
    return Console(file=open(os.devnull, "w"))


def train(runs, folder):
    """With the real command, at the same time. Returns the failures too."""
    with LocalBackend(2) as backend:
        failures = complete(runs, folder / "results", folder / "logs", backend, silent(), retries=0)
    results, left_out = read_results(folder / "results")
    assert left_out == {}
    for result in results:
        assert result.seconds > 0 and result.started < result.finished
        if sys.platform == "linux":
            assert 1e8 < result.peak_memory < 1e10
        text = (result.path / "run.json").read_text()
        assert str(folder) not in text
        assert json.loads(text)["task_boundaries"] == [result.steps_per_task, 2 * result.steps_per_task]
    return results, failures


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run, and one that fails."""
    return train([RUN, replace(RUN, env_id="Continual/Acrobat-v1")], tmp_path_factory.mktemp("trained"))


def test_a_run_and_its_result(trained):
    (result,), _ = trained
    assert result.settings == RUN.settings
    assert [(row["timesteps"], row["task_id"]) for row in result.returns] == [(800, 0), (1600, 1)]
    metrics = result.metrics
    score = SUITES["gym_control"].score.metric
    assert set(metrics) >= {"churn/coef", "churn/policy_churn", score}
    assert all(name.startswith(METRIC_PREFIXES) or name == score for name in metrics)
    # SB3 writes what an update logged with the rollout after it
    assert [steps for steps, _ in metrics["churn/coef"]] == [1600]
    assert result.command[:4] == ["sb3-cchain", "train", "--algo", "ppo_cchain"]
    assert "logs/grid/smoke/gym_control/Continual-CartPole-v1/cchain/seed_0" in result.command
    assert result.hyperparameters["max_grad_norm"] == "inf"


def test_a_failed_run_says_why(trained):
    _, (failure,) = trained
    assert "\n" not in failure.reason and "Acrobot-v1" in failure.reason
    assert failure.run.env_id == "Continual/Acrobat-v1" and failure.reason in Path(failure.log).read_text()
    assert "/smoke/gym_control/Continual-Acrobat-v1/cchain/seed_0/attempt_" in failure.log


@pytest.mark.parametrize(
    "suite, env_id, method, names, changes",
    [
        pytest.param(
            *("procgen", "Continual/Starpilot-v0", "vanilla", ["level 20", "level 21"]),
            # One rollout holds both tasks, and an episode of each
            dict(steps_per_task=120, overrides=("n_steps:240", "batch_size:80", "n_epochs:1")),
            marks=needs_procgen,
        ),
        ("minatar", "Continual/MinAtar-v0", "cchain", ["SpaceInvaders", "Asterix"], {}),
    ],
)
def test_runs_of_the_other_suites(suite, env_id, method, names, changes, tmp_path):
    (run,) = grid_runs([suite], [env_id], [method], budget="smoke")
    run = replace(run, **changes)
    (result,), failures = train([run], tmp_path)
    assert failures == [] and find_result(run, tmp_path / "results") == result
    assert result.task_names == names
    rows = result.returns
    if suite == "minatar":
        assert [tuple(row.values())[:3] for row in rows] == [(0, 0, 10), (200, 0, 10), (400, 1, 10)]
    assert {row["task_id"] for row in rows} <= {0, 1} and rows


def wait_for(condition, what, seconds=300):  # Ray gives its workers the lowest priority
    end = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < end, f"no {what} in {seconds} seconds"
        time.sleep(0.05)
    return value


linux = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")


# --- Execution, by both backends: the training command is another, which starts at once ----------------------------------


@pytest.fixture(scope="module")
def cluster():
    """Two nodes of one core each on this machine."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    cluster.add_node(num_cpus=1)
    yield cluster
    cluster.shutdown()


@pytest.fixture(scope="module")
def ray_backend(cluster):
    with pytest.raises(ValueError, match="--gpus-per-run must be at most the GPUs that Ray finds, 0; got"):
        RayBackend(cluster.address, 0.25)
    with RayBackend(cluster.address) as backend:
        yield backend


@pytest.fixture(params=["local", "ray"])
def backend(request):
    if request.param == "ray":
        yield request.getfixturevalue("ray_backend")
    else:
        with LocalBackend(2) as backend:
            yield backend


def seeds_of_results(folder):
    return sorted(result.seed for result in read_results(folder)[0])


def attempts(run, logs):
    return {path.name for path in run.path_in(logs).glob("attempt_*")}


def test_every_run_comes_to_its_end_or_fails_thrice(tmp_path, backend, monkeypatch):
    """
    Of five seeds, the first is done at once, the second at the third attempt, the third never; another process finishes the
    fourth, which waits meanwhile; the fifth was done before.
    """
    results, logs = tmp_path / "results", tmp_path / "logs"
    runs = [replace(RUN, seed=seed) for seed in range(5)]
    made = [make_result(results, run) for run in runs]
    write_result(made[4], ROWS, [])
    monkeypatch.setattr(backend, "program", fake_program(tmp_path / "fake", {1: ["fail", "fail", "ok"], 2: ["fail"]}))
    start = backend.start

    def start_and_finish_another(run, logs):
        write_result(made[3], ROWS, [])
        start(run, logs)

    monkeypatch.setattr(backend, "start", start_and_finish_another)
    output = Console(record=True, file=open(os.devnull, "w"), width=300)
    failures = complete(runs, results, logs, backend, output)
    assert seeds_of_results(results) == [0, 1, 3, 4]
    assert [len(attempts(run, logs)) for run in runs] == [1, 3, 1 + RETRIES, 0, 0]
    (failure,) = failures
    assert failure.run == runs[2] and failure.reason == "ValueError: boom"
    assert Path(failure.log).read_text().startswith("sb3-cchain train --algo ppo_cchain")
    shown = output.export_text()
    assert shown.count("seed 1 failed: ValueError: boom; see") == shown.count("seed 1 failed") == 2
    assert shown.count("seed 2 failed") == 3 and shown.count("(tried again)") == 4
    assert shown.count("seed 0 done") == shown.count("seed 1 done") == 1 and "seed 3 done" not in shown
    result = find_result(runs[0], results)
    assert [row["mean_return"] for row in result.returns] == [-10.0, -20.0] and result.versions["torch"] != "0"
    # Again, nothing is left but the one that failed
    assert len(complete(runs, results, logs, backend, silent(), retries=0)) == 1
    assert [len(attempts(run, logs)) for run in runs] == [1, 3, 2 + RETRIES, 0, 0]


def test_the_progress_of_local_runs_is_shown(tmp_path):
    with LocalBackend(1, program=fake_program(tmp_path / "fake", {0: ["hang"]})) as backend:
        backend.start(RUN, tmp_path)
        shown = wait_for(lambda: list(backend.progress().values()), "progress", 30)
    assert shown == [(0.5, "50%, task 0, return -10")]


@linux
def test_a_run_goes_on_from_the_newest_checkpoint(tmp_path, backend, monkeypatch):
    """The first seed is killed after a checkpoint; the second cannot go on from its checkpoint, and starts anew."""
    results, logs = tmp_path / "results", tmp_path / "logs"
    runs = [RUN, replace(RUN, seed=1)]
    program = fake_program(tmp_path / "fake", {0: ["save", "ok"], 1: ["save", "fail", "ok"]})
    monkeypatch.setattr(backend, "program", program)
    assert complete(runs, results, logs, backend, silent()) == []
    commands = []
    for run in runs:
        folders = sorted(run.path_in(logs).glob("attempt_*"))
        resumed = [(folder / "log.txt").read_text().splitlines()[0].partition(" --resume ")[2] for folder in folders]
        commands.append([folders.index(Path(path).parents[3]) if path else None for path in resumed])
        assert all(path.endswith("/algo/env_1/checkpoints/step_000000000800") for path in resumed if path)
        # None is left
        assert not list(run.path_in(logs).rglob("checkpoint.json"))
    assert commands == [[None, 0], [None, 0, None]]
    first, second = (find_result(run, results) for run in runs)
    # Of the training up to the checkpoint, and after it
    assert first.seconds > 100 > second.seconds
    attempt = Attempt(max(runs[0].path_in(logs).glob("attempt_*")))
    assert [len(attempt.chain()), first.started, first.git_commit] == [2, attempt.chain()[0].started, attempt.git_commit]


def test_a_checkpoint_of_other_settings_is_not_taken(tmp_path):
    attempt, checkpoint = new_attempt(RUN, tmp_path, None)
    assert checkpoint is None and attempt.origin is None
    save_checkpoint(attempt.folder, 400)
    save_checkpoint(attempt.folder, 800)
    newest = attempt.folder / "algo" / "env_1" / "checkpoints" / "step_000000000800"
    following, checkpoint = new_attempt(RUN, tmp_path, None)
    assert checkpoint == newest and following.origin[0] == attempt.folder.name and following.origin[2:] == (800, 100.0)
    # Of the same folder, and longer
    assert new_attempt(replace(RUN, steps_per_task=801), tmp_path, None)[1] is None
    # Without what an attempt before has logged, the result would not be whole
    save_checkpoint(following.folder, 1200)
    assert new_attempt(RUN, tmp_path, None)[1].parents[3] == following.folder
    attempt.folder.rename(tmp_path / "elsewhere")
    assert new_attempt(RUN, tmp_path, None)[1] is None
    (tmp_path / "elsewhere").rename(attempt.folder)
    shutil.rmtree(following.folder)
    # A damaged one is passed over
    (newest / "checkpoint.json").write_text("{")
    assert new_attempt(RUN, tmp_path, None)[1] == newest.with_name("step_000000000400")


def test_metrics_of_a_chain_by_hand(tmp_path):
    from torch.utils.tensorboard import SummaryWriter

    def log(attempt, values):
        writer = SummaryWriter(attempt.folder / "tensorboard" / "env" / "algo_1")
        for step, value in values.items():
            writer.add_scalar("churn/coef", value, step)
            writer.add_scalar("train/loss", value, step)
        writer.close()

    first, _ = new_attempt(RUN, tmp_path, None)
    log(first, {10: 1.0, 20: 2.0, 30: 99.0})
    save_checkpoint(first.folder, 20)
    second, _ = new_attempt(RUN, tmp_path, None)
    # It is killed before it has saved anything, and the third goes on from the checkpoint of the first
    log(second, {30: 98.0})
    third, _ = new_attempt(RUN, tmp_path, None)
    log(third, {20: 5.0, 30: 3.0, 40: 1 / 3})
    rows = [(row["timesteps"], row["name"], row["value"]) for row in metrics_rows(third.chain())]
    assert rows == [(step, "churn/coef", value) for step, value in ((10, "1"), (20, "5"), (30, "3"), (40, "0.333333"))]


@linux
def test_a_killed_and_a_stopped_training_end_as_one_that_was_not(tmp_path, monkeypatch):
    """The real command. The first attempt is killed, the second is told to stop and saves, the third comes to the end."""
    overrides = ("n_steps:64", "batch_size:32", "n_epochs:2", "policy_kwargs:dict(net_arch=[8])")
    run = Run("gym_control", "Continual/Acrobot-v1", "cchain", 0, 2, 1600, "smoke", overrides=overrides)
    monkeypatch.setitem(SUITES, "gym_control", replace(SUITES["gym_control"], checkpoint_freq=640))
    (result,), _ = train([run], tmp_path / "uninterrupted")

    logs = tmp_path / "logs"

    def steps_saved(number):
        folders = sorted(run.path_in(logs).glob("attempt_*"))[number:]
        return [int(path.name[5:]) for folder in folders for path in folder.glob("*/*/checkpoints/step_*")]

    with LocalBackend(1) as backend:
        backend.start(run, logs)
        wait_for(lambda: steps_saved(0), "checkpoint")
        ((training, _),) = backend._running.values()
        training.kill()
        assert not training.is_running()
    monkeypatch.setitem(SUITES, "gym_control", replace(SUITES["gym_control"], checkpoint_freq=10**6))
    with LocalBackend(1) as backend:
        backend.start(run, logs)
        origin = next(iter(backend._running.values()))[0].attempt.origin.num_timesteps
        (progress,) = wait_for(lambda: list(backend.progress().values()), "progress")
        assert progress.words.endswith(f", from {origin / run.total_steps:.0%}")
        wait_for(lambda: backend.progress()[run].share > origin / run.total_steps, "further training")
    (stopped,) = steps_saved(1)
    assert stopped > origin
    with LocalBackend(1) as backend:
        assert complete([run], tmp_path / "results", logs, backend, silent(), retries=0) == []
    resumed = find_result(run, tmp_path / "results")
    for name in ("returns.csv", "metrics.csv"):
        assert (resumed.path / name).read_bytes() == (result.path / name).read_bytes()
    assert [
        attempt.origin and attempt.origin.num_timesteps
        for attempt in Attempt(max(run.path_in(logs).glob("attempt_*"))).chain()
    ] == [None, origin, stopped]
    assert len(resumed.metrics["churn/coef"]) == run.total_steps // 64 - 1
    assert not list(logs.rglob("checkpoints"))


def test_a_run_that_cannot_be_started_has_failed(tmp_path):
    (tmp_path / "file").touch()
    with LocalBackend(1) as backend:
        (failure,) = complete([RUN], tmp_path / "results", tmp_path / "file", backend, silent(), retries=1)
    assert "Not a directory" in failure.reason


def trainings(folder):
    """Ids of the training processes that log to a folder, and of their parents."""
    found = {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            command = (process / "cmdline").read_text()
            if "fake_training.py\0" in command and f"{folder}/" in command:
                found[int(process.name)] = parent_process(int(process.name))
        except OSError:
            pass  # it has ended
    return found


def parent_process(pid):
    return int(Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[1])


DRIVER = """
import sys
from pathlib import Path
from benchmarks.grid.executor import LocalBackend, complete, ended_by_sigterm
from benchmarks.grid.ray_backend import RayBackend
from benchmarks.grid.run import Run

address, results, logs, *program = sys.argv[1:]
backend = LocalBackend(2, program=program) if address == "local" else RayBackend(address, program=program)
with ended_by_sigterm(), backend:
    runs = [Run("gym_control", "Continual/CartPole-v1", "cchain", seed, 2, 800, "smoke") for seed in range(4)]
    complete(runs, Path(results), Path(logs), backend)
"""


def test_a_run_that_takes_no_time_has_a_rate(tmp_path, monkeypatch):
    monkeypatch.setattr("benchmarks.grid.training.time", SimpleNamespace(monotonic=lambda: 5.0))
    with LocalBackend(1, program=fake_program(tmp_path / "fake", {})) as backend:
        assert complete([RUN], tmp_path / "results", tmp_path / "logs", backend, silent()) == []
    assert find_result(RUN, tmp_path / "results").steps_per_second > 0


@linux
@pytest.mark.parametrize(
    "backend, ending",
    [("local", "SIGKILL"), ("local", "SIGINT"), ("ray", "SIGTERM")],
    indirect=["backend"],
)
def test_what_is_killed_goes_on(tmp_path, backend, ending, request):
    """One run is done, two are running; first one of those is killed, then the whole command."""
    results, logs = tmp_path / "results", tmp_path / "logs"
    runs = [replace(RUN, seed=seed) for seed in range(4)]
    address = "local" if isinstance(backend, LocalBackend) else request.getfixturevalue("cluster").address
    program = fake_program(tmp_path / "fake", {1: ["hang"], 2: ["hang"]})
    command = [sys.executable, "-c", DRIVER, address, str(results), str(logs), *program]
    with open(tmp_path / "output.txt", "w") as output:
        driver = subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT)
    try:
        first = wait_for(lambda: seeds_of_results(results) == [0] and len(found := trainings(logs)) == 2 and found, "training")
        training, worker = next(iter(first.items()))
        os.kill(training if address == "local" else worker, signal.SIGKILL)
        wait_for(lambda: training not in trainings(logs), "end of the killed run", 30)
        wait_for(lambda: len(trainings(logs)) == 2, "next attempt")
        next_one = max((path for run in runs[1:3] for path in run.path_in(logs).glob("attempt_*")), key=lambda path: path.name)
        wait_for(lambda: list(next_one.rglob("returns.csv")), "beginning of the next attempt")
        driver.send_signal(getattr(signal, ending))
        assert driver.wait(60) != 0
    finally:
        driver.kill()
        driver.wait()
    wait_for(lambda: not trainings(logs), "end of the killed command", 60)
    assert "failed" in (tmp_path / "output.txt").read_text()
    written = (runs[0].path_in(results) / "run.json").stat().st_mtime_ns
    before = [attempts(run, logs) for run in runs]
    assert [len(names) for names in before] in ([1, 2, 1, 0], [1, 1, 2, 0])
    if ending != "SIGKILL":
        # Those that ran had time to save themselves
        assert len(list(logs.rglob("stopped"))) == 2

    backend.program = fake_program(tmp_path / "fake", {})
    assert complete(runs, results, logs, backend, silent()) == []
    assert seeds_of_results(results) == [0, 1, 2, 3]
    assert (runs[0].path_in(results) / "run.json").stat().st_mtime_ns == written
    assert [len(attempts(run, logs) - names) for run, names in zip(runs, before, strict=True)] == [0, 1, 1, 1]


@linux
def test_a_cluster_of_two_nodes_loses_one(tmp_path, cluster, ray_backend):
    results, logs = tmp_path / "results", tmp_path / "logs"
    runs = [replace(RUN, seed=seed) for seed in range(4)]
    ray_backend.program = fake_program(tmp_path / "fake", {0: ["wait"], 1: ["wait"], 3: ["fail"]})
    raylets = set()

    def lose_one():
        # A node has a core, so two trainings at a time are on two nodes
        two = wait_for(lambda: len(found := trainings(logs)) == 2 and found, "two trainings at once")
        raylets.update(parent_process(worker) for worker in two.values())
        cluster.remove_node(cluster.list_all_nodes()[-1], allow_graceful=False)
        # Its training could still end and be heard of before
        wait_for(lambda: not set(two) <= set(trainings(logs)), "end of the lost training", 60)
        (tmp_path / "fake" / "go").touch()

    accident = threading.Thread(target=lose_one)
    accident.start()
    (failure,) = complete(runs, results, logs, ray_backend, silent())
    accident.join()
    cluster.add_node(num_cpus=1)  # for other tests
    assert len(raylets) == 2
    assert seeds_of_results(results) == [0, 1, 2]
    n_attempts = Counter({run.seed: len(attempts(run, logs)) for run in runs})
    assert n_attempts[0] + n_attempts[1] == 2 + 1 and n_attempts[2] == 1 and n_attempts[3] == 1 + RETRIES
    assert failure.run == runs[3] and failure.reason == "ValueError: boom" and Path(failure.log).exists()
