"""The command ``benchmarks.shelf``, on scores written by hand."""

import json
import shutil

import pytest

from benchmarks import shelf
from benchmarks.grid.plan import SHELF_ENVS, shelf_runs
from benchmarks.grid.run import ROOT, suite_methods
from tests.extras import needs_dm_control

METHODS = {name: suite_methods("gym_control")[name] for name in ("vanilla", "trac", "cchain", "crelu")}
# CReLU has no run, TRAC one environment alone
SCORES = {
    "Continual/Acrobot-v1": {"vanilla": [-300.0, -100.0], "trac": [-90.0], "cchain": [-110.0, -112.0]},
    "Continual/LunarLander-v3": {"vanilla": [-300.0], "trac": [], "cchain": [-40.0]},
}


@needs_dm_control
def test_the_runs_of_the_shelf():
    runs = shelf_runs()
    assert {run.env_id for run in runs} == set(SHELF_ENVS) and {run.seed for run in runs} == {0, 1}
    assert {run.method for run in runs} == set(suite_methods("gym_control"))
    lengths = {run.suite: (run.n_tasks, run.steps_per_task, run.experiment) for run in runs}
    assert lengths == {"gym_control": (4, 64_000, "reduced"), "dmc": (3, 100_000, "reduced")}
    (run,) = shelf_runs(["Continual/Acrobot-v1"], ["trac"], [0], "smoke")
    assert (run.method, run.experiment) == ("trac", "smoke")


def test_a_table_from_the_best_to_the_worst():
    rows = [line.strip("| ").split(" | ") for line in shelf.shelf_table(SCORES, {"TRAC": 1.284}, METHODS).splitlines()]
    assert rows[0] == ["method", "Acrobot-v1, by seed", "mean", "LunarLander-v3, by seed", "mean", "time / PPO"]
    assert rows[2:] == [
        ["C-CHAIN PPO", "-110 -112", "-111", "-40", "-40", "–"],
        ["PPO", "-300 -100", "-200", "-300", "-300", "–"],
        ["TRAC", "-90", "-90", "–", "–", "1.28"],
        ["CReLU", "–", "–", "–", "–", "–"],
    ]


def test_the_committed_results_are_read(tmp_path):
    runs = shelf_runs(SHELF_ENVS[:2], ["vanilla"])
    scores = shelf.scores_of(runs, shelf.read_shelf(runs, ROOT / "benchmarks/results"))
    assert {env_id: len(scores[env_id]["vanilla"]) for env_id in SHELF_ENVS[:2]} == dict.fromkeys(SHELF_ENVS[:2], 2)
    costs = shelf.read_costs(ROOT / "docs" / shelf.COSTS)
    assert costs["PPO"] == 1 and 0.5 < costs["TRAC"] < 3


def changed(run, results, folder, **fields):
    """Copies a result, but for some fields of its ``run.json``."""
    shutil.copytree(run.path_in(results), run.path_in(folder))
    file = run.path_in(folder) / "run.json"
    saved = json.loads(file.read_text())
    file.write_text(json.dumps({**saved, **fields, "hyperparameters": saved["hyperparameters"] | fields["hyperparameters"]}))


def test_runs_with_former_hyperparameters_count_and_are_named(tmp_path):
    runs = shelf_runs(["Continual/Acrobot-v1"], ["vanilla", "cchain"], [0, 1])
    vanilla, _, cchain, longer = sorted(runs, key=lambda run: run.method, reverse=True)
    changed(vanilla, ROOT / "benchmarks/results", tmp_path, hyperparameters={"n_steps": 400})
    changed(cchain, ROOT / "benchmarks/results", tmp_path, hyperparameters={})
    changed(longer, ROOT / "benchmarks/results", tmp_path, hyperparameters={}, steps_per_task=160_000)
    done = shelf.read_shelf(runs, tmp_path)
    assert set(done) == {vanilla, cchain}
    assert shelf.otherwise_line(done, METHODS) == "Made with other hyperparameters than are shipped now: Acrobot-v1: PPO."
    assert shelf.otherwise_line({cchain: done[cchain]}, METHODS) == ""


def test_a_picture(tmp_path):
    pytest.importorskip("matplotlib")
    shelf.plot(SCORES, {"TRAC": 1.3}, METHODS, tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 10_000
