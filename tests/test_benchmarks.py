"""The benchmarks' own machinery."""

import json
import sys

import numpy as np
import pytest

from benchmarks.curves import COLORS, LABELS, averages_of, cost_table, plot_curves, report, returns_table, smoothed
from benchmarks.runs import DONE, Run, complete
from benchmarks.suites import ALL_ENVS, SUITES, Task, look_at
from sb3_cchain.zoo.cli import METHODS

FRAME = np.zeros((20, 30, 3), np.uint8)
CSV = "timesteps,task_id,n_episodes,mean_return\n"


def make_run(folder, algo="ppo", seed=0, rows="800,0,2,-10.0\n1600,0,2,-20.0\n2400,1,2,-30.0\n3200,1,2,-50.0\n"):
    run = Run(algo, "Continual/Acrobot-v1", seed, 2, 1600, folder / f"{algo}_{seed}")
    logged = run.folder / "tensorboard" / "Continual-Acrobot-v1" / "PPO_1"
    logged.mkdir(parents=True)
    (logged / "returns.csv").write_text(CSV + rows)
    return run


def test_task_averages_by_hand(tmp_path):
    assert averages_of(make_run(tmp_path)) == [-15.0, -40.0]


def test_table_by_hand(tmp_path):
    runs = [
        make_run(tmp_path),
        make_run(tmp_path, seed=1, rows="800,0,1,-5.0\n2400,1,1,0.0\n"),
        make_run(tmp_path, "ppo_cchain"),
    ]
    assert returns_table(runs).splitlines() == [
        "| algorithm | seed | task 0 | task 1 | J(T) |",
        "| --- | --- | --- | --- | --- |",
        "| PPO | 0 | -15.0 | -40.0 | -27.5 |",
        "| PPO | 1 | -5.0 | 0.0 | -2.5 |",
        "| C-CHAIN PPO | 0 | -15.0 | -40.0 | -27.5 |",
        "| **PPO** | **mean** | **-10.0** | **-20.0** | **-15.0** |",
        "| **C-CHAIN PPO** | **mean** | **-15.0** | **-40.0** | **-27.5** |",
    ]


def test_random_policy_in_the_table(tmp_path):
    table = returns_table([make_run(tmp_path)], random_returns=[-300.0, -1.0])
    assert table.splitlines()[-1] == "| random policy |  | -300 | -1.0 | -150 |"


def test_evaluations_by_task(tmp_path):
    run = make_run(tmp_path)
    folder = run.folder / "ppo" / "Continual-Acrobot-v1_1"
    folder.mkdir(parents=True)
    np.savez(folder / "evaluations.npz", timesteps=[800, 1600, 2400], results=[[1.0, 3.0], [5.0, 5.0], [8.0, 0.0]])
    assert [tuple(row.values()) for row in run.evaluations()] == [(800, 0, 2, 2.0), (1600, 0, 2, 5.0), (2400, 1, 2, 4.0)]
    assert averages_of(run, Run.evaluations) == [3.5, 4.0]
    assert returns_table([run], Run.evaluations).splitlines()[2] == "| PPO | 0 | 3.5 | 4.0 | 3.8 |"


def test_suites_cover_the_environments():
    assert sorted(env_id for suite in SUITES.values() for env_id in suite.env_ids) == sorted(ALL_ENVS)
    assert {name: len(suite.env_ids) for name, suite in SUITES.items()} == dict(gym_control=4, procgen=16, dmc=3, minatar=1)
    methods = {algo for suite in SUITES.values() for algo in (*suite.algos, *suite.others)}
    assert methods == set(LABELS) == set(COLORS) == {"ppo", "ppo_cchain", "double_dqn", "dqn_cchain", *METHODS}
    assert SUITES["gym_control"].length("Continual/MountainCar-v0") == (5, 320_000)
    assert SUITES["minatar"].length("Continual/MinAtar-v0") == (3, 1_500_000)


def test_runs_that_cannot_be_reported_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"`n_tasks` must be at most 3, the tasks of Continual/Walker-v0; got 5"):
        SUITES["dmc"].run("ppo", "Continual/Walker-v0", 0, 5, 100, tmp_path)
    assert SUITES["procgen"].run("ppo", "Continual/Maze-v0", 0, 7, 100, tmp_path).env_kwargs == ("n_tasks:7",)
    for steps_per_task, eval_freq in ((100, 200), (20, None)):
        with pytest.raises(ValueError, match=f"between 1 and `steps_per_task`, which is {steps_per_task}; got {eval_freq}"):
            SUITES["minatar"].run("double_dqn", "Continual/MinAtar-v0", 0, 3, steps_per_task, tmp_path, eval_freq)


def test_a_task_without_an_agent(tmp_path):
    suite = SUITES["minatar"]
    task = look_at(suite, suite.run("dqn_cchain", "Continual/MinAtar-v0", 0, 3, 100, tmp_path), 1, n_episodes=300)
    assert task.name == "Asterix" and task.frame.shape == (160, 160, 3)
    # Measured with MinAtar alone over 9000 episodes: 0.51 ± 0.01
    assert 0.35 < task.random_return < 0.75


@pytest.mark.skipif(sys.version_info >= (3, 13), reason="no wheels")
def test_names_of_tasks(tmp_path):
    for name, env_id, expected in (
        ("procgen", "Continual/Maze-v0", "level 21"),
        ("dmc", "Continual/Walker-v0", "walk"),
        ("gym_control", "Continual/CartPole-v1", "task 1"),
    ):
        suite = SUITES[name]
        task = look_at(suite, suite.run("ppo", env_id, 0, 2, 100, tmp_path), 1, n_episodes=1)
        assert task.name == expected and (task.frame is None or suite.visible)


def test_report(tmp_path):
    runs = [make_run(tmp_path, algo) for algo in ("ppo_cchain", "ppo")]
    for run, memory in zip(runs, (2_500_000_000, None), strict=True):
        (run.folder / DONE).write_text(json.dumps({"seconds": 16, "peak_memory": memory, "settings": {}}))
    assert cost_table(runs).splitlines()[2:] == ["| C-CHAIN PPO | 0 | 200 | 2.5 GB |", "| PPO | 0 | 200 | nan GB |"]
    tasks = [Task("one", -300.0, FRAME), Task("two", -1.0, FRAME)]
    report(SUITES["gym_control"], runs, tmp_path, tasks)
    lines = (tmp_path / "table.md").read_text().splitlines()
    assert [line.split(" | ")[0].strip("| *") for line in lines if line] == [
        *("algorithm", "---", "PPO", "C-CHAIN PPO", "PPO", "C-CHAIN PPO", "random policy"),
        *("algorithm", "---", "PPO", "C-CHAIN PPO"),
    ]
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")


def test_smoothed_by_hand():
    assert smoothed(np.array([1.0, 3.0, 8.0, 1.0]), window=2).tolist() == [1.0, 2.0, 5.5, 4.5]


def test_plot(tmp_path):
    runs = [make_run(tmp_path), make_run(tmp_path, "ppo_cchain")]
    for some, options in (
        (runs, {}),
        (runs[:1], {}),
        (runs, dict(own_scales=True, random_returns=[-60.0, -70.0], frames=[FRAME] * 2)),
    ):
        plot_curves(some, tmp_path / "new" / "curves.png", "title", **options)
        assert (tmp_path / "new" / "curves.png").read_bytes().startswith(b"\x89PNG")
        (tmp_path / "new" / "curves.png").unlink()


def test_runs_are_completed_and_not_repeated(tmp_path):
    run = Run("ppo_cchain", "Continual/CartPole-v1", 0, 2, 800, tmp_path / "run")
    complete([run], n_jobs=1)
    assert run.is_done and [row["timesteps"] for row in run.returns()] == [800, 1600]
    written = (run.folder / DONE).stat().st_mtime_ns
    assert json.loads((run.folder / DONE).read_text())["seconds"] > 0
    if sys.platform == "linux":
        assert 1e8 < json.loads((run.folder / DONE).read_text())["peak_memory"] < 1e10
    complete([run], n_jobs=1)
    assert (run.folder / DONE).stat().st_mtime_ns == written
    # Made with other settings, it does not count as done
    done = json.loads((run.folder / DONE).read_text())
    done["settings"]["hyperparameters"]["learning_rate"] = 1.0
    (run.folder / DONE).write_text(json.dumps(done))
    assert not run.is_done


def test_a_failed_run_names_its_log(tmp_path):
    run = Run("ppo", "Continual/Acrobat-v1", 0, 2, 800, tmp_path / "run")
    with pytest.raises(RuntimeError, match=r"Acrobat-v1 ppo seed 0 failed with exit code 1, see .*log.txt"):
        complete([run], n_jobs=1)
    assert "you maybe meant Continual/Acrobot-v1" in (run.folder / "log.txt").read_text()
    assert not run.is_done
