"""Methods side by side: ``sb3-cchain compare``, and what its table and picture are made of."""

import re

import numpy as np
import pytest
from scipy import stats

from sb3_cchain.analysis.comparison import comparison_table, draw_comparison, mixed_tasks
from sb3_cchain.analysis.curves import band, smoothed
from sb3_cchain.analysis.metrics.intervals import difference_interval, mean_interval
from tests.zoo_command import FAST, NO_EVALUATION, SHORT_PPO, command


def test_band_by_hand():
    curves = [(np.array([0.0, 2.0]), np.array([0.0, 2.0])), (np.array([1.0, 3.0]), np.array([3.0, 3.0]))]
    grid, mean, low, high = band(curves)
    assert (grid[0], grid[-1]) == (1.0, 2.0)
    # Values 1 and 3, then 2 and 3: standard errors 1 and 0.5
    assert (mean[0], low[0], high[0]) == pytest.approx((2.0, 1.0, 3.0))
    assert (mean[-1], low[-1], high[-1]) == pytest.approx((2.5, 2.0, 3.0))
    _, mean, low, high = band([(np.array([0.0, 2.0]), np.array([value, value])) for value in (1.0, 100.0)], logarithmic=True)
    assert (mean[0], low[0], high[0]) == pytest.approx((10.0, 1.0, 100.0))
    _, mean, low, high = band(curves[:1])
    assert (low == mean).all() and (high == mean).all()


def test_seeds_without_a_common_step_have_no_band():
    grid, mean, low, high = band([(np.array([0.0, 1.0]), np.array([0.0, 1.0])), (np.array([2.0, 3.0]), np.array([2.0, 3.0]))])
    assert len(grid) == len(mean) == len(low) == len(high) == 0
    draw_comparison({"PPO": [run_with([1.0, 2.0]), [dict(row, timesteps=10**6) for row in run_with([1.0])]]}, window=1)


def test_smoothed_by_hand():
    assert smoothed(np.array([1.0, 3.0, 8.0, 1.0]), window=2).tolist() == [1.0, 2.0, 5.5, 4.5]
    assert smoothed(np.array([1.0, 3.0]), window=5).tolist() == [1.0, 2.0]
    assert smoothed(np.array([]), window=2).tolist() == []


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_value_that_is_not_finite_is_in_the_means_that_have_it_alone(value):
    means = smoothed(np.array([1e20, 1.0, value, 3.0, 5.0, 6.0]), window=2)
    np.testing.assert_array_equal(means, [1e20, 5e19, value, value, 4.0, 5.5])


def test_band_of_what_has_no_logarithm():
    _, mean, _, high = band([(np.array([0.0, 1.0]), np.array([0.0, -1e-15]))] * 2, logarithmic=True)
    assert (0 <= mean).all() and (high < 1e-300).all()


def test_interval_of_a_mean_by_hand():
    # Standard error 1; Student's t with 2 degrees of freedom is 4.303
    assert mean_interval([2.0, 2.0 + 3**0.5, 2.0 - 3**0.5]) == pytest.approx((2 - 4.303, 2 + 4.303), abs=1e-3)
    assert mean_interval([2.0]) is None
    assert mean_interval([2.0, 2.0, 2.0]) is None


def test_interval_of_a_difference_by_hand():
    # Variances 2 and 8 of two each: standard error √5, and 5² / (1 + 16) degrees of freedom
    half = stats.t.ppf(0.975, 25 / 17) * 5**0.5
    assert difference_interval([1.0, 3.0], [10.0, 14.0]) == pytest.approx((-10 - half, -10 + half))
    assert difference_interval([1.0], [10.0, 14.0]) is None
    assert difference_interval([1.0, 1.0], [2.0, 2.0]) is None
    assert difference_interval([1.0, 1.0], [2.0, 4.0]) is not None


def run_with(*tasks, steps=100):
    """Rows of a run, which has the given returns on each task."""
    numbers = [(task, value) for task, values in enumerate(tasks) for value in values]
    return [
        {"timesteps": steps * i, "task_id": task, "n_episodes": 1, "mean_return": value}
        for i, (task, value) in enumerate(numbers, start=1)
    ]


def cells(table):
    return [[str(cell) for cell in row] for row in zip(*(column.cells for column in table.columns), strict=True)]


def test_table_by_hand():
    methods = {
        "PPO": [run_with([1.0, 3.0], [4.0]), run_with([3.0, 3.0], [6.0])],
        # A third task counts only where all have it
        "C-CHAIN": [run_with([11.0], [15.0], [1e6]), run_with([13.0], [21.0])],
        "single": [run_with([0.0], [1.0])],
    }
    table = comparison_table(methods)
    assert [column.header for column in table.columns] == ["task", *methods]
    half = stats.t.ppf(0.975, 1) / 2**0.5  # scores that lie √2 standard deviations apart: 3 and 4.5; 13 and 17
    intervals = [
        f"{mean - half * apart / 2**0.5:.4g} to {mean + half * apart / 2**0.5:.4g}" for mean, apart in ((3.75, 1.5), (15, 4))
    ]
    low, high = difference_interval([13.0, 17.0], [3.0, 4.5])
    assert cells(table) == [
        ["runs", "2", "2", "1"],
        ["0", "2.5", "12", "0"],
        ["1", "5", "18", "1"],
        ["J(T)", "3.75", "15", "0.5"],
        ["95 % interval", *intervals, ""],
        ["minus PPO", "", "11.25", "-3.25"],
        ["95 % interval", "", f"{low:.4g} to {high:.4g}", ""],
    ]


@pytest.mark.parametrize("methods", [{}, {"PPO": []}, {"PPO": [], "other": [run_with([1.0])]}], ids=["none", "one", "two"])
def test_a_method_without_a_run_is_refused(methods):
    with pytest.raises(ValueError, match="Each method must have at least one run; got, by label"):
        comparison_table(methods)


def test_table_of_one_method_has_no_difference():
    assert [row[0] for row in cells(comparison_table({"PPO": [run_with([1.0])]}))] == ["runs", "0", "J(T)", "95 % interval"]


def test_runs_without_a_task_in_common():
    other = [{**row, "task_id": 5} for row in run_with([1.0])]
    with pytest.raises(ValueError, match=r"a task in common; got the tasks \[0\]; \[5\]"):
        comparison_table({"PPO": [run_with([1.0])], "other": [other]})


def test_the_curves_do_not_cross_a_switch():
    """A task that comes back has two curves. Of a run that has not come as far, nothing is drawn there."""
    back = run_with([0.0, 2.0], [10.0], [4.0, 8.0])
    for row in back[3:]:
        row["task_id"] = 0
    (axes,) = draw_comparison({"PPO": [back], "other": [run_with([1.0], [1.0], [1.0]), run_with([3.0])]}, window=2).axes
    switches = [line for line in axes.get_lines() if line.get_color() == "0.35"]
    curves = [line for line in axes.get_lines() if line not in switches]
    drawn = [(line.get_xdata()[[0, -1]].tolist(), line.get_ydata()[[0, -1]].tolist()) for line in curves]
    assert drawn == [
        ([100, 200], [0, 1]),
        ([300, 300], [10, 10]),
        ([400, 500], [4, 6]),
        ([100, 100], [2, 2]),
    ]
    assert [line.get_label() for line in curves if line.get_label()[0] != "_"] == ["PPO, 1 run", "other, 2 runs"]
    assert [line.get_xdata()[0] for line in switches] == [200, 300]


def test_methods_that_lie_on_each_other_can_be_seen():
    (axes,) = draw_comparison({label: [run_with([1.0] * 4)] for label in "abcd"}, window=1).axes
    # matplotlib has no public way to ask for the gaps of a line
    assert len({str(line._unscaled_dash_pattern) for line in axes.get_lines()}) == 4


@pytest.mark.parametrize("n_runs, label", [(1, "mean return"), (2, "mean return ± 1 standard error")])
def test_the_picture_names_its_band(n_runs, label):
    (axes,) = draw_comparison({"PPO": [run_with([1.0, 2.0])] * n_runs}, window=1).axes
    assert axes.get_ylabel() == label


def test_a_single_point_has_an_error_bar():
    """As where each task has one row."""
    runs = [[dict(timesteps=512, task_id=0, n_episodes=1, mean_return=value)] for value in (1.0, 3.0)]
    (axes,) = draw_comparison({"PPO": runs}, window=1).axes
    ((bar,),) = (collection.get_segments() for collection in axes.collections)
    assert bar.tolist() == [[512.0, 1.0], [512.0, 3.0]]  # 2 ± 1


# The command


def write(path, rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [",".join(map(str, row.values())) for row in rows]
    path.write_text("\n".join(["timesteps,task_id,n_episodes,mean_return", *lines, ""]))
    return path


def test_from_training_to_the_table(tmp_path, monkeypatch, capsys):
    """Two runs, and the file of an attempt at one of them that was killed."""
    monkeypatch.chdir(tmp_path)
    world = ("--env", "Continual/CartPole-v1", "--env-kwargs", "steps_per_task:256", "n_tasks:2")
    for seed in (0, 1):
        arguments = ("-n", 512, "-tb", "runs", "-f", "logs", "--seed", seed)
        command("train", "--algo", "ppo", *world, *arguments, *SHORT_PPO, *FAST, *NO_EVALUATION)
    whole, _ = sorted((tmp_path / "runs").rglob("returns.csv"))
    killed = tmp_path / "runs" / "killed" / "returns.csv"
    killed.parent.mkdir()
    killed.write_text("".join(whole.read_text().splitlines(keepends=True)[:-3]))
    mine = write(tmp_path / "elsewhere" / "mine.csv", run_with([500.0] * 4, [500.0] * 4, steps=64))
    capsys.readouterr()
    command("compare", "-r", "PPO", "runs", "-r", "mine", mine, "-o", "new/curves.png")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"Left out: {killed}, the beginning of {whole}"
    assert any(re.match(r"\| runs +\| +2 \| +1 \|", line) for line in lines)
    assert any(re.match(r"\| J\(T\) +\| +[\d.]+ \| +500 \|", line) for line in lines)
    assert not any(line.startswith("Shorter") for line in lines)
    assert (tmp_path / "new" / "curves.png").read_bytes()[:4] == b"\x89PNG"


def test_a_shorter_run_is_named(tmp_path, capsys):
    write(tmp_path / "a" / "returns.csv", run_with([1.0] * 10, [2.0] * 10))
    short = write(tmp_path / "b" / "returns.csv", run_with([3.0] * 7))
    command("compare", "--runs", "all", tmp_path)
    output = capsys.readouterr().out
    assert f"Shorter: {short.resolve()} ends at step 700 of 2,000. The tasks that all runs have" in output
    assert re.search(r"\| 0 +\| +2 \|", output) and not re.search(r"\n\| 1 ", output)


@pytest.mark.parametrize(
    "tasks, steps, begin",
    [
        (([1.0] * 12, [2.0] * 8), 100, "0, 1,300"),
        (([1.0] * 20,), 100, "0"),
        (([1.0] * 10, [2.0] * 5, [3.0] * 5), 100, "0, 1,100, 1,600"),
        # A longer rollout, in which the same switch is
        (([1.0] * 2, [2.0] * 2), 512, None),
        (([1.0] * 3, [2.0] * 1), 512, "0, 2,048"),
        # Shorter
        (([1.0] * 10, [2.0] * 5), 100, None),
        (([1.0] * 9,), 100, None),
    ],
)
def test_tasks_that_begin_elsewhere_are_named(tasks, steps, begin, tmp_path, capsys):
    first = write(tmp_path / "a.csv", run_with([1.0] * 10, [2.0] * 10)).resolve()
    other = write(tmp_path / "b.csv", run_with(*tasks, steps=steps)).resolve()
    command("compare", "-r", "a", first, "-r", "b", other)
    line = f"Other tasks: those of {other} begin at step {begin}, those of {first} at 0, 1,100. Tasks of the same"
    output = capsys.readouterr().out
    assert (line in output) if begin else ("Other tasks" not in output)


def endless(*tasks):
    """Rows of a run in which no episode ended."""
    return [{**row, "n_episodes": 0} for row in run_with(*tasks)]


def test_rewards_per_step_are_not_compared_with_returns(tmp_path, capsys):
    collapsed = run_with([-50.0], [-50.0])[:1] + endless([-50.0], [-1.0])[1:]
    a, b = write(tmp_path / "a.csv", run_with([-40.0], [-30.0])), write(tmp_path / "b.csv", collapsed)
    command("compare", "-r", "a", a, "-r", "b", b)
    output = capsys.readouterr().out
    assert "Left out: task 1, because not all runs have ended an episode in it" in output
    assert re.search(r"\| J\(T\) +\| +-40 \| +-50 \|", output) and not re.search(r"\n\| 1 ", output)
    lines = draw_comparison({"a": [run_with([-40.0], [-30.0])], "b": [collapsed]}, window=1).axes[0].get_lines()
    assert [value for line in lines for value in line.get_ydata() if len(line.get_ydata()) == 1] == [-40, -50]


def test_a_task_that_comes_back_is_cut_in_its_last_visit():
    rows = [*run_with([-50.0], [-40.0]), {"timesteps": 300, "task_id": 0, "n_episodes": 0, "mean_return": -1.0}]
    assert mixed_tasks({"a": [rows], "b": [run_with([-50.0], [-40.0])]}) == []


def test_rewards_per_step_are_compared_with_each_other():
    table = comparison_table({"a": [endless([-1.0])], "b": [endless([-0.5])]})
    assert ["J(T)", "-1", "-0.5"] in cells(table)
    with pytest.raises(ValueError, match=r"the tasks \[0\]; \[0\]; in 0 not all runs have ended an episode"):
        comparison_table({"a": [endless([-1.0])], "b": [run_with([-0.5])]})


def test_seeds_that_are_alike_all_count(tmp_path, capsys):
    """Such as those that have collapsed to the worst return. Labels are taken as they are."""
    for seed, last in enumerate((-400.0, -400.0, -100.0)):
        write(tmp_path / f"seed_{seed}" / "returns.csv", run_with([-400.0] * 3, [last] * 3))
    command("compare", "--runs", "[b]PPO[/]", tmp_path)
    output = capsys.readouterr().out
    assert "Left out" not in output and "[b]PPO[/]" in output
    assert re.search(r"\| runs +\| +3 \|", output) and re.search(r"\| J\(T\) +\| +-350 \|", output)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["-r", "PPO"], "--runs must have a label and at least one path; got PPO"),
        (["-r", "PPO", "one.csv", "-r", "PPO", "one.csv"], "--runs must have another label for each method; got PPO 2 times"),
        (["-r", "PPO", "one.csv", "-w", "0"], "--window must be at least 1; got 0"),
        (["-r", "PPO", "one.csv", "-o", "one.csv/curves.png"], "--output one.csv/curves.png: "),
        (["-r", "PPO", "one.csv", "-o", "folder.png"], "--output folder.png: it is a folder. Give the path of a file"),
        (["-r", "PPO", "one.csv", "-o", "curves.doc"], "--output must end in one of "),
        (["-r", "PPO", "one.csv", "-o", "curves"], "; got curves"),
        (["-r", "PPO", "empty"], "empty must be a file of returns or have returns.csv in it, which training with -tb writes"),
        (["-r", "PPO", "nothing.csv"], "No such file or directory: 'nothing.csv'"),
        (["-r", "PPO", "none.csv"], "No episode has ended yet in the runs none.csv"),
        (["-r", "PPO", "other.csv"], "other.csv is not a file of returns"),
        (["-r", "PPO", "damaged.csv"], "damaged.csv is damaged: line 3"),
        (["-r", "PPO", "one.csv", "-r", "other", "task_5.csv"], "The runs must have a task in common; got the tasks [0]; [5]"),
    ],
)
def test_wrong_arguments(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "one.csv", run_with([1.0, 2.0]))
    write(tmp_path / "none.csv", [])
    write(tmp_path / "task_5.csv", [{**row, "task_id": 5} for row in run_with([1.0])])
    (tmp_path / "empty").mkdir()
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "other.csv").write_text("step,value\n1,2\n")
    (tmp_path / "damaged.csv").write_text((tmp_path / "one.csv").read_text()[:-3])
    with pytest.raises(SystemExit) as ended:
        command("compare", *arguments)
    assert ended.value.code == 2
    assert message in capsys.readouterr().err
