"""The report: its statistics by hand, and whole reports of small made-up results."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from scipy import stats

from benchmarks.grid.results import Result, read_results, write_result
from benchmarks.grid.run import ROOT, Run, as_json, make_run, paper_methods, shipped_hyperparameters, suite_methods
from benchmarks.grid.suites import SUITES, paper_length
from benchmarks.report.__main__ import main
from benchmarks.report.best_of import COLUMNS, best_strengths, best_table, paper_strengths, write_best
from benchmarks.report.cells import make_cells
from benchmarks.report.collapses import collapses, collapses_table
from benchmarks.report.continual_table import continual_table
from benchmarks.report.document import write_report
from benchmarks.report.estimates import (
    Difference,
    agrees,
    best_two,
    bootstrap_interval,
    difference,
    mean_and_error,
    normalized,
    probability_of_improvement,
    reliable_metrics,
    sample,
)
from benchmarks.report.figures import plot_learning_curves, plot_quantities, plot_reliable_metrics
from benchmarks.report.first_sight import missing_runs, missing_section, not_run
from benchmarks.report.markdown import code, escaped, markdown_table
from benchmarks.report.page import html_page
from benchmarks.report.paper import read_tables
from benchmarks.report.quantities import NTK, PLASTICITY, RETURNS, Quantity
from benchmarks.report.random_policy import TaskLook
from benchmarks.report.reliable import paper_over_oracle
from benchmarks.report.tables import aggregates, mark_differences, results_table, score_matrices
from benchmarks.report.task_tables import average_cells, cost_table, mean_rows, quantities_table, returns_header, returns_rows
from benchmarks.report.verdicts import sign_words, signs_table, verdict_words, verdicts_table

ACROBOT, CARTPOLE = "Continual/Acrobot-v1", "Continual/CartPole-v1"
VERSIONS = {"torch": "2.8.0", "gymnasium": "1.2.0"}


@pytest.fixture(autouse=True)
def few_resamples(monkeypatch):
    monkeypatch.setattr("benchmarks.report.estimates.N_RESAMPLES", 100)


@pytest.fixture
def no_drawing(monkeypatch):
    """For tests of the text alone."""
    for name in ("document.plot_learning_curves", "document.plot_quantities", "reliable.plot_reliable_metrics"):
        monkeypatch.setattr(
            f"benchmarks.report.{name}",
            lambda *arguments: [path.write_bytes(b"png") for path in arguments if isinstance(path, Path)],
        )


GYM_LINES = suite_methods("gym_control")


def write(folder, method, returns, env_id=ACROBOT, seed=0, metrics=(), suite="gym_control", **fields):
    """A run of two tasks of 100 steps, with one rollout for each of the returns of a task."""
    run = Run(suite, env_id, method, seed, 2, 100, "smoke", variant=fields.get("variant"))
    result = Result(
        **{
            **vars(run),
            "path": run.path_in(folder),
            "task_names": ["task 0", "task 1"],
            "hyperparameters": as_json(shipped_hyperparameters(run.algo, env_id)),
            "command": ["sb3-cchain", "train"],
            "versions": VERSIONS,
            "git_commit": None,
            "started": "2026-01-01T00:00:00+00:00",
            "finished": "2026-01-01T01:00:00+00:00",
            "seconds": 3600.0,
            "peak_memory": None,
            **fields,
        }
    )
    rows = [
        {"timesteps": 100 * task + 10 * (i + 1), "task_id": task, "n_episodes": 1, "mean_return": value}
        for task, values in enumerate(returns)
        for i, value in enumerate(values)
    ]
    write_result(result, rows, [dict(zip(("timesteps", "name", "value"), row, strict=True)) for row in metrics])
    return result.path


def whole_results(folder):
    results, left_out = read_results(folder)
    assert left_out == {}
    return results


def cells_in(folder):
    return make_cells(whole_results(folder))[0]


def table_rows(table):
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]


# Statistics


def test_mean_and_error_by_hand():
    # Deviations -2, 0, 2: variance 8 / 2
    assert mean_and_error([1.0, 3.0, 5.0]) == (3.0, pytest.approx(2 / 3**0.5))
    assert mean_and_error([7.0]) == (7.0, None)


def test_bootstrap_interval_by_hand():
    assert bootstrap_interval([1.0]) is None
    assert bootstrap_interval([4.0, 4.0]) == (4.0, 4.0)
    # Each seed alone makes up 1/4 or 1/27 of the resamples, more than 2.5 %
    assert bootstrap_interval([3.0, 1.0]) == (1.0, 3.0)
    assert bootstrap_interval([1.0, 5.0, 2.0]) == (1.0, 5.0)
    # The mean times 4 is binomial(4, 1/4): 0 has 31.6 %, 3 and more 5.1 %, 4 0.4 %
    assert bootstrap_interval([0.0, 0.0, 0.0, 1.0]) == (0.0, 0.75)
    # Many seeds: close to mean ± 1.96 standard errors
    scores = np.random.default_rng(1).normal(size=400)
    mean, error = mean_and_error(scores)
    assert bootstrap_interval(scores) == pytest.approx((mean - 1.96 * error, mean + 1.96 * error), abs=0.1 * error)


def test_agreement_is_overlap():
    assert agrees((1.0, 2.0), 3.0, 0.5) and agrees((4.0, 5.0), 3.0, 0.5) and agrees((0.0, 9.0), 3.0, 0.1)
    assert not agrees((1.0, 1.9), 3.0, 0.5) and not agrees((4.1, 5.0), 3.0, 0.5)


def test_best_two():
    assert best_two({"oracle": 9.0, "vanilla": 1.0, "trac": 3.0, "cchain": 2.0}) == {"trac": "best", "cchain": "second"}
    assert best_two({"oracle": 9.0, "vanilla": 1.0, "cchain": 2.0}) == {"cchain": "best"}
    assert best_two({"oracle": 9.0, "vanilla": 1.0}) == best_two({}) == {}
    assert best_two({"vanilla": 2.0, "trac": 2.0, "cchain": 1.0}) == {"vanilla": "best", "trac": "best"}


def test_normalized_by_hand():
    scores = normalized(np.array([[0.0, 5.0], [3.0, 10.0]]), np.array([-1.0, 5.0]), np.array([1.0, 15.0]))
    assert scores.tolist() == [[0.5, 0.0], [2.0, 0.5]]


def test_reliable_metrics_by_hand():
    # Environments' means 0.2, 0.4, 0.6 and 2.0; the 4 scores in the middle 0.3, 0.5, 0.4, 0.8; without what is above 1, 0.575
    scores = np.array([[0.1, 0.3, 0.4, 1.5], [0.3, 0.5, 0.8, 2.5]])
    estimates, intervals = reliable_metrics({"a": scores, "b": np.ones((2, 4))})
    middle = np.sort(scores.flatten())[2:6].mean()
    assert estimates["a"] == pytest.approx([0.8, 0.5, middle, 1 - np.minimum(scores, 1).mean()])
    assert estimates["b"].tolist() == [1.0, 1.0, 1.0, 0.0]
    assert intervals["b"].tolist() == [[1.0, 1.0, 1.0, 0.0]] * 2
    assert (intervals["a"][0] < estimates["a"]).all() and (estimates["a"] < intervals["a"][1]).all()


def test_intervals_repeat_and_leave_the_generator_alone():
    scores = {"a": np.random.default_rng(0).normal(size=(3, 2)), "cchain": np.random.default_rng(1).normal(size=(4, 2))}
    np.random.seed(5)
    first = reliable_metrics(scores)[1]["a"].tolist(), probability_of_improvement(scores, "cchain")
    after = np.random.rand()
    assert first == (reliable_metrics(scores)[1]["a"].tolist(), probability_of_improvement(scores, "cchain"))
    np.random.seed(5)
    assert after == np.random.rand()


def test_probability_of_improvement_by_hand():
    # First environment: of the pairs 2 > 1, 2 = 2, 4 > 1, 4 > 2; second: 0 < 1, 0 < 1, 1 = 1, 1 = 1
    scores = {"cchain": np.array([[2.0, 0.0], [4.0, 1.0]]), "a": np.array([[1.0, 1.0], [2.0, 1.0]])}
    probability, interval = probability_of_improvement(scores, "cchain")["a"]
    assert probability == (3.5 / 4 + 1 / 4) / 2
    assert interval[0] < probability < interval[1]


def test_probability_of_improvement_is_rliables():
    from rliable.metrics import probability_of_improvement as of_rliable

    rng = np.random.default_rng(0)
    scores = {"cchain": rng.integers(0, 4, (3, 5)).astype(float), "a": rng.integers(0, 4, (4, 5)).astype(float)}
    assert probability_of_improvement(scores, "cchain")["a"][0] == pytest.approx(of_rliable(scores["cchain"], scores["a"]))


# The paper's numbers


def test_the_papers_tables_are_whole():
    tables = read_tables()
    assert {suite: len(table.figures) for suite, table in tables.items()} == dict(
        gym_control=4 * 6 + 6, procgen=16 * 9 + 9, dmc=9, minatar=2
    )
    for name, table in tables.items():
        assert table.lengths.keys() == set(SUITES[name].env_ids)
        assert table.n_seeds == SUITES[name].n_paper_seeds
    figure = tables["procgen"].figures["Continual/BossFight-v0", "trac"]
    assert (figure.mean, figure.standard_error, figure.mark) == (4.722, 1.027, "second")
    for suite, table in tables.items():
        assert set(table.methods) <= set(paper_methods(suite))


def test_the_papers_lengths_are_those_of_the_environments():
    lengths = read_tables()["gym_control"].lengths
    assert lengths == {env_id: paper_length(env_id) for env_id in lengths}
    assert read_tables()["minatar"].lengths == {"Continual/MinAtar-v0": (3, 1_500_000)}
    assert read_tables()["dmc"].lengths["Continual/Dog-v0"] == (4, 1_000_000)
    assert set(read_tables()["procgen"].lengths.values()) == {(5, 2_000_000)}


def test_where_the_papers_marks_are_not_its_numbers():
    tables = read_tables()
    assert mark_differences("gym_control", tables["gym_control"]) == [
        "- CartPole-v1: TRAC is not marked; by its mean it is number 2 (without the Oracle).",
        "- CartPole-v1: C-CHAIN PPO is marked as second; by its mean it is number 3 (without the Oracle).",
    ]
    # Sums of the printed cells by hand
    assert mark_differences("procgen", tables["procgen"]) == [
        "- Aggregate: L2 Init is printed as 72.961; its cells sum to 72.525.",
        "- Aggregate: AdamRel is printed as 61.443; its cells sum to 61.749.",
        "- Aggregate: C-CHAIN PPO is printed as 101.792; its cells sum to 102.254.",
    ]
    assert mark_differences("dmc", tables["dmc"]) == mark_differences("minatar", tables["minatar"]) == []


# Cells and tables


def test_cells_by_hand(tmp_path):
    # J(T_0) = -15, J(T_1) = -40
    write(tmp_path, "cchain", [[-10, -20], [-40]], seed=3)
    write(tmp_path, "cchain", [[0], [0]], seed=1)
    cell = cells_in(tmp_path)[ACROBOT, "cchain"]
    assert cell.seeds == [1, 3] and cell.scores == (0.0, -27.5)
    assert (cell.mean, cell.error, cell.interval) == (-13.75, pytest.approx(13.75), (-27.5, 0.0))


@pytest.mark.parametrize(
    ("fields", "name"),
    [(dict(hyperparameters={"learning_rate": 1.0}), "hyperparameters"), (dict(steps_per_task=50), "steps_per_task")],
)
def test_other_settings_are_refused(tmp_path, fields, name):
    write(tmp_path, "cchain", [[0], [0]])
    write(tmp_path, "cchain", [[0], [0]], seed=1, **fields)
    with pytest.raises(ValueError, match=f"must not differ in `{name}`: .*seed_0 and .*seed_1"):
        cells_in(tmp_path)


def test_other_lengths_in_an_environment_are_refused(tmp_path):
    write(tmp_path, "cchain", [[0], [0]])
    write(tmp_path, "vanilla", [[0]], n_tasks=1, task_names=["task 0"])
    with pytest.raises(ValueError, match=r"must not differ in `n_tasks`: .*cchain.* and .*vanilla.* have 2 and 1"):
        cells_in(tmp_path)


def test_a_seed_that_is_there_twice_is_refused(tmp_path):
    write(tmp_path / "one", "cchain", [[0], [0]])
    write(tmp_path / "two", "cchain", [[0], [0]])
    with pytest.raises(ValueError, match="Seed 0 is there twice"):
        cells_in(tmp_path)


def test_a_cell_without_its_average_is_left_out_whole(tmp_path):
    write(tmp_path, "cchain", [[-1], [-1]])
    write(tmp_path, "cchain", [[-1], []], seed=1)
    assert make_cells(whole_results(tmp_path)) == ({}, [f"{ACROBOT}, cchain, seed 1: no return in task 1"])


def test_table_by_hand(tmp_path):
    for seed, value in enumerate((-100, -130)):
        write(tmp_path, "cchain", [[value], [value]], seed=seed)
        write(tmp_path, "trac", [[value - 100], [value - 100]], seed=seed, versions={**VERSIONS, "torch": f"2.{seed}"})
    write(tmp_path, "vanilla", [[-300], [-400]], seed=7)
    write(tmp_path, "oracle", [[-1], [-2]])
    rows = table_rows(results_table("gym_control", cells_in(tmp_path), read_tables()["gym_control"]))
    assert rows[:6] == [
        ["J(T)", "", "Oracle", "PPO", "TRAC", "Weight clipping", "L2 Init", "C-CHAIN PPO"],
        ["---"] * 8,
        ["Acrobot-v1", "here", "-1.5", "-350.0", "<ins>-215.0 ± 15.0</ins> †", "–", "–", "**-115.0 ± 15.0**"],
        ["", "95 % interval", "–", "–", "[-230.0, -200.0]", "–", "–", "[-130.0, -100.0]"],
        [
            *("", "paper", "-125.7 ± 8.3", "-372.7 ± 3.3", "-166.6 ± 8.9", "**-118.8 ± 13.4**"),
            *("-134.0 ± 14.3", "<ins>-119.2 ± 6.9</ins>"),
        ],
        ["", "seeds", "0", "7", "0 1", "–", "–", "0 1"],
    ]
    assert rows[6] == ["CartPole-v1", "here", *["–"] * 6]
    # By the numbers, and not as printed
    assert rows[7][4:] == ["<ins>217.4 ± 26.3</ins>", "154.3 ± 16.0", "**266.1 ± 5.3**", "160.4 ± 14.6"]
    assert rows[-2:] == [
        ["aggregate", "here", *["–"] * 6],
        ["", "paper", "-147.3", "-1157.0", "-407.3", "-291.0", "<ins>-244.0</ins>", "**-221.2**"],
    ]


def test_table_of_tasks_by_hand(tmp_path):
    write(tmp_path, "cchain", [[-10, -20], [-40]])
    write(tmp_path, "vanilla", [[-1], []], seed=1)
    write(tmp_path, "vanilla", [[-1], [-2]], seed=0)
    results = whole_results(tmp_path)
    assert returns_header(results[0].task_names) == ["method", "seed", "task 0", "task 1", "J(T)"]
    assert returns_rows(results, GYM_LINES) == [
        ["PPO", "0", "-1.0", "-2.0", "-1.5"],
        ["PPO", "1", "-1.0", "–", "–"],
        ["C-CHAIN PPO", "0", "-15.0", "-40.0", "-27.5"],
    ]


def test_table_of_plasticity_by_hand(tmp_path):
    # The Oracle's curve in the second task: 10 until step 110, a line to 20 at 120, then level: 0.1 of 10, of 15, 0.8 of 20
    write(tmp_path, "oracle", [[10.0, 10.0], [10.0, 20.0]])
    write(tmp_path, "oracle", [[30.0, 30.0], [30.0, 30.0]], seed=1)
    write(tmp_path, "vanilla", [[10.0, 12.0], [5.0, 5.0]], metrics=[(100, "continual_eval/forgetting", 9.0)])
    write(tmp_path, "vanilla", [[10.0, 8.0], [5.0, 15.0]], seed=1)
    # Without an Oracle of its tasks
    write(tmp_path, "vanilla", [[1000.0, 1000.0], [-1000.0, -1000.0]], seed=2)
    write(tmp_path, "cchain", [[10.0, 10.0], [20.0, 30.0]], metrics=[(200, "continual_eval/forgetting", 1.0)])
    runs = whole_results(tmp_path)
    header, _, *rows = table_rows(continual_table(runs, GYM_LINES, 1, own_scales=False))
    cells = {row[0]: dict(zip(header[1:], row[1:], strict=True)) for row in rows}
    oracle, vanilla, cchain = (cells[GYM_LINES[name].label] for name in ("oracle", "vanilla", "cchain"))
    assert vanilla["seeds"] == "0 1 2" and vanilla["forgetting"] == "9.0" and cchain["forgetting"] == "1.0"
    # Of the Oracle's means with seeds 0 and 1: (10 + 30) / 2 - (11 + 9) / 2, (15 + 30) / 2 - (5 + 10) / 2
    assert (vanilla["gap, first task"], vanilla["gap, last task"]) == ("10.0", "15.0")
    # Seed 0 alone
    assert (cchain["gap, first task"], cchain["gap, last task"]) == ("0.0", "-10.0")
    # The best is 30. Vanilla's areas are 5 and 0.1 of 5, 0.1 of 10, 0.8 of 15; C-CHAIN's 0.1 of 20, of 25, of 30
    assert vanilla["forward transfer"] == f"{((5 + 13.5) / 2 - (18.5 + 30) / 2) / (30 - (18.5 + 30) / 2):.2f}"
    assert cchain["forward transfer"] == f"{(28.5 - 18.5) / 11.5:.2f}"
    # To 11, never; to 9, by the second rollout, 100 steps after the last of the task before
    assert (vanilla["recovered"], vanilla["steps to recover"]) == ("1 of 3", "100")
    assert (cchain["recovered"], cchain["steps to recover"]) == ("1 of 1", "90")
    assert (oracle["gap, last task"], oracle["forward transfer"], oracle["recovered"]) == ("–", "–", "2 of 2")


def test_table_of_plasticity_without_its_data(tmp_path):
    write(tmp_path, "vanilla", [[10.0, 12.0], [5.0, 5.0]])
    header, _, row = table_rows(continual_table(whole_results(tmp_path), GYM_LINES, 1, own_scales=True))
    assert row[2:] == ["–"] * 5 and "forgetting" not in header


def test_aggregate_of_complete_methods_by_hand(tmp_path):
    paper = read_tables()["gym_control"]
    for i, env_id in enumerate(paper.lengths):
        write(tmp_path, "cchain", [[i], [2 * i]], env_id=env_id)
        write(tmp_path, "vanilla", [[1], [1]], env_id=env_id)
    write(tmp_path, "trac", [[1], [1]])
    cells = cells_in(tmp_path)
    assert aggregates(cells, ["vanilla", "trac", "cchain"], paper) == {"vanilla": 4.0, "cchain": 9.0}
    assert table_rows(results_table("gym_control", cells, paper))[-2] == [
        "aggregate",
        "here",
        "–",
        "4.0",
        "–",
        "–",
        "–",
        "**9.0**",
    ]


def test_what_is_complete_over_environments(tmp_path):
    for env_id in (ACROBOT, CARTPOLE):
        for seed in (0, 1):
            write(tmp_path, "cchain", [[seed], [seed]], env_id=env_id, seed=seed)
        write(tmp_path, "vanilla", [[5], [5]], env_id=env_id, seed=2)
    write(tmp_path, "vanilla", [[5], [5]], seed=3)
    write(tmp_path, "trac", [[1], [1]])
    write(tmp_path, "cchain", [[1], [1]], env_id="Continual/MountainCar-v0")
    env_ids, scores, seeds = score_matrices(cells_in(tmp_path), read_tables()["gym_control"])
    assert env_ids == [ACROBOT, CARTPOLE] and seeds == {"vanilla": [2], "cchain": [0, 1]}
    assert {name: matrix.tolist() for name, matrix in scores.items()} == {
        "vanilla": [[5.0, 5.0]],
        "cchain": [[0.0, 0.0], [1.0, 1.0]],
    }


def test_ntk_table_by_hand(tmp_path):
    write(tmp_path, "cchain", [[0], [0]], metrics=[(50, "ntk/srank", 2.0), (100, "ntk/srank", 4.0), (150, "ntk/srank", 9.0)])
    write(tmp_path, "cchain", [[0], [0]], seed=1, metrics=[(50, "ntk/srank", 5.0), (150, "ntk/srank", 1.0)])
    assert table_rows(quantities_table(whole_results(tmp_path), GYM_LINES, NTK))[2:] == [
        ["NTK: srank", "C-CHAIN PPO", "0 1", "4", "5"],
        *([quantity.label, "C-CHAIN PPO", "0 1", "–", "–"] for quantity in NTK[1:]),
    ]
    per_seed = quantities_table(whole_results(tmp_path), GYM_LINES, NTK[:1], per_seed=True)
    assert table_rows(per_seed)[2] == ["NTK: srank", "C-CHAIN PPO", "0 1", "3 / 5", "9 / 1"]


# Pictures and page


def test_which_task_a_metric_is_of(tmp_path):
    """The step that ends a task is of that task, and the last rollout goes beyond the end of the last."""
    metrics = [(steps, "ntk/srank", value) for value, steps in enumerate((50, 100, 101, 200, 210))]
    write(tmp_path, "cchain", [[0], [0]], metrics=metrics)
    (result,) = whole_results(tmp_path)
    series = [[part.tolist() for part in result.metric_in_task("ntk/srank", task)] for task in (0, 1)]
    assert series == [[[50, 100], [0.0, 1.0]], [[101, 200, 210], [2.0, 3.0, 4.0]]]
    assert result.metric_in_task("ntk/diagonal_sum", 0)[0].size == 0


def test_a_rollout_over_a_switch_counts_in_both_tasks(tmp_path):
    """Its rows have the same environment step, that of its end, behind the switch."""
    path = write(tmp_path, "cchain", [[0], [0]])
    rows = "timesteps,task_id,n_episodes,mean_return\n60,0,1,900\n120,0,1,910\n120,1,2,100\n240,1,1,110\n"
    (path / "returns.csv").write_text(rows)
    (result,) = whole_results(tmp_path)
    series = [[part.tolist() for part in result.returns_in_task(task)] for task in (0, 1)]
    assert series == [[[60, 120], [900.0, 910.0]], [[120, 240], [100.0, 110.0]]]


GYM_METHODS = suite_methods("gym_control")
LONGEST_LABELS = sorted(GYM_METHODS, key=lambda name: len(GYM_METHODS[name].label))[-6:]


@pytest.mark.parametrize(
    "suite, env_id, methods",
    [("procgen", "Continual/Maze-v0", paper_methods("procgen")), ("gym_control", ACROBOT, LONGEST_LABELS)],
    ids=["the most in a suite of the paper", "the longest names"],
)
def test_the_legend_fits(suite, env_id, methods, tmp_path, monkeypatch):
    import matplotlib.pyplot as plt

    for method in methods:
        write(tmp_path, method, [[0, 1], [0, 1]], env_id, suite=suite)
    figures = []
    monkeypatch.setattr(plt, "close", figures.append)
    monkeypatch.setattr("benchmarks.report.figures.MOST_IN_A_PANEL", len(methods))  # in one panel, as with frames
    plot_learning_curves(whole_results(tmp_path), tmp_path / "picture.png", suite_methods(suite))
    monkeypatch.undo()
    (figure,) = figures
    (legend,) = figure.legends
    assert len(legend.get_texts()) == len(methods)
    box = legend.get_window_extent()
    assert 0 <= box.x0 and box.x1 <= figure.bbox.width
    plt.close(figure)


@pytest.mark.parametrize("n_methods", [3, 4])
def test_many_methods_have_panels_of_their_own(n_methods, tmp_path, monkeypatch):
    import matplotlib.pyplot as plt

    for method in LONGEST_LABELS[:n_methods]:
        write(tmp_path, method, [[0, 1], [0, 1]], ACROBOT)
    figures = []
    monkeypatch.setattr(plt, "close", figures.append)
    plot_learning_curves(whole_results(tmp_path), tmp_path / "picture.png", GYM_METHODS)
    monkeypatch.undo()
    (figure,) = figures
    titles = {panel.get_title(loc="left") for panel in figure.axes}
    assert titles == ({""} if n_methods == 3 else {GYM_METHODS[method].label for method in LONGEST_LABELS[:4]})
    plt.close(figure)


def test_page_needs_nothing_beside_it(tmp_path):
    (tmp_path / "a.png").write_bytes(b"picture")
    page = html_page(
        "# A title\n\n## Over `all` environments\n\n![words](a.png)\n\n| a | b |\n| --- | --- |\n| **1** | <ins>2</ins> |\n",
        {"a.png": tmp_path / "a.png"},
    )
    assert '<h2 id="over-all-environments">' in page and "<title>A title</title>" in page
    assert 'src="data:image/png;base64,cGljdHVyZQ=="' in page and 'alt="words"' in page
    assert "<td><strong>1</strong></td>" in page and "<td><ins>2</ins></td>" in page
    assert not re.search(r"https?://|<script", page)


def test_the_page_embeds_no_other_file_and_passes_no_html(tmp_path):
    (tmp_path / "secret.png").write_bytes(b"secret")
    page = html_page(f"# <script>\n\n![x](secret.png) ![x]({tmp_path}/secret.png)\n\n<meta http-equiv=refresh>\n", {})
    assert "c2VjcmV0" not in page and page.count('src="data:image/png;base64,"') == 2
    assert not re.search("<script|<meta http-equiv=refresh", page)


HOSTILE = [
    "<meta http-equiv=refresh content=0><script>alert(1)</script>",
    "![x](secret.png)",
    "[x](javascript:alert(1))",
    "a | b",
    "a\n\n# b\n\n<b>",
    "`` ` ![x](secret.png)",
    "</title></table>",
    "***a***",
]


@pytest.mark.parametrize("text", HOSTILE)
def test_text_from_a_file_stays_text(text):
    from markdown_it import MarkdownIt

    render = MarkdownIt("commonmark", {"html": True}).enable("table").render
    line = " ".join(text.split())
    shown = line.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;").replace('"', "&quot;")
    assert render(escaped(text)) == f"<p>{shown}</p>\n"
    assert render(code(text)) == f"<p><code>{shown}</code></p>\n"
    table = render(f"| {escaped(text)} | 2 |\n| --- | --- |\n")
    assert table.count("<th>") == 2 and f"<th>{shown}</th>" in table


@pytest.mark.parametrize("text", HOSTILE)
def test_no_text_of_a_run_acts_as_markup(tmp_path, text, no_drawing):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "secret.png").write_bytes(b"secret")
    fields = dict(
        git_commit=text,
        task_names=[text, "task 1"],
        hyperparameters={"policy": text, text: 1},
    )
    write(tmp_path, "cchain", [[1], [1]], versions={text: text}, **fields)
    write(tmp_path, "cchain", [[1], [1]], seed=1, versions={text: text, "torch": text}, **fields)
    write(tmp_path, "trac", [[1], []], **fields)
    write_report(whole_results(tmp_path), "smoke", tmp_path / "out", [text])
    text_lines = (tmp_path / "out" / "report.md").read_text()
    page = (tmp_path / "out" / "report.html").read_text()
    assert not re.search(r"<script|<meta http-equiv=.?refresh|<b>|</title></table>|href=\"javascript|<em>a", page)
    assert "c2VjcmV0" not in page and page.count("<h1") == 1 and "\n# b" not in text_lines
    # Two tables have a column for each task, and no further one
    assert page.count("<th>J(T)</th>") == 2 and page.count("<th>task 1</th>") == 1


def test_where_a_policy_has_collapsed_and_with_which_churn_it_began(tmp_path):
    # The mean of the last ten rollouts counts: a single return of -400 is no collapse. Each value is logged a rollout late
    churn = [(120, "churn/policy_churn", 0.25), (130, "churn/policy_churn", 1.0)]
    write(tmp_path, "cchain", [[-400] * 12, [-100] * 9 + [-400]], metrics=churn)
    churn = [(step, "churn/policy_churn", value) for step, value in ((120, 2e-8), (130, 0.0), (140, 0.0))]
    write(tmp_path, "cchain", [[-90] * 12, [-90, -90] + [-400] * 10], seed=1, metrics=churn)
    # As low, but the policy changes
    churn = [(step, "churn/policy_churn", value) for step, value in ((120, 2e-8), (130, 3e-6), (140, 2e-6))]
    write(tmp_path, "cchain", [[-90] * 12, [-400] * 12], seed=2, metrics=churn)
    write(tmp_path, "vanilla", [[-90] * 12, [-400] * 12])
    results = whole_results(tmp_path)
    assert collapses(results) == (2, 4)
    assert collapses_table(results, GYM_LINES) == markdown_table(
        ["method", "seed", "1"],
        [["C-CHAIN PPO", "0", "0.2"], ["C-CHAIN PPO", "1", "**2e-08**"], ["C-CHAIN PPO", "2", "2e-08"]],
    )


def make_results(folder):
    ntk = [
        (steps, name, value)
        for steps, value in ((50, 2.0), (100, 3.0), (150, 4.0), (200, 5.0))
        for name in ("ntk/srank", "ntk/off_diagonal_sum", "ntk/diagonal_sum")
    ]
    for env_id in (ACROBOT, CARTPOLE):
        for seed in (0, 1):
            write(folder, "cchain", [[-90 - seed, -80], [-100, -90]], env_id=env_id, seed=seed, metrics=ntk)
            write(folder, "vanilla", [[-90, -80 - seed], [-400, -400]], env_id=env_id, seed=seed)
    write(folder, "oracle", [[-90, -80], [-100]])


@pytest.fixture(scope="module")
def whole_report(tmp_path_factory):
    """Text and page of the report of :func:`make_results`, its folder, and the folder of the results."""
    results = tmp_path_factory.mktemp("results")
    make_results(results)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("benchmarks.report.estimates.N_RESAMPLES", 100)
        patch.setattr(sys, "argv", ["report", "--results", str(results), "--budget", "smoke"])
        main()
    folder = results / "smoke"
    return (folder / "report.md").read_text(), (folder / "report.html").read_text(), folder, results


def test_whole_report(whole_report):
    text, page, folder, results = whole_report
    assert "budget `smoke`" in text and "9 finished runs of 2 seeds" in text
    assert "- Not run: Continual ProcGen, Continual DeepMind Control, Continual MinAtar." in text
    assert "Of the paper's 24 cells 0 agree, 0 disagree, 5 have not enough runs, 19 have no run." in text
    assert "| Acrobot-v1 | 2 × 100 | 10 × 160,000 |" in text and "not expected to agree" in text
    assert "Left out, because they do not have runs in all of them: Oracle, TRAC, Weight clipping, L2 Init." in text
    assert "| PPO | 1.00 [1.00, 1.00] | 2 of 2 | 2 of 2 |" in text
    # Two commands that make just the runs of the page
    command = "python -m benchmarks.run --suite gym_control --budget smoke"
    assert [line for line in text.splitlines() if line.startswith(command) and "--seeds" in line] == [
        f"{command} --env Continual/Acrobot-v1 Continual/CartPole-v1 --method vanilla cchain --seeds 0 1",
        f"{command} --env Continual/Acrobot-v1 --method oracle --seeds 0",
    ]
    assert "9 runs, 9.0 hours" in text and not re.search(r"\bnan\b|None", text)
    pictures = sorted(re.findall(r"\]\((pictures/.*?)\)", text))
    assert pictures == sorted(str(path.relative_to(folder)) for path in folder.glob("pictures/*.png"))
    assert len(pictures) == 5 and page.count("data:image/png;base64,") == 5
    # Every anchor has its heading
    assert set(re.findall(r'href="#(.*?)"', page)) == {"continual-gym-control"} <= set(re.findall(r'id="(.*?)"', page))
    assert not re.search(r"https?://|<script", page)
    # Beside the results, it is not one of them
    assert len(whole_results(results)) == 9


def test_report_of_a_single_seed(tmp_path):
    for method in ("vanilla", "cchain"):
        write(tmp_path, method, [[-90], [-100]])
    write_report(whole_results(tmp_path), "smoke", tmp_path / "out")
    text = (tmp_path / "out" / "report.md").read_text()
    assert "| Acrobot-v1 | here | – | **-95.0** | – | – | – | **-95.0** |" in text
    assert "| C-CHAIN PPO | 0 | 1.09 | 1.09 | 1.09 | 0.00 |" in text and "| PPO | 0.50 | 0 of 1 | 1 of 1 |" in text
    assert not (tmp_path / "out" / "pictures" / "metrics_gym_control.png").exists()


def test_report_of_a_method_alone(tmp_path, no_drawing):
    write(tmp_path, "trac", [[-90], []])
    write_report(whole_results(tmp_path), "smoke", tmp_path / "out")
    text = (tmp_path / "out" / "report.md").read_text()
    assert f"Left out, because their J(T) is not defined:\n\n- {ACROBOT}, trac, seed 0: no return in task 1" in text
    assert "Over the environments" not in text and "Neural" not in text


def test_each_picture_has_few_curves(tmp_path, no_drawing, monkeypatch):
    others = ["layer_norm", "redo", "adam_rel", "parseval", "fire", "muon", "simba"]  # in the order of the tables
    for method in ("vanilla", "cchain", *others):
        write(tmp_path, method, [[-90], [-90]])
    drawn = []
    monkeypatch.setattr(
        "benchmarks.report.document.plot_learning_curves",
        lambda runs, path, lines: (drawn.append((path.name, [run.method for run in runs])), path.write_bytes(b"png")),
    )
    write_report(whole_results(tmp_path), "smoke", tmp_path / "out")
    name = "curves_Continual-Acrobot-v1"
    assert [picture for picture, _ in drawn] == [f"{name}.png", f"{name}_2.png", f"{name}_3.png"]
    assert [set(methods) for _, methods in drawn] == [
        {"vanilla", "cchain"},
        {"vanilla", *others[:5]},
        {"vanilla", *others[5:]},
    ]
    text = (tmp_path / "out" / "report.md").read_text()
    assert all(f"(pictures/{picture})" in text for picture, _ in drawn)


@pytest.mark.parametrize("lines", [("cchain", "cchain@1e3", "cchain@1e4"), ("cchain@1e4",)])
def test_another_beta_has_columns_of_its_own(tmp_path, lines):
    for seed in (0, 1):
        write(tmp_path, "vanilla", [[-400], [-300]], seed=seed)
        for number, line in enumerate(lines):
            beta = {"variant": line, "overrides": (f"target_churn_ratio:{line[7:]}",)} if "@" in line else {}
            write(tmp_path, "cchain", [[-200 + 2 * number], [-100 - seed]], seed=seed, **beta)
    # One that was named so and has something else is none of them
    write(tmp_path, "cchain", [[0], [0]], variant="cchain@5", overrides=("n_epochs:1",))
    (reason,) = write_report(whole_results(tmp_path), "smoke", tmp_path)
    assert "not under the shipped hyperparameters, but with n_epochs:1" in reason
    text = (tmp_path / "report.md").read_text()
    labels = ["C-CHAIN PPO", *(f"C-CHAIN PPO, β = {line[7:]}" for line in lines if "@" in line)]
    header = next(row for row in table_rows(text) if row[0] == "J(T)")
    assert header[-len(labels) :] == labels
    row = next(row for row in table_rows(text) if row[:2] == ["Acrobot-v1", "here"])
    assert [float(re.search(r"-\d+\.\d", cell)[0]) for cell in row[-len(lines) :]] == [-150.2 + i for i in range(len(lines))]
    assert "`target_churn_ratio: 10000.0`" in text
    # The last of them is compared with Vanilla, where the shipped one is absent
    compared = "C-CHAIN" if "cchain" in lines else labels[-1]
    assert f"where Vanilla and {compared} both have runs" in text and f"| {compared} over |" in text
    assert f"--method vanilla {' '.join(lines)} --seeds 0 1" in text


def test_versions_that_differ_are_told(tmp_path, no_drawing):
    write(tmp_path, "trac", [[-90], [-90]])
    write(tmp_path, "trac", [[-90], [-90]], seed=1, versions={**VERSIONS, "torch": "2.9.0"})
    write_report(whole_results(tmp_path), "smoke", tmp_path / "out")
    told = "- † Acrobot-v1, TRAC: seeds 0 with torch 2.8.0; seeds 1 with torch 2.9.0"
    assert told in (tmp_path / "out" / "report.md").read_text()


def test_hyperparameters_are_told(whole_report, tmp_path, no_drawing):
    text = whole_report[0]
    (line,) = [line for line in text.splitlines() if line.startswith("- C-CHAIN PPO (Acrobot-v1, CartPole-v1): ")]
    assert "`churn_coef: auto_1`, `target_churn_ratio: 10000.0`" in line and "learning_rate" not in line
    assert "shipped now" not in text
    write(tmp_path, "trac", [[0], [0]], hyperparameters={"learning_rate": 1.0})
    write_report(whole_results(tmp_path), "smoke", tmp_path / "out")
    text = (tmp_path / "out" / "report.md").read_text()
    assert "- TRAC (Acrobot-v1): `learning_rate: 1.0`" in text
    assert "than are shipped now:**\n\n- Acrobot-v1, TRAC, seed 0\n\n" in text


def test_methods_are_compared_with_the_settings_that_vanilla_had(tmp_path, no_drawing):
    former = {"learning_rate": 1.0}
    write(tmp_path, "vanilla", [[0], [0]], hyperparameters=former)
    write(tmp_path, "trac", [[0], [0]], hyperparameters={**former, "n_epochs": 1})
    write_report(whole_results(tmp_path), "smoke", tmp_path / "out")
    assert "- TRAC (Acrobot-v1): `n_epochs: 1`\n" in (tmp_path / "out" / "report.md").read_text()


def test_seeds_that_lack_are_told(whole_report):
    text = whole_report[0]
    assert (
        "Not all of the seeds 0 1 finished, because time ran out or they failed:\n\n- 0 alone: Acrobot-v1 Oracle\n\n" in text
    )


def test_the_count_of_higher_means_is_of_the_seeds_that_are_compared(tmp_path, no_drawing):
    """Of C-CHAIN seed 0, which is in both environments: 1 < 2 in the first, where seed 1 would turn it round."""
    write(tmp_path, "cchain", [[1], [1]])
    write(tmp_path, "cchain", [[9], [9]], seed=1)
    write(tmp_path, "vanilla", [[2], [2]])
    for method, value in (("cchain", 5), ("vanilla", 4)):
        write(tmp_path, method, [[value], [value]], env_id=CARTPOLE)
    write_report(whole_results(tmp_path), "smoke", tmp_path / "out")
    assert "| PPO | 0.50 | 1 of 2 | 2 of 2 |" in (tmp_path / "out" / "report.md").read_text()


def test_runs_that_cannot_be_compared(tmp_path, monkeypatch, capsys, no_drawing):
    make_results(tmp_path)
    monkeypatch.setattr(sys, "argv", ["report", "--results", str(tmp_path), "--budget", "smoke"])
    write(tmp_path, "trac", [[0], [0]])
    write(tmp_path, "trac", [[0], [0]], seed=1, hyperparameters={})
    with pytest.raises(SystemExit):
        main()
    assert "Runs of one table must not differ in `hyperparameters`" in capsys.readouterr().err


def edit_json(path, **fields):
    file = path / "run.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **fields}))


DAMAGES = {
    "empty run.json": (lambda path: (path / "run.json").write_text(""), "is not a result"),
    "run.json that is a list": (lambda path: (path / "run.json").write_text("[]"), "is not a result"),
    "run.json of bytes": (lambda path: (path / "run.json").write_bytes(b"\xff\xfe"), "is not a result"),
    "missing returns": (lambda path: (path / "returns.csv").unlink(), "returns.csv is missing or damaged"),
    "missing metrics": (lambda path: (path / "metrics.csv").unlink(), "metrics.csv is missing or damaged"),
    "empty returns": (lambda path: (path / "returns.csv").write_text(""), "its first line must be timesteps,task_id"),
    "torn returns": (
        lambda path: (path / "returns.csv").write_text("timesteps,task_id,n_episodes,mean_return\n1,0,1,-1"),
        "torn",
    ),
    "returns of words": (
        lambda path: (path / "returns.csv").write_text("timesteps,task_id,n_episodes,mean_return\n1,0,1,x\n"),
        "could not convert",
    ),
    "short row of metrics": (lambda path: (path / "metrics.csv").write_text("timesteps,name,value\n1,a\n"), "metrics.csv"),
    "unknown method": (lambda path: edit_json(path, method="nonsense"), "unknown method 'nonsense' in gym_control"),
    "unknown suite": (lambda path: edit_json(path, suite="nonsense"), "unknown suite 'nonsense'"),
    "seed as a string": (lambda path: edit_json(path, seed="0"), "`seed` must be int; got '0'"),
    "seed as a truth value": (lambda path: edit_json(path, seed=True), "`seed` must be int; got True"),
    "negative seed": (lambda path: edit_json(path, seed=-1), "`seed` is out of range: -1"),
    "no time": (lambda path: edit_json(path, seconds=0), "`seconds` is out of range: 0"),
    "versions that are no texts": (lambda path: edit_json(path, versions={"torch": 2}), "`versions` must be"),
    "too few names of tasks": (lambda path: edit_json(path, task_names=["task 0"]), "`task_names` must be 2; got 1"),
    "names of tasks that are numbers": (lambda path: edit_json(path, task_names=[0, 1]), "`task_names` must be"),
    "too many steps": (lambda path: edit_json(path, steps_per_task=10**400), "`steps_per_task` is out of range"),
    "too many steps in returns": (
        lambda path: (path / "returns.csv").write_text(f"timesteps,task_id,n_episodes,mean_return\n{10**30},0,1,1\n"),
        "counts that are out of range",
    ),
    "a part of run.json": (
        lambda path: (path / "run.json").write_text('{"experiment": "smoke"}'),
        "is not a result (Result.__init__() missing",
    ),
    "run.json that is a folder": (
        lambda path: ((path / "run.json").unlink(), (path / "run.json").mkdir()),
        "is not a result",
    ),
    "an unknown field": (lambda path: edit_json(path, nonsense=1), "nonsense"),
    "an unknown environment": (
        lambda path: edit_json(path, env_id="Continual/Pendulum-v1"),
        "no Continual/Pendulum-v1 in gym_control",
    ),
    "a variant": (lambda path: edit_json(path, variant="orthogonal", overrides=["a:1"]), "but with a:1"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_run_that_cannot_be_read_is_named_and_left_out(tmp_path, monkeypatch, capsys, damage, no_drawing):
    write(tmp_path, "vanilla", [[-90], [-100]])
    path = write(tmp_path, "cchain", [[-90], [-100]])
    spoil, reason = DAMAGES[damage]
    spoil(path)
    monkeypatch.setattr(sys, "argv", ["report", "--results", str(tmp_path), "--budget", "smoke"])
    main()
    printed = capsys.readouterr().out
    assert f"Left out: {path}" in printed and reason in printed
    text = (tmp_path / "smoke" / "report.md").read_text()
    assert "1 finished runs of a single seed" in text
    assert f"These are left out:\n\n- {escaped(path)}" in text


def test_a_suite_that_the_paper_does_not_have_is_left_out(tmp_path, monkeypatch, no_drawing):
    write(tmp_path, "cchain", [[-90], [-100]])
    path = write(tmp_path, "cchain", [[-90], [-100]], "Continual/Walker-v0", suite="dmc")
    tables = read_tables()
    del tables["dmc"]
    monkeypatch.setattr("benchmarks.report.document.read_tables", lambda: tables)
    reasons = write_report(whole_results(tmp_path), "smoke", tmp_path / "out")
    assert reasons == [f"{path}: the paper has no Continual/Walker-v0 in dmc"]


def test_a_report_of_nothing_is_an_error(tmp_path, monkeypatch, capsys):
    path = write(tmp_path, "cchain", [[-90], [-90]])
    monkeypatch.setattr(sys, "argv", ["report", "--results", str(tmp_path), "--budget", "smoke"])
    for env_id in ("Continual/Pendulum-v1", 3):
        edit_json(path, env_id=env_id)
        with pytest.raises(SystemExit):
            main()
        assert str(path) in capsys.readouterr().err


def test_a_budget_that_is_not_there(tmp_path, monkeypatch, capsys):
    make_results(tmp_path)
    monkeypatch.setattr(sys, "argv", ["report", "--results", str(tmp_path)])
    with pytest.raises(SystemExit):
        main()
    assert "no results of --budget reduced" in capsys.readouterr().err


# Tables and pictures of single runs


def test_means_and_costs_by_hand(tmp_path):
    write(tmp_path, "cchain", [[-10, -20], [-40]], seconds=100.0, peak_memory=2_500_000_000)
    write(tmp_path, "vanilla", [[-5], [0]], seed=1)
    write(tmp_path, "vanilla", [[-15], [-40]])
    results = whole_results(tmp_path)
    assert mean_rows(results, GYM_LINES) == [
        ["**PPO**", "**mean**", "**-10.0**", "**-20.0**", "**-15.0**"],
        ["**C-CHAIN PPO**", "**mean**", "**-15.0**", "**-40.0**", "**-27.5**"],
    ]
    assert average_cells([-300.0, -1.0]) == ["-300.0", "-1.0", "-150.5"]
    assert table_rows(cost_table(results, GYM_LINES))[2:] == [
        ["PPO", "0", "0", "–"],
        ["PPO", "1", "0", "–"],
        ["C-CHAIN PPO", "0", "2", "2.5 GB"],
    ]


def test_what_is_logged_a_rollout_later_counts_where_it_was_made(tmp_path):
    write(tmp_path, "cchain", [[0, 1], [0, 1]], metrics=[(steps, "churn/coef", steps) for steps in (20, 110, 120)])
    (result,) = whole_results(tmp_path)
    # Rollouts of 10 steps
    assert Quantity("churn/coef", "", delay=1).series(result, 0)[1].tolist() == [20, 110]
    assert Quantity("churn/coef", "", delay=0).series(result, 0)[1].tolist() == [20]
    assert RETURNS.series(result, 1)[1].tolist() == [0, 1]


def test_both_tasks_in_one_rollout(tmp_path):
    write(tmp_path, "cchain", [[0], [1]], metrics=[(20, "churn/coef", 20)])
    (result,) = whole_results(tmp_path)
    for row in result.returns:
        row["timesteps"] = 200
    assert Quantity("churn/coef", "", delay=1).series(result, 0)[1].tolist() == [20]
    # A rollout before: what was logged at 20 was made at 120 - 200 and no earlier rollout
    result.returns.insert(0, {**result.returns[0], "timesteps": 100})
    assert Quantity("churn/coef", "", delay=1).series(result, 0)[0].tolist() == [-80]


FRAME = np.zeros((20, 30, 3), np.uint8)


@pytest.mark.parametrize(
    "suite, env_id, looks, n_axes",
    [
        ("gym_control", ACROBOT, [], 1),
        ("gym_control", ACROBOT, [TaskLook(-60.0, None), TaskLook(-70.0, None)], 1),
        ("dmc", "Continual/Walker-v0", [], 2),
        ("dmc", "Continual/Walker-v0", [TaskLook(-60.0, FRAME), TaskLook(-70.0, FRAME)], 4),
    ],
)
def test_learning_curves(tmp_path, monkeypatch, suite, env_id, looks, n_axes):
    import matplotlib.pyplot as plt

    for method in ("vanilla", "cchain"):
        write(tmp_path, method, [[0, 1], [0]], env_id, suite=suite)
    figures = []
    monkeypatch.setattr(plt, "close", figures.append)
    plot_learning_curves(whole_results(tmp_path), tmp_path / "new" / "a.png", suite_methods(suite), "title", looks)
    monkeypatch.undo()
    assert (tmp_path / "new" / "a.png").read_bytes().startswith(b"\x89PNG")
    (figure,) = figures
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert set(labels) == {"PPO", "C-CHAIN PPO", *(["random policy"] if looks else [])}
    assert len(figure.axes) == n_axes
    plt.close(figure)


def test_few_seeds_have_a_line_each_and_many_a_band(tmp_path, monkeypatch):
    import matplotlib.pyplot as plt

    for method, n_seeds in (("vanilla", 4), ("cchain", 3)):
        for seed in range(n_seeds):
            write(tmp_path, method, [[0, 1 + seed], [0, 1]], ACROBOT, seed=seed)
    figures = []
    monkeypatch.setattr(plt, "close", figures.append)
    lines = suite_methods("gym_control")
    plot_learning_curves(whole_results(tmp_path), tmp_path / "a.png", lines)
    monkeypatch.undo()
    (figure,) = figures
    drawn = figure.axes[0].get_lines()
    styles = {name: [line.get_linestyle() for line in drawn if line.get_color() == lines[name].color] for name in lines}
    assert styles["vanilla"] == ["-"] * 2  # tasks
    assert styles["cchain"] == ["-", "--", ":"] * 2
    assert [band.get_facecolor()[0, :3].tolist() for band in figure.axes[0].collections] == [[*to_rgb("tab:gray")]] * 2
    plt.close(figure)


def test_a_picture_of_quantities_with_variants(tmp_path, monkeypatch):
    import matplotlib.pyplot as plt

    from benchmarks.plasticity.runs import lines

    compared = {name: lines("gym_control")[name] for name in ("vanilla", "cchain", "projection", "orthogonal")}
    metrics = [(steps, quantity.name, steps) for steps in (50, 150) for quantity in PLASTICITY[1:]]
    for name, line in compared.items():
        write(tmp_path, line.name, [[0, 1], [0]], variant=name, metrics=metrics)
    figures = []
    monkeypatch.setattr(plt, "close", figures.append)
    plot_quantities(whole_results(tmp_path), tmp_path / "a.png", compared, PLASTICITY, "title", window=5)
    monkeypatch.undo()
    (figure,) = figures
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [line.label for line in compared.values()]
    assert [axes.get_title() for axes in figure.axes] == [quantity.label for quantity in PLASTICITY]
    assert [axes.get_yscale() == "log" for axes in figure.axes] == [quantity.logarithmic for quantity in PLASTICITY]
    plt.close(figure)


# Verdicts, signs, what is missing

LENGTH = (10, 160_000)


def write_long(folder, method, value, seed=0, **fields):
    """A run of the paper's length in Acrobot, with one rollout in each task."""
    names = [f"task {task}" for task in range(LENGTH[0])]
    return write(
        folder,
        method,
        [[value]] * LENGTH[0],
        seed=seed,
        n_tasks=LENGTH[0],
        steps_per_task=LENGTH[1],
        task_names=names,
        **fields,
    )


def with_cut(value):
    return [(LENGTH[1] * (task + 1), "continual/mean_return_with_cut", value) for task in range(LENGTH[0])]


@pytest.mark.parametrize(
    ("values", "length", "words"),
    [
        # The paper's C-CHAIN in Acrobot is -119.2 ± 6.9: -133.1 to -105.4
        ([-100, -104, -106], LENGTH, "✓ agrees"),
        ([-100, -104, -105], LENGTH, "✗ disagrees"),
        ([-140, -150, -134], LENGTH, "✗ disagrees"),
        ([-119, -119], LENGTH, "not enough runs: 2 seeds"),
        ([-119], LENGTH, "not enough runs: 1 seed"),
        ([-119, -119, -119], (4, 64_000), "not enough runs: other length"),
    ],
)
def test_verdict_by_hand(tmp_path, values, length, words):
    for seed, value in enumerate(values):
        write_long(tmp_path, "cchain", value, seed)
    paper = read_tables()["gym_control"]
    cells = cells_in(tmp_path)
    length = length if length == LENGTH else (LENGTH[0] + 1, LENGTH[1])
    assert verdict_words(cells[ACROBOT, "cchain"], paper.figures[ACROBOT, "cchain"], length) == words
    if length == LENGTH:
        (row,) = [row for row in table_rows(verdicts_table(cells, paper, {"cchain": "C-CHAIN"})) if row[0] == "Acrobot-v1"]
        assert row == ["Acrobot-v1", words]
        cell = table_rows(results_table("gym_control", cells, paper))[2][-1]
        assert [sign for sign in "✓✗" if sign in cell] == [sign for sign in "✓✗" if sign in words]


def test_the_verdict_goes_by_the_rule_of_the_released_code_where_it_was_logged(tmp_path, no_drawing):
    for seed, value in enumerate((-90, -95, -100)):
        write_long(tmp_path, "cchain", value, seed, metrics=with_cut(value - 20))
        write_long(tmp_path, "trac", value, seed, metrics=with_cut(value - 20) if seed else ())
    cells, paper = cells_in(tmp_path), read_tables()["gym_control"]
    assert cells[ACROBOT, "cchain"].released_scores == (-110.0, -115.0, -120.0)
    assert cells[ACROBOT, "trac"].released_scores is None
    assert verdict_words(cells[ACROBOT, "cchain"], paper.figures[ACROBOT, "cchain"], LENGTH) == "✓ agrees"
    write_report(whole_results(tmp_path), "smoke", tmp_path / "out")
    text = (tmp_path / "out" / "report.md").read_text().split("### By the rule of the released code")[1]
    assert "\n\nWithout it: Acrobot-v1, TRAC.\n\n" in text
    rows = [row for row in table_rows(text) if len(row) == 6]
    both = ["0 1 2", "-95.0 ± 2.9", "-115.0 ± 2.9", "-119.2 ± 6.9", "✓ agrees"]
    assert [row for row in rows if "Acrobot-v1, " in row[0]] == [["Acrobot-v1, C-CHAIN PPO", *both]]


@pytest.mark.parametrize(
    ("suite", "env_id", "metrics", "expected"),
    [
        # ProcGen: every tenth iteration of 1000 steps alone, so 2 and 5 in the first task, 7 in the second
        (
            *("procgen", "Continual/Starpilot-v0"),
            [(9000, 1.0), (10_000, 2.0), (11_000, 3.0), (20_000, 5.0), (30_000, 7.0), (39_000, 9.0)],
            [3.5, 7.0],
        ),
        # DeepMind Control: all evaluations, from before training to right after the task
        ("dmc", "Continual/Walker-v0", [(0, 10.0), (18_432, 20.0), (20_000, 60.0), (38_912, 5.0), (40_000, 7.0)], [30.0, 6.0]),
        ("gym_control", ACROBOT, [(800, -400.0), (20_000, -100.0), (20_800, -50.0)], [-250.0, -50.0]),
    ],
)
def test_scores_by_the_released_code_by_hand(tmp_path, no_drawing, suite, env_id, metrics, expected):
    name = SUITES[suite].score.metric
    logged = [(steps, name, value) for steps, value in metrics]
    write(tmp_path, "cchain", [[1], [2]], env_id, suite=suite, steps_per_task=20_000, metrics=logged)
    (result,) = whole_results(tmp_path)
    assert result.released_averages() == expected
    write_report([result], "smoke", tmp_path / "out")
    text = (tmp_path / "out" / "report.md").read_text().split("### By the rule of the released code")[1]
    assert SUITES[suite].score.words in text
    digits = 1 if suite != "procgen" else 2
    score = f"{np.mean(expected):.{digits}f}"
    row = next(row for row in table_rows(text) if row[0].startswith(f"{env_id.removeprefix('Continual/')}, "))
    assert row[1:4] == ["0", f"{1.5:.{digits}f}", score]


def test_without_a_point_there_is_no_score(tmp_path):
    """Of a task, or of a suite whose J(T) is of evaluations itself."""
    write(tmp_path, "cchain", [[1], [2]], "Continual/Walker-v0", suite="dmc", metrics=[(0, "evaluation/mean_return", 1.0)])
    write(tmp_path, "cchain", [[1], [2]], "Continual/MinAtar-v0", suite="minatar")
    for result in whole_results(tmp_path):
        assert result.released_averages()[1] != result.released_averages()[1]
        assert [cell.paper_scores for cell in make_cells([result])[0].values()] == [(1.5,)]


def test_difference_by_hand():
    # Variances 4 and 2, of 3 and 2 seeds: squared errors 4/3 and 1, mean variance 3
    value, interval, effect = difference(sample([1.0, 3.0, 5.0]), sample([0.0, 2.0]))
    assert value == 2.0 and effect == pytest.approx(2 / 3**0.5 * (1 - 3 / 11))
    welch = stats.ttest_ind([1.0, 3.0, 5.0], [0.0, 2.0], equal_var=False).confidence_interval(0.95)
    assert interval == pytest.approx((welch.low, welch.high))


@pytest.mark.parametrize(("one", "other"), [([1.0], [0.0, 2.0]), ([0.0, 2.0], [1.0]), ([1.0, 1.0], [0.0, 0.0])])
def test_difference_without_a_spread(one, other):
    assert difference(sample(one), sample(other)) == (np.mean(one) - np.mean(other), None, None)


@pytest.mark.parametrize(
    ("value", "interval", "words"),
    [
        (5.0, (1.0, 9.0), "the paper's; clear of 0"),
        (5.0, (-1.0, 11.0), "the paper's; the interval holds 0"),
        (-5.0, (-9.0, -1.0), "**not the paper's**; clear of 0"),
        (-5.0, None, "**not the paper's**; no interval"),
        (0.0, None, "none: no difference"),
    ],
)
def test_words_of_the_sign(value, interval, words):
    assert sign_words(Difference(value, interval, None), Difference(3.0, (1.0, 5.0), 1.0)) == words


def test_table_of_signs_by_hand(tmp_path):
    write(tmp_path, "vanilla", [[-400], [-300]])
    for seed in (0, 1):
        write(tmp_path, "cchain", [[-100], [-90 - seed]], seed=seed)
    (row,) = table_rows(signs_table(cells_in(tmp_path), read_tables()["gym_control"], "cchain", 1))[2:]
    assert row[:6] == ["Acrobot-v1", "J(T)", "2 − 1", "+254.8", "none: one seed", "–"]
    assert row[-1] == "the paper's; no interval"
    # -119.211 + 372.725; squared errors 48.01 and 10.68, of 6 seeds: 7.12 degrees of freedom, a t of 2.357
    assert row[6] == "+253.5"
    low, high = map(float, row[7].strip("[]").split(", "))
    assert (high - low) / 2 == pytest.approx(2.357 * 58.69**0.5, abs=0.1)
    assert float(row[8]) == pytest.approx(253.5 / (6 * 58.69 / 2) ** 0.5 * (1 - 3 / 39), abs=0.1)


def test_what_is_missing_by_hand(tmp_path):
    # 200 steps an hour, and the budget has 3 seeds of 4 x 64 000 steps: 1280 hours each
    write(tmp_path, "vanilla", [[-400], [-300]], experiment="reduced")
    paper = read_tables()["gym_control"]
    runs = whole_results(tmp_path)
    assert len(missing_runs("gym_control", runs, paper, "reduced")) == 4 * 6 * 3 - 1
    assert len(missing_runs("gym_control", runs, paper, "paper")) == 4 * 6 * 6 - 1
    text = "\n".join(missing_section("gym_control", runs, paper, "reduced"))
    header, _, row = table_rows(text[text.index("| core-hours") :])[:3]
    assert row[0] == f"`{ACROBOT}`" and dict(zip(header, row, strict=True))["`vanilla`"] == "2560.0 (2 seeds)"
    command = "python -m benchmarks.run --suite gym_control --budget"
    assert f"{command} reduced --env {ACROBOT} --method oracle " in text and f"{command} paper --seeds 0 1 2 " in text
    assert missing_section("gym_control", runs, paper, "a comparison") == not_run("gym_control", paper, "a comparison") == []
    # 12 seeds of both methods of 3 games, at the rates of the suite's row
    hours = 12 * 3 * 1_500_000 * (1 / 125 + 1 / 82) / 3600
    minatar = "\n".join(not_run("minatar", read_tables()["minatar"], "paper"))
    assert minatar.startswith("**Continual MinAtar**: no run of this budget.")
    assert f"24 runs, {hours:,.1f} core-hours" in minatar
    # 3 seeds of 2 β in 4 environments, at the 510 steps a second of C-CHAIN in the suite's row
    for lines, rate in (
        ("cchain@1e3 cchain@1e5", 510),
        # Nothing is known of its rate but Vanilla's in the suite's row
        ("weight_clipping@0.1 weight_clipping@0.5 weight_clipping@10", 500),
        ("l2_init@0.1 l2_init@1 l2_init@100 l2_init@1e3", 480),
    ):
        hours = 12 * len(lines.split()) * 256_000 / rate / 3600
        assert f"{command} reduced --method {lines}    # for the best of several: {hours:,.1f} core-hours" in text


def test_nothing_is_missing_of_what_is_whole(tmp_path):
    paper = read_tables()["minatar"]
    for method in paper.methods:
        for seed in range(3):
            write(tmp_path, method, [[1], [1]], "Continual/MinAtar-v0", seed, suite="minatar", experiment="reduced")
    text = "\n".join(missing_section("minatar", whole_results(tmp_path), paper, "reduced"))
    assert "0 runs, 0.0 core-hours" in text and "one cell" not in text


# Best of several strengths


def write_betas(folder, scores):
    """Runs of two seeds and more of C-CHAIN in Acrobot, by β; None is the shipped one."""
    for beta, values in scores.items():
        line = {} if beta is None else {"variant": f"cchain@{beta}", "overrides": (f"target_churn_ratio:{beta}",)}
        for seed, value in enumerate(values):
            write(folder, "cchain", [[value], [value]], seed=seed, **line)


def test_best_of_betas_by_hand(tmp_path):
    # On the seeds that all have, 1e3 is no longer the best
    write_betas(tmp_path, {None: [-100, -120], "1e3": [-200, -80, 0], "1e5": [-90, -90]})
    (best,) = best_strengths("gym_control", cells_in(tmp_path), [ACROBOT, CARTPOLE])
    assert (best.env_id, best.method, best.seeds) == (ACROBOT, "cchain", [0, 1])
    assert (list(best.cells), best.strength, best.shipped) == (["1e3", "1e4", "1e5"], "1e5", "1e4")
    row = table_rows(best_table([best], read_tables()["gym_control"]))[2]
    here = ["-90.0 (best of 3: β = 1e5)", "-110.0 (β = 1e4)", "-119.2 ± 6.9 (best of 3)"]
    assert row == [
        "Acrobot-v1, C-CHAIN PPO",
        "J(T)",
        "β = 1e3, 1e4, 1e5",
        "0 1",
        *here,
        "not enough runs: 2 seeds, other length",
    ]
    # Further seeds of the best alone do not count
    for seed in (2, 3):
        write(tmp_path, "cchain", [[0], [0]], seed=seed, variant="cchain@1e5", overrides=("target_churn_ratio:1e5",))
    (best,) = best_strengths("gym_control", cells_in(tmp_path), [ACROBOT])
    assert table_rows(best_table([best], read_tables()["gym_control"]))[2] == row
    write_best([best], tmp_path / "best_of.csv")
    header, line = (tmp_path / "best_of.csv").read_text().splitlines()
    assert header == ",".join(COLUMNS)
    assert line == f"gym_control,{ACROBOT},cchain,J(T),target_churn_ratio,1e3 1e4 1e5,0 1,1e5,-90.0,1e4,-110.0"
    write_best([], tmp_path / "best_of.csv")
    assert not (tmp_path / "best_of.csv").exists()


def test_best_of_fewer_betas_than_the_papers_has_no_verdict(tmp_path, no_drawing):
    write_betas(tmp_path, {"1e3": [-100, -120]})
    write_report(whole_results(tmp_path), "smoke", tmp_path / "out")
    text = (tmp_path / "out" / "report.md").read_text()
    assert "| -110.0 (best of 1: β = 1e3) | – | -119.2 ± 6.9 (best of 3) | not enough runs: β = 1e4, 1e5 missing |" in text
    assert "biased upwards" in text and (tmp_path / "out" / "best_of.csv").exists()


@pytest.mark.parametrize("scores", [{None: [1, 2]}, {"1e3": [1]}])
def test_best_of_needs_another_beta_and_seeds_in_common(tmp_path, scores):
    write_betas(tmp_path, scores)
    if "1e3" in scores:
        write(tmp_path, "cchain", [[1], [1]], seed=5)
    assert best_strengths("gym_control", cells_in(tmp_path), [ACROBOT]) == []


def test_best_of_kappa_and_c(tmp_path, no_drawing):
    """As of β, each beside the shipped one; what is missing for a verdict is named."""
    for line, value in (("weight_clipping", -110), ("weight_clipping@0.5", -100), ("l2_init@1", -300), ("l2_init", -200)):
        run = make_run("gym_control", ACROBOT, line, 0, 2, 100, "smoke")
        write(tmp_path, run.method, [[value], [value]], variant=run.variant, overrides=run.overrides)
    write_report(whole_results(tmp_path), "smoke", tmp_path / "out")
    text = (tmp_path / "out" / "report.md").read_text()
    rows = [row for row in table_rows(text.split("### Best of several strengths")[1]) if len(row) == 8]
    kappa, c = (row for row in rows if "(best of" in row[4])
    assert kappa[:3] == ["Acrobot-v1, Weight clipping", "J(T)", "κ = 0.5, 1"]
    assert c[:3] == ["Acrobot-v1, L2 Init", "J(T)", "c = 1, 10"]
    assert kappa[4:6] == ["-100.0 (best of 2: κ = 0.5)", "-110.0 (κ = 1)"]
    assert c[4:6] == ["-200.0 (best of 2: c = 10)", "-200.0 (c = 10)"]
    assert [row[7] for row in (kappa, c)] == [
        f"not enough runs: {lacks} missing" for lacks in ("κ = 0.1, 10", "c = 0.1, 100, 1e3")
    ]
    assert "| Weight clipping, κ = 0.5 |" in text and "optimizer_kwargs=dict(clip_ratio=0.5, base" in text
    lines = (tmp_path / "out" / "best_of.csv").read_text().splitlines()[1:]
    assert [line.split(",")[2:8] for line in lines] == [
        ["weight_clipping", "J(T)", "clip_ratio", "0.5 1", "0", "0.5"],
        ["l2_init", "J(T)", "coef", "1 10", "0", "10"],
    ]


def test_strengths_of_the_paper():
    assert paper_strengths("procgen", "l2_init") == ["0.1", "1", "10", "100", "1e3"]
    assert paper_strengths("dmc", "cchain") == paper_strengths("gym_control", "trac") == []


# The intervals of few seeds


@pytest.mark.parametrize(("n_seeds", "is_told"), [(1, False), (2, True), (4, True), (5, False)])
def test_intervals_of_few_seeds_are_called_too_narrow(tmp_path, no_drawing, n_seeds, is_told):
    for seed in range(n_seeds):
        for method in ("vanilla", "cchain"):
            write(tmp_path, method, [[seed], [seed]], seed=seed)
    write_report(whole_results(tmp_path), "smoke", tmp_path / "out")
    text = (tmp_path / "out" / "report.md").read_text()
    told = "fewer than five seeds, here those of PPO, C-CHAIN PPO, are too narrow"
    assert (told in text) is is_told and text.count("too narrow") == is_told


def test_the_picture_of_the_metrics_names_what_it_shows(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr("benchmarks.report.figures.plt.close", drawn.append)
    estimates = {"vanilla": np.array([0.5, 0.6]), "cchain": np.array([0.7, 0.8])}
    intervals = {method: np.array([each - 0.1, each + 0.1]) for method, each in estimates.items()}
    seeds = {"vanilla": [0, 1], "cchain": [0, 1, 2]}
    plot_reliable_metrics(estimates, intervals, ["mean", "IQM"], GYM_LINES, seeds, tmp_path / "metrics.png")
    (figure,) = drawn
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == ["C-CHAIN PPO, 3 seeds", "PPO, 2 seeds"]
    assert "95 % bootstrap interval" in figure.texts[0].get_text()
    for panel in figure.axes:
        left, right = panel.get_xlim()
        assert all(left < bar.get_x() and bar.get_x() + bar.get_width() < right for bar in panel.patches)


# Normalised by the Oracle


def test_the_papers_figure_by_the_oracle():
    """The paper prints C-CHAIN's mean and median as 1.463 and 1.452, Vanilla's mean as 0.811."""
    paper = read_tables()["procgen"]
    ratios = paper_over_oracle(paper, list(paper.lengths))
    assert (ratios["cchain"].mean(), np.median(ratios["cchain"])) == pytest.approx((1.463, 1.452), abs=5e-4)
    assert ratios["vanilla"].mean() == pytest.approx(0.811, abs=5e-4) and ratios["oracle"].tolist() == [1.0] * 16
    gym, minatar = read_tables()["gym_control"], read_tables()["minatar"]
    assert paper_over_oracle(gym, [CARTPOLE]) == paper_over_oracle(minatar, list(minatar.lengths)) == {}


@pytest.mark.parametrize(("oracle", "mean"), [(True, "0.50"), (False, None)])
def test_metrics_by_the_oracle(tmp_path, oracle, mean, no_drawing):
    """By its own runs or, without them, by the paper's."""
    env_id = "Continual/BossFight-v0"
    for seed in (0, 1):
        for method, value in (("vanilla", 1), ("cchain", 2), *([("oracle", 4)] if oracle else [])):
            write(tmp_path, method, [[value], [value]], env_id, seed, suite="procgen")
    write_report(whole_results(tmp_path), "smoke", tmp_path / "out")
    text = (tmp_path / "out" / "report.md").read_text().split("Normalised by the Oracle")[1]
    printed = read_tables()["procgen"].means(env_id)
    expected = mean if oracle else f"{2 / printed['oracle']:.2f}"
    assert f"| C-CHAIN PPO | 0 1 | {expected} [{expected}, {expected}] |" in text
    ratio = f"{printed['cchain'] / printed['oracle']:.2f}"
    assert f"| C-CHAIN PPO, paper | – | {ratio} | {ratio} | – | – |" in text
    assert ("the paper's Oracle (without runs in some of them here)" in text) is not oracle
    assert "pictures/metrics_by_oracle_procgen.png" in text


# The committed reports


def test_the_committed_results_make_the_committed_reports(tmp_path, monkeypatch):
    """
    One command makes them from scratch, with all pictures: that a picture is the same to the bit is not asked. The page, which
    holds it all once more, is not committed.
    """
    monkeypatch.setattr("benchmarks.report.estimates.N_RESAMPLES", 2000)
    committed = ROOT / "benchmarks" / "results"
    budgets = ["reduced", "paper"]
    options = ["--results", str(committed), "--budget", *budgets, "--output", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["report", *options])
    main()
    for budget in budgets:
        made, before = tmp_path / budget, committed / budget
        names = sorted(str(path.relative_to(made)) for path in made.rglob("*.*"))
        names.remove("report.html")
        for name in names:
            assert (before / name).is_file(), name
            if name.endswith((".md", ".csv")):
                assert (made / name).read_text() == (before / name).read_text()
        assert sorted(path.name for path in (before / "pictures").iterdir()) == [
            Path(name).name for name in names if name.startswith("pictures/")
        ]


def test_the_median_recovery_and_the_last_forgetting(tmp_path):
    metrics = [(step, "continual_eval/forgetting", value) for step, value in ((100, 9.0), (200, 1.0))]
    write(tmp_path, "vanilla", [[1.0] * 5, [1.0]], metrics=metrics)
    write(tmp_path, "vanilla", [[1.0] * 5, [1.0]], seed=1)
    write(tmp_path, "vanilla", [[1.0] * 5, [0.0] * 4 + [1.0]], seed=2)
    header, _, row = table_rows(continual_table(whole_results(tmp_path), GYM_LINES, 1, own_scales=False))
    cells = dict(zip(header, row, strict=True))
    assert (cells["recovered"], cells["steps to recover"], cells["forgetting"]) == ("3 of 3", "60", "1.0")


def test_the_best_is_by_the_rule_of_the_paper(tmp_path):
    for beta, value, cut in ((None, -100, -300), ("1e3", -200, -210)):
        fields = {} if beta is None else {"variant": f"cchain@{beta}", "overrides": (f"target_churn_ratio:{beta}",)}
        write_long(tmp_path, "cchain", value, metrics=with_cut(cut), **fields)
    (best,) = best_strengths("gym_control", cells_in(tmp_path), [ACROBOT])
    assert best.strength == "1e3" and best.mean("1e4") == -300
