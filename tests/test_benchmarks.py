"""The benchmarks' own machinery."""

import json

import numpy as np
import pytest

from benchmarks.minatar import random_return
from benchmarks.report import averages_of, markdown_table, plot_curves, smoothed
from benchmarks.runs import DONE, Run, complete

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
    assert markdown_table(runs).splitlines() == [
        "| algorithm | seed | task 0 | task 1 | J(T) |",
        "| --- | --- | --- | --- | --- |",
        "| PPO | 0 | -15.0 | -40.0 | -27.5 |",
        "| PPO | 1 | -5.0 | 0.0 | -2.5 |",
        "| C-CHAIN PPO | 0 | -15.0 | -40.0 | -27.5 |",
        "| **PPO** | **mean** | **-10.0** | **-20.0** | **-15.0** |",
        "| **C-CHAIN PPO** | **mean** | **-15.0** | **-40.0** | **-27.5** |",
    ]


def test_random_policy_in_the_table(tmp_path):
    table = markdown_table([make_run(tmp_path)], random_returns=[-300.0, -1.0])
    assert table.splitlines()[-1] == "| random policy |  | -300 | -1.0 | -150 |"


def test_evaluations_by_task(tmp_path):
    run = make_run(tmp_path)
    folder = run.folder / "ppo" / "Continual-Acrobot-v1_1"
    folder.mkdir(parents=True)
    np.savez(folder / "evaluations.npz", timesteps=[800, 1600, 2400], results=[[1.0, 3.0], [5.0, 5.0], [8.0, 0.0]])
    assert [tuple(row.values()) for row in run.evaluations()] == [(800, 0, 2.0), (1600, 0, 5.0), (2400, 1, 4.0)]
    assert averages_of(run, Run.evaluations) == [3.5, 4.0]
    assert markdown_table([run], Run.evaluations).splitlines()[2] == "| PPO | 0 | 3.5 | 4.0 | 3.8 |"


def test_random_policy_on_a_game():
    # Measured with MinAtar alone over 9000 episodes: 0.51 ± 0.01
    assert 0.35 < random_return("Asterix", n_episodes=300) < 0.75


def test_smoothed_by_hand():
    assert smoothed(np.array([1.0, 3.0, 8.0, 1.0]), window=2).tolist() == [1.0, 2.0, 5.5, 4.5]


def test_plot(tmp_path):
    runs = [make_run(tmp_path), make_run(tmp_path, "ppo_cchain")]
    for some, options in ((runs, {}), (runs[:1], {}), (runs, dict(own_scales=True, random_returns=[-60.0, -70.0]))):
        plot_curves(some, tmp_path / "new" / "curves.png", "title", **options)
        assert (tmp_path / "new" / "curves.png").read_bytes().startswith(b"\x89PNG")
        (tmp_path / "new" / "curves.png").unlink()


def test_runs_are_completed_and_not_repeated(tmp_path):
    run = Run("ppo_cchain", "Continual/CartPole-v1", 0, 2, 800, tmp_path / "run")
    complete([run], n_jobs=1)
    assert run.is_done and [row["timesteps"] for row in run.returns()] == [800, 1600]
    written = (run.folder / DONE).stat().st_mtime_ns
    assert json.loads((run.folder / DONE).read_text())["seconds"] > 0
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
