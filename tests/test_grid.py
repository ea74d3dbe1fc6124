"""The grid of the paper: its runs, their results, and that neither is lost or made twice when something dies."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from benchmarks.grid import GridRun, Rates, grid_runs, length
from benchmarks.grid_view import Failure, GridView, duration
from benchmarks.results import METHODS, Result, in_json, read_result, read_results, write_result
from benchmarks.run import main
from benchmarks.runs import Run
from benchmarks.scheduler import RETRIES, ROOT, RunFailed, complete_grid, connect, import_ray, slots, train
from benchmarks.suites import SUITES
from sb3_cchain.envs.registration import CONTINUAL_ENVS

GRID_RUN = GridRun("gym_control", "Continual/CartPole-v1", "cchain", 0, "smoke", 2, 800, ("task 0", "task 1"))
ROWS = [
    {"timesteps": 800, "task_id": 0, "n_episodes": 4, "mean_return": 20.0},
    {"timesteps": 1600, "task_id": 0, "n_episodes": 2, "mean_return": 30.0},
]


def make_result(folder, run=GRID_RUN, seconds=10.0, steps_per_second=160.0, **settings):
    """As of a finished run."""
    return Result(
        path=run.path(folder),
        suite=run.suite,
        method=run.method,
        budget=run.budget,
        task_names=list(run.task_names),
        task_boundaries=[800, 1600],
        command=["sb3-cchain", "train"],
        versions={"sb3-cchain": "0", "stable-baselines3": "0", "gymnasium": "0", "torch": "0", "numpy": "0", "python": "0"},
        git_commit=None,
        started="2026-01-01T00:00:00+00:00",
        finished="2026-01-01T00:00:10+00:00",
        seconds=seconds,
        steps_per_second=steps_per_second,
        peak_memory=None,
        **{**run.settings, **settings},
    )


# --- Results ------------------------------------------------------------------------------------------------------------


def test_results_are_read_as_they_were_written(tmp_path):
    result = make_result(tmp_path)
    assert result.path == tmp_path / "smoke" / "gym_control" / "Continual-CartPole-v1" / "cchain" / "seed_0"
    write_result(result, ROWS, [{"timesteps": 800, "name": "churn/coef", "value": "1.5"}])
    assert read_results(tmp_path) == read_results(tmp_path / "smoke") == [result] == [read_result(result.path)]
    assert result.returns == ROWS and result.metrics == {"churn/coef": [(800, 1.5)]}
    averages = result.task_averages()
    assert averages[0] == 25.0 and averages[1] != averages[1]
    assert sorted(file.name for file in result.path.iterdir()) == ["metrics.csv", "returns.csv", "run.json"]
    assert (result.path / "returns.csv").read_text() == (
        "timesteps,task_id,n_episodes,mean_return\n800,0,4,20.0\n1600,0,2,30.0\n"
    )


def test_json_without_infinity():
    assert in_json({"a": float("inf"), "b": [1.5, (2,)], 3: None}) == {"a": "inf", "b": [1.5, [2]], "3": None}


def test_a_result_is_whole_or_not_there(tmp_path, monkeypatch):
    result = make_result(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", lambda *paths: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            write_result(result, ROWS, [])
    # What it left is no result, and in nobody's way
    assert len(list(result.path.parent.iterdir())) == 1 and read_results(tmp_path) == [] and GRID_RUN.result(tmp_path) is None
    write_result(result, ROWS, [])
    assert read_results(tmp_path) == [result]


def test_the_first_of_equal_results_stays_and_one_of_other_settings_is_replaced(tmp_path):
    first = make_result(tmp_path)
    write_result(first, ROWS, [])
    write_result(make_result(tmp_path, seconds=99.0), [], [])
    assert read_results(tmp_path) == [first] and first.returns == ROWS
    other = make_result(tmp_path, steps_per_task=400)
    write_result(other, [], [])
    assert read_results(tmp_path) == [other] and other.returns == []
    assert [path.name for path in first.path.parent.iterdir()] == ["seed_0"]


@pytest.mark.parametrize("same", [True, False])
def test_writers_at_once_leave_one_whole_result(tmp_path, same):
    results = [make_result(tmp_path, steps_per_task=800 if same else 100 + i) for i in range(16)]
    with ThreadPoolExecutor(16) as pool:
        list(pool.map(lambda result: write_result(result, ROWS, []), results))
    (written,) = read_results(tmp_path)
    assert written in results and written.returns == ROWS
    assert [path.name for path in written.path.parent.iterdir()] == ["seed_0"]


def test_a_result_counts_under_its_settings_alone(tmp_path):
    result = make_result(tmp_path)
    write_result(result, ROWS, [])
    assert GRID_RUN.result(tmp_path) == result
    for change in (dict(seed=1), dict(method="vanilla"), dict(budget="paper"), dict(n_tasks=3), dict(steps_per_task=801)):
        assert replace(GRID_RUN, **change).result(tmp_path) is None
    hyperparameters = {**GRID_RUN.settings["hyperparameters"], "learning_rate": 1.0}
    write_result(make_result(tmp_path, hyperparameters=hyperparameters), ROWS, [])
    assert GRID_RUN.result(tmp_path) is None


# --- The grid -----------------------------------------------------------------------------------------------------------


def test_methods():
    assert tuple(SUITES["procgen"].methods) == METHODS
    assert list(SUITES["gym_control"].methods.items()) == [
        ("oracle", "ppo_oracle"),
        ("vanilla", "ppo"),
        ("trac", "ppo_trac"),
        ("weight_clipping", "ppo_weight_clipping"),
        ("l2_init", "ppo_l2_init"),
        ("cchain", "ppo_cchain"),
    ]
    assert SUITES["minatar"].methods == {"oracle": "double_dqn_oracle", "vanilla": "double_dqn", "cchain": "dqn_cchain"}


def test_the_grid_of_gym_control():
    grid = grid_runs(["gym_control"], budget="reduced")
    assert len(grid) == len(set(grid)) == 4 * 6 * 3
    assert [run.seed for run in grid] == [0] * 24 + [1] * 24 + [2] * 24
    # A suite in 6 hours on two cores
    assert sum(map(Rates([]).seconds, grid)) < 2 * 6 * 3600
    grid = grid_runs(
        ["gym_control"], ["Continual/MountainCar-v0", "Continual/CartPole-v1"], ["cchain", "vanilla", "cchain"], 2
    )
    assert [(run.seed, run.method, run.env_id, run.n_tasks, run.steps_per_task) for run in grid] == [
        (seed, method, *env)
        for seed in (0, 1)
        for method in ("cchain", "vanilla")
        for env in (("Continual/CartPole-v1", 10, 160_000), ("Continual/MountainCar-v0", 5, 320_000))
    ]
    assert grid[0].task_names == tuple(f"task {i}" for i in range(10))
    assert len(grid_runs(["gym_control"], ["Continual/CartPole-v1"], ["vanilla"])) == 6


def test_lengths():
    assert length("gym_control", "Continual/Acrobot-v1", "reduced") == (4, 64_000)
    assert length("gym_control", "Continual/MountainCar-v0", "reduced") == (2, 128_000)
    assert length("minatar", "Continual/MinAtar-v0", "paper") == (3, 1_500_000)
    assert length("minatar", "Continual/MinAtar-v0", "reduced") == (3, 150_000)
    assert length("minatar", "Continual/MinAtar-v0", "smoke") == (2, 200)


@pytest.mark.skipif(sys.version_info >= (3, 13), reason="no wheels")
def test_the_grid_of_all_suites():
    grid = grid_runs(list(SUITES), budget="paper")
    counts = {suite: sum(run.suite == suite for run in grid) for suite in SUITES}
    assert counts == dict(gym_control=4 * 6 * 6, procgen=16 * 9 * 6, dmc=3 * 3 * 12, minatar=1 * 3 * 12)
    assert {run.env_id for run in grid} == {f"Continual/{name}" for name in CONTINUAL_ENVS}
    assert all(run.settings["hyperparameters"] for run in grid)
    names = {run.env_id: run.task_names for run in grid}
    assert names["Continual/Maze-v0"] == ("level 20", "level 21", "level 22", "level 23", "level 24")
    assert names["Continual/Dog-v0"] == ("stand", "walk", "run", "trot")


def test_a_grid_run_is_the_command_that_a_user_would_type(tmp_path):
    run = GRID_RUN.run(tmp_path)
    assert run == Run("ppo_cchain", "Continual/CartPole-v1", 0, 2, 800, tmp_path, ("n_tasks:2", "offset_seed:0"))
    assert "--hyperparams" not in run.arguments
    evaluated = GridRun("minatar", "Continual/MinAtar-v0", "vanilla", 3, "reduced", 3, 150_000, ())
    assert evaluated.run(tmp_path).eval_freq == 5000
    assert evaluated.run(tmp_path, "cuda").arguments[9:13] == ["--num-threads", "1", "--device", "cuda"]


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--env", "Continual/Maze-v0"], "--env must be of Continual/CartPole-v1, .* in gym_control; got Continual/Maze-v0"),
        (["--method", "redo"], "--method must be of oracle, vanilla, trac, .*, cchain in gym_control; got redo"),
        (["--seeds", "0"], "--seeds must be at least 1; got 0"),
        (["--gpus-per-run", "-1"], "--gpus-per-run must be from 0.0001 to 1, or a whole number; got -1"),
        (["--gpus-per-run", "1.5"], "--gpus-per-run must be .*; got 1.5"),
        (["--gpus-per-run", "1e-5"], "--gpus-per-run must be .*; got 1e-05"),
        (["--gpus-per-run", "nan"], "--gpus-per-run must be .*; got nan"),
        (["--results", __file__], "Not a directory: .*test_grid.py"),
        (["--cpus", "0"], "--cpus must be at least 1"),
        (["--cpus", "2", "--address", "auto"], "goes without --address"),
        ([], r'The grid needs Ray .*: pip install -e ".\[cluster\]"'),
    ],
)
def test_errors_come_before_any_work(arguments, message, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    folders = ["--results", str(tmp_path / "results"), "--logs", str(tmp_path / "logs")]
    with pytest.raises(SystemExit) as error:
        main(["--suite", "gym_control", *folders, *arguments])
    assert error.value.code == 2 and re.search(message, capsys.readouterr().err)
    assert list(tmp_path.iterdir()) == []


def test_an_empty_grid_is_an_error(capsys):
    with pytest.raises(SystemExit):
        main(["--suite", "all", "--method", "redo", "--env", "Continual/Acrobot-v1"])
    assert "--method must be one that is compared in Continual/Acrobot-v1; got redo" in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_to_is_found_before_any_work(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("benchmarks.run.import_ray", lambda: None)
    monkeypatch.setattr("tempfile.TemporaryFile", lambda dir: (_ for _ in ()).throw(OSError("Read-only file system")))
    with pytest.raises(SystemExit):
        main(["--suite", "gym_control", "--results", str(tmp_path / "new")])
    expected = f"--results must be a folder that can be written to; got {tmp_path / 'new'}: Read-only file system"
    assert expected in capsys.readouterr().err


def test_a_damaged_result_is_named(tmp_path, capsys):
    GRID_RUN.path(tmp_path).mkdir(parents=True)
    for text in ("", "{}"):
        (GRID_RUN.path(tmp_path) / "run.json").write_text(text)
        with pytest.raises(SystemExit):
            main(["--suite", "gym_control", "--budget", "smoke", "--dry-run", "--results", str(tmp_path)])
        assert f"{GRID_RUN.path(tmp_path) / 'run.json'} is not a result" in capsys.readouterr().err


def test_results_that_will_be_replaced_are_told(tmp_path, capsys):
    result = make_result(tmp_path, hyperparameters={}, seed=0)
    write_result(result, ROWS, [])
    assert main(["--suite", "gym_control", "--budget", "smoke", "--dry-run", "--results", str(tmp_path)]) == 0
    assert f"{result.path} is of other hyperparameters, and will be replaced." in capsys.readouterr().out


def test_dry_run(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    arguments = ["--suite", "gym_control", "--env", "Continual/CartPole-v1", "--method", "vanilla", "cchain"]
    arguments += ["--budget", "smoke", "--results", str(tmp_path)]
    write_result(make_result(tmp_path), ROWS, [])
    assert main([*arguments, "--dry-run"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == "CartPole-v1 vanilla seed 0 2 x 800 steps 4 s".split()
    assert lines[1].split() == "CartPole-v1 cchain seed 0 2 x 800 steps done in 10 s".split()
    assert lines[2].startswith("2 runs, 1 of them done. The other 1 take 4 s on a core")
    assert lines[3].startswith("1 of the results are of sb3-cchain 0")
    # Nothing to do needs no Ray
    write_result(make_result(tmp_path, replace(GRID_RUN, method="vanilla")), ROWS, [])
    assert main(arguments) == 0
    assert capsys.readouterr().out.startswith("All 2 runs are done.")


# --- Time ---------------------------------------------------------------------------------------------------------------


def test_rates_by_hand(tmp_path):
    acrobot = replace(GRID_RUN, env_id="Continual/Acrobot-v1", budget="reduced")
    paper = replace(GRID_RUN, budget="paper", n_tasks=1, steps_per_task=1000)
    # Nothing known: 430 steps per second, 500 of Vanilla
    assert Rates([]).seconds(paper) == pytest.approx(1000 / 430)
    assert Rates([]).seconds(replace(paper, method="weight_clipping")) == pytest.approx(2.0)
    results = [make_result(tmp_path, GRID_RUN, seconds=1000.0), make_result(tmp_path, acrobot, seconds=16.0)]
    results.append(make_result(tmp_path, replace(acrobot, seed=1), seconds=48.0))
    # Of the suite, 3200 steps in 64 seconds, not of smoke runs, though of the same environment
    assert Rates(results).seconds(paper) == pytest.approx(20.0)
    results.append(make_result(tmp_path, replace(GRID_RUN, budget="reduced"), seconds=16.0))
    assert Rates(results).seconds(paper) == pytest.approx(10.0)
    assert Rates(results).seconds(GRID_RUN) == pytest.approx(1000.0)


def test_durations():
    assert [duration(seconds) for seconds in (0, 3.2, 61, 89 * 60, 5400, 71 * 3600, 4 * 86400)] == [
        *("0 s", "4 s", "1 min", "89 min", "1.5 h", "71.0 h", "4 days"),
    ]


def test_time_left_by_hand(monkeypatch):
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    some = [replace(GRID_RUN, seed=seed, steps_per_task=4300) for seed in range(5)]  # 20 seconds each at 430 steps per second
    console = Console(record=True, width=200)
    view = GridView(some, n_done=3, rates=Rates([]), console=console)
    view.slots = 2
    assert view.time_left() == pytest.approx(50.0)
    view.start(some[0])
    view.start(some[1])
    now = 115.0
    assert view.time_left() == pytest.approx((5 + 5 + 60) / 2)
    now = 130.0
    view.finish(some[0], 30.0)
    # They take one and a half times as long as was believed: nothing is left of the second
    assert view.time_left() == pytest.approx((0 + 3 * 30) / 2)
    view.fail(Failure(some[1], "ValueError: [no]", "/logs/log.txt", "elsewhere"), again=True)
    assert view.waiting[0] == some[1]
    view.start(some[1])
    view.fail(Failure(some[1], "ValueError: [no]", "/logs/log.txt", "elsewhere"), again=False)
    view.start(some[2])
    view.skip(some[3])
    assert view.time_left() == pytest.approx(30.0)
    console.print(view.render())
    shown = console.export_text().splitlines()
    assert shown[0] == "4 of 8: CartPole-v1 cchain seed 0 done in 30 s, 45 s left"
    failure = "CartPole-v1 cchain seed 1 failed: ValueError: [no]; see elsewhere:/logs/log.txt"
    assert shown[1].strip() == f"{failure} (tried again)"
    assert shown[2].strip() == failure and shown[-1].strip() == failure
    assert shown[3].strip("━╸╺ ") == "5 done (3 before), 1 running, 1 waiting, 1 failed, 30 s left"
    assert shown[4].split() == "CartPole-v1 cchain seed 2 0 s".split()


def test_an_address_at_which_nothing_answers():
    with pytest.raises(ConnectionError, match=r"--address must be that of a Ray cluster; got 127.0.0.1:1: .*refused"):
        connect(None, "127.0.0.1:1", None, 0.0)


def test_slots_by_hand():
    assert slots({"CPU": 8.0, "GPU": 1.0}, 0.0) == 8
    assert slots({"CPU": 8.0, "GPU": 1.0}, 0.25) == 4
    assert slots({"CPU": 2.0, "GPU": 1.0}, 0.1) == 2
    assert slots({}, 0.0) == 1


# --- Training -----------------------------------------------------------------------------------------------------------


def train_smoke(suite, env_id, method, folder):
    (run,) = grid_runs([suite], [env_id], [method], budget="smoke")
    finished = train(run, folder / "logs", git_commit="abc")
    write_result(replace(finished.result, path=run.path(folder / "results")), finished.returns, finished.metrics)
    result = run.result(folder / "results")
    assert result is not None and result.seconds > 0 and result.git_commit == "abc" and result.started < result.finished
    assert result.steps_per_second == pytest.approx(run.total_steps / result.seconds, rel=0.01)
    assert str(folder) not in (result.path / "run.json").read_text()
    assert result.task_boundaries == [run.steps_per_task, 2 * run.steps_per_task]
    return result


def test_a_run_and_its_result(tmp_path):
    result = train_smoke("gym_control", "Continual/CartPole-v1", "cchain", tmp_path)
    assert [(row["timesteps"], row["task_id"]) for row in result.returns] == [(800, 0), (1600, 1)]
    metrics = result.metrics
    assert set(metrics) >= {"churn/coef", "churn/policy_churn"} and all(name.startswith("churn/") for name in metrics)
    # SB3 writes what an update logged with the rollout after it
    assert [steps for steps, _ in metrics["churn/coef"]] == [1600]
    assert result.command[:4] == ["sb3-cchain", "train", "--algo", "ppo_cchain"]
    assert "logs/grid/smoke/gym_control/Continual-CartPole-v1/cchain/seed_0" in result.command
    assert result.hyperparameters["max_grad_norm"] == "inf"


@pytest.mark.slow
@pytest.mark.skipif(sys.version_info >= (3, 13), reason="no wheels")
@pytest.mark.parametrize(
    "suite, env_id, method, names",
    [
        ("procgen", "Continual/Starpilot-v0", "vanilla", ["level 20", "level 21"]),
        ("dmc", "Continual/Walker-v0", "cchain", ["stand", "walk"]),
        ("minatar", "Continual/MinAtar-v0", "cchain", ["SpaceInvaders", "Asterix"]),
    ],
)
def test_runs_of_the_other_suites(suite, env_id, method, names, tmp_path):
    result = train_smoke(suite, env_id, method, tmp_path)
    assert result.task_names == names
    rows = result.returns
    if suite == "minatar":
        assert [tuple(row.values())[:3] for row in rows] == [(200, 0, 10), (400, 1, 10)]
    assert {row["task_id"] for row in rows} <= {0, 1} and rows


def test_a_failed_run_says_why(tmp_path):
    bad = replace(GRID_RUN, env_id="Continual/Acrobat-v1")
    with pytest.raises(RunFailed) as error:
        train(bad, tmp_path)
    reason, log, _ = error.value.args
    assert "\n" not in reason and "Acrobot-v1" in reason
    assert Path(log).is_relative_to(bad.path(tmp_path)) and reason in Path(log).read_text()


class FakeRay:
    """
    Runs a task as soon as it is waited for.

    :param outcomes: What becomes of the tasks of a seed, one after the other: a result, or an error
    """

    class exceptions:
        class RayError(Exception):
            pass

    def __init__(self, outcomes):
        self.outcomes, self.calls = outcomes, []

    def cluster_resources(self):
        return {"CPU": 2.0, "GPU": 1.0}

    def remote(self, function):
        return self

    def options(self, **options):
        assert options == dict(num_cpus=1, num_gpus=0.25, max_retries=0, scheduling_strategy="SPREAD")
        remote = lambda *arguments: self.calls.append(arguments) or len(self.calls) - 1  # noqa: E731
        return type("Task", (), {"remote": staticmethod(remote)})

    def wait(self, references, num_returns, timeout):
        return references[:1], references[1:]

    def get(self, reference):
        outcome = self.outcomes[self.calls[reference][0].seed].pop(0)()
        if isinstance(outcome, Exception):
            raise outcome
        return outcome


def test_which_runs_are_begun(tmp_path):
    """
    Of four seeds, the first comes to its end at the third attempt, the second never; another process finishes the third, which
    waits meanwhile; the fourth was done before.
    """
    grid = [replace(GRID_RUN, seed=seed) for seed in range(4)]
    made = [make_result(tmp_path, run) for run in grid]
    write_result(made[3], ROWS, [])

    def error():
        return FakeRay.exceptions.RayError("line 1\n\nline 2")

    def finish():
        write_result(made[2], ROWS, [])
        return made[0], ROWS, []

    ray = FakeRay({0: [error, error, finish], 1: [error] * 3})
    output = Console(record=True, file=open(os.devnull, "w"), width=300)
    failures = complete_grid(ray, grid, tmp_path, tmp_path / "logs", 0.25, output)
    assert read_results(tmp_path) == [made[0], made[2], made[3]]
    assert [(failure.run.seed, failure.reason) for failure in failures] == [(1, "RayError: line 1 line 2")]
    assert sorted(arguments[0].seed for arguments in ray.calls) == [0, 0, 0, 1, 1, 1]
    assert {arguments[2] for arguments in ray.calls} == {"cuda"}
    shown = output.export_text()
    assert shown.count("seed 0 failed: RayError: line 1 line 2; see") == shown.count("seed 0 failed") == 2
    assert shown.count("seed 1 failed") == 3 and shown.count("(tried again)") == 4


# --- With Ray -----------------------------------------------------------------------------------------------------------


def trainings(folder):
    """Ids of the training processes that log to a folder, and of their parents."""
    found = {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if "benchmarks.child\0" in (command := (process / "cmdline").read_text()) and str(folder) in command:
                found[int(process.name)] = parent_of(int(process.name))
        except OSError:
            pass  # it has ended
    return found


def parent_of(pid):
    return int(Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[1])


def wait_for(condition, what, seconds=900):  # Ray gives its workers the lowest priority
    end = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < end, f"no {what} in {seconds} seconds"
        time.sleep(0.1)
    return value


def attempts(run, logs):
    return {path.name for path in run.path(logs).glob("attempt_*")}


linux = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")


@linux
@pytest.mark.slow
def test_a_killed_grid_goes_on(tmp_path):
    pytest.importorskip("ray")
    results, logs = tmp_path / "results", tmp_path / "logs"
    command = [sys.executable, "-m", "benchmarks.run", "--suite", "gym_control", "--env", "Continual/CartPole-v1"]
    command += ["--method", "vanilla", "--seeds", "4", "--budget", "smoke", "--cpus", "2"]
    command += ["--results", str(results), "--logs", str(logs)]
    grid = grid_runs(["gym_control"], ["Continual/CartPole-v1"], ["vanilla"], 4, "smoke")
    with open(tmp_path / "first.txt", "w") as output:
        driver = subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT)
    try:
        training, worker = next(iter(wait_for(lambda: trainings(logs), "training").items()))
        os.kill(worker, signal.SIGKILL)
        wait_for(lambda: training not in trainings(logs), "end of the orphan", 30)
        wait_for(lambda: read_results(results), "result")
    finally:
        driver.kill()
        driver.wait()
    wait_for(lambda: not trainings(logs), "end of the killed grid", 60)
    before = {run: (run.path(results) / "run.json").stat().st_mtime_ns for run in grid if run.result(results)}
    tried = {run: attempts(run, logs) for run in grid}
    assert 1 <= len(before) < 4

    again = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=1800)
    assert again.returncode == 0, again.stdout + again.stderr
    assert "4 of 4 runs are done, 0 failed" in again.stdout
    assert sorted(result.seed for result in read_results(results)) == [0, 1, 2, 3]
    for run in grid:
        assert len(read_result(run.path(results)).returns) == 2
        if run in before:  # not again
            assert (run.path(results) / "run.json").stat().st_mtime_ns == before[run]
            assert attempts(run, logs) == tried[run]
        else:
            assert len(attempts(run, logs) - tried[run]) == 1
    # The run whose worker was killed
    assert sum(len(attempts(run, logs)) for run in grid) >= 4 + 1


@linux
@pytest.mark.slow
def test_a_cluster_of_two_nodes_loses_one(tmp_path):
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    results, logs = tmp_path / "results", tmp_path / "logs"
    grid = grid_runs(["gym_control"], ["Continual/CartPole-v1"], ["vanilla"], 3, "smoke")
    bad = replace(GRID_RUN, env_id="Continual/Acrobat-v1")
    ray = import_ray()
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    raylets = set()

    def lose_one():
        # A node has a core, so two trainings at a time are on two nodes
        two = wait_for(lambda: len(found := trainings(logs)) == 2 and found, "two trainings at once")
        raylets.update(parent_of(worker) for worker in two.values())
        cluster.remove_node(node, allow_graceful=False)

    try:
        node = cluster.add_node(num_cpus=1)
        with pytest.raises(ValueError, match="--gpus-per-run must be at most the GPUs that Ray finds, 0; got"):
            connect(ray, cluster.address, None, 0.25)
        connect(ray, cluster.address, None, 0.0)
        accident = threading.Thread(target=lose_one)
        accident.start()
        failures = complete_grid(ray, [*grid, bad], results, logs, console=Console(file=open(os.devnull, "w")))
        accident.join()
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert len(raylets) == 2
    assert [result.seed for result in read_results(results)] == [0, 1, 2]
    assert sum(len(attempts(run, logs)) for run in grid) == 3 + 1
    (failure,) = failures
    assert failure.run == bad and "Acrobot-v1" in failure.reason and Path(failure.log).exists()
    assert len(attempts(bad, logs)) == 1 + RETRIES
