"""The command ``benchmarks.sensitivity``: what it trains, and its tables and picture of made-up results."""

from functools import partial
from unittest.mock import Mock

import pytest

from benchmarks.grid.executor import LocalBackend
from benchmarks.grid.results import write_result
from benchmarks.sensitivity.__main__ import COSTS, main
from benchmarks.sensitivity.costs import Cost, measure, read_costs
from benchmarks.sensitivity.picture import plot
from benchmarks.sensitivity.runs import ENVS, PARAMETERS, all_runs, base_run, read_scores, sensitivity_run
from benchmarks.sensitivity.tables import cost_table, sensitivity_table
from tests.fake_training import fake_program
from tests.test_grid import make_result

ACROBOT, LANDER = ENVS
FOLDERS = ("--results", "--logs", "--docs")


def command(folder, *arguments):
    options = [text for name in FOLDERS for text in (name, str(folder / name.strip("-")))]
    return main([*arguments, "--budget", "smoke", *options])


def write(folder, run, averages):
    """A run with one rollout in each of its two tasks."""
    rows = [
        {"timesteps": end, "task_id": task, "n_episodes": 1, "mean_return": average}
        for task, (end, average) in enumerate(zip(run.task_boundaries, averages, strict=True))
    ]
    write_result(make_result(folder, run), rows, [])


@pytest.fixture
def results(tmp_path):
    """PPO and the shipped C-CHAIN with two seeds on Acrobot, a β and a size with one; nothing on LunarLander."""
    folder = tmp_path / "results"
    write(folder, base_run(ACROBOT, 0, "smoke"), [-100.0, -400.0])
    write(folder, base_run(ACROBOT, 1, "smoke"), [-200.0, -400.0])
    write(folder, sensitivity_run("beta", "1e4", ACROBOT, 0, "smoke"), [-100.0, -90.0])
    write(folder, sensitivity_run("beta", "1e4", ACROBOT, 1, "smoke"), [-110.0, -90.0])
    write(folder, sensitivity_run("beta", "1e6", ACROBOT, 1, "smoke"), [-390.0, -395.0])
    write(folder, sensitivity_run("reference", "0.25", ACROBOT, 0, "smoke"), [-120.0, -130.0])
    (folder / COSTS).write_text(
        "env_id,model,round,seconds_per_1000_steps\n"
        + "".join(f"{ACROBOT},ppo,{number},{seconds}\n" for number, seconds in enumerate([1.0, 2.0, 1.0]))
        + "".join(f"{ACROBOT},8,{number},{seconds}\n" for number, seconds in enumerate([1.5, 2.4, 1.1]))
    )
    return folder


def scores_of(name, results):
    return read_scores(name, [0, 1], "smoke", results)


# --- What is trained ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name, value, experiment, line, overrides",
    [
        ("beta", "1e4", "reduced", "cchain", ()),
        ("reference", "1", "reduced", "cchain", ()),
        # Of the paper's three β, and another
        ("beta", "1e3", "reduced", "cchain@1e3", ("target_churn_ratio:1e3",)),
        ("beta", "1e6", "sensitivity_4x64000", "cchain@1e6", ("target_churn_ratio:1e6",)),
        ("reference", "0.25", "sensitivity_4x64000", "cchain_churn_batch_size_0.25", ("churn_batch_size:0.25",)),
    ],
)
def test_which_runs_are_the_grids(name, value, experiment, line, overrides):
    run = sensitivity_run(name, value, ACROBOT, 3, "reduced")
    assert (run.experiment, run.line, run.overrides) == (experiment, line, overrides)
    assert (run.method, run.seed, run.n_tasks, run.steps_per_task) == ("cchain", 3, 4, 64_000)


def test_all_runs_and_some():
    runs = all_runs(PARAMETERS, None, ENVS, [0, 1], "reduced")
    # PPO, five β and six sizes, of which one is the same run
    assert len(runs) == len(set(runs)) == 2 * 2 * (1 + 5 + 6 - 1)
    assert [run.line for run in all_runs(PARAMETERS, ["1e2", "8"], [ACROBOT], [0], "reduced")] == [
        "cchain@100",
        "cchain_churn_batch_size_8",
    ]


def test_the_command_trains_what_is_missing(tmp_path, capsys, monkeypatch):
    program = partial(LocalBackend, program=fake_program(tmp_path / "fake", {}))
    monkeypatch.setattr("benchmarks.grid.executor.LocalBackend", program)
    arguments = ["--value", "8", "--env", ACROBOT, "--seeds", "0"]
    command(tmp_path, *arguments, "--dry-run")
    assert "1 runs, 0 of them done" in capsys.readouterr().out and not (tmp_path / "results").exists()
    command(tmp_path, *arguments)
    assert "| 8 | -15.0 | -15.0 | – | – |" in capsys.readouterr().out
    command(tmp_path, *arguments, "--dry-run")
    assert "1 runs, 1 of them done" in capsys.readouterr().out


def test_a_value_that_is_not_tried(tmp_path, capsys):
    with pytest.raises(SystemExit) as error:
        command(tmp_path, "--value", "3")
    assert error.value.code == 2 and "--value must be one of 1e2, 1e3, " in capsys.readouterr().err


def test_a_missing_package_is_said_in_a_line(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("benchmarks.sensitivity.__main__.all_runs", Mock(side_effect=ImportError("Box2D is missing")))
    with pytest.raises(SystemExit):
        command(tmp_path)
    assert "Box2D is missing" in capsys.readouterr().err


# --- Cost ---------------------------------------------------------------------------------------------------------------


def test_costs_by_hand(results):
    # Ratios within the rounds: 1.5, 1.2 and 1.1
    assert read_costs(results / COSTS) == {
        ACROBOT: {"ppo": Cost(1.0, (1.0, 1.0, 1.0)), "8": Cost(1.5, (pytest.approx(1.2), pytest.approx(1.1), 1.5))}
    }


def test_costs_are_measured_in_turn(tmp_path):
    small = dict(n_steps=32, batch_size=4, n_epochs=1, policy_kwargs={"net_arch": [4]})
    measure(tmp_path / COSTS, n_rounds=2, env_ids=(ACROBOT,), **small)
    costs = read_costs(tmp_path / COSTS)[ACROBOT]
    assert list(costs) == ["ppo", *PARAMETERS["reference"].values] and all(cost.seconds > 0 for cost in costs.values())
    models = [line.split(",")[1] for line in (tmp_path / COSTS).read_text().splitlines()[1:]]
    assert models == 2 * list(costs)


# --- Tables and picture -------------------------------------------------------------------------------------------------


def rows_of(table):
    return [line.strip("| ").split(" | ") for line in table.splitlines() if line.startswith("|")]


def test_a_table_of_beta_by_hand(results):
    table = sensitivity_table("beta", *scores_of("beta", results), [0, 1])
    assert rows_of(table) == [
        ["β", "Acrobot-v1, by seed", "mean", "LunarLander-v3, by seed", "mean"],
        ["---"] * 5,
        ["PPO", "-250.0 / -300.0", "-275.0", "– / –", "–"],
        ["1e2", "– / –", "–", "– / –", "–"],
        ["1e3", "– / –", "–", "– / –", "–"],
        ["1e4 (shipped)", "-95.0 / -100.0", "-97.5", "– / –", "–"],
        ["1e5", "– / –", "–", "– / –", "–"],
        ["1e6", "– / -392.5", "-392.5", "– / –", "–"],
    ]
    assert table.endswith("Seeds 0, 1; 5 of 24 runs are done. The others are missing (–).")


def test_a_table_of_sizes_by_hand(results):
    table = sensitivity_table("reference", *scores_of("reference", results), [0, 1])
    rows = {row[0]: row[1:3] for row in rows_of(table)}
    assert rows["PPO"] == ["-250.0 / -300.0", "-275.0"]
    assert rows["0.25"] == ["-125.0 / –", "-125.0"]
    assert rows["1 (shipped)"][0] == "-95.0 / -100.0"
    assert rows["8"] == ["– / –", "–"]


def test_a_table_of_costs_by_hand(results):
    env_ids = list(scores_of("reference", results)[0])
    rows = {row[0]: row[1:3] for row in rows_of(cost_table("reference", env_ids, read_costs(results / COSTS)))}
    assert rows["PPO"] == ["1.00", "1.00 (1.00 to 1.00)"]
    assert rows["0.25"] == ["–", "–"]
    assert rows["8"] == ["1.50", "1.20 (1.10 to 1.50)"]


def test_the_picture_shows_what_is_missing(results, tmp_path):
    scores = {name: scores_of(name, results) for name in PARAMETERS}
    figure = plot(scores, read_costs(results / COSTS), tmp_path / "picture.png", "title")
    assert (tmp_path / "picture.png").stat().st_size > 10_000
    assert len(figure.axes) == 4
    missing = [[text.get_text() for text in panel.texts].count("no run") for panel in figure.axes]
    assert missing == [3, 5, 4, 6]
    beta_acrobot, _, size_acrobot, _ = figure.axes
    # PPO's level
    assert [line.get_ydata()[0] for line in beta_acrobot.lines if line.get_linestyle() == "--"] == [-275.0]
    assert [label.get_text() for label in size_acrobot.get_xticklabels()][-1] == "8\n1.20×"


def test_the_page_comes_from_the_results_alone(results, tmp_path):
    (tmp_path / "docs").mkdir()
    page = tmp_path / "docs/sensitivity.md"
    page.write_text("".join(f"<!-- table: sensitivity_{name} -->\n<!-- end -->\n" for name in [*PARAMETERS, "cost"]))
    command(tmp_path, "--write")
    assert page.read_text().count("| PPO | -250.0 / -300.0 |") == 2
    assert (tmp_path / "docs/images/sensitivity.png").exists()
