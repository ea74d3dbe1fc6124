"""Methods side by side, by the returns of their runs over the same tasks: a table, and learning curves."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
from rich import box
from rich.markup import escape
from rich.table import Table

from sb3_cchain.analysis.curves import Series, draw_band, smoothed
from sb3_cchain.analysis.metrics.continual import average_performance
from sb3_cchain.analysis.metrics.intervals import difference_interval, mean_interval
from sb3_cchain.analysis.plots import import_matplotlib, new_figure
from sb3_cchain.callbacks import task_averages

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Of the methods in turn: those that lie on each other can all be seen
LINE_STYLES = ("-", (0, (6, 3)), (0, (3, 6)), (0, (1, 3)))

# The returns of a run: rows of `returns.csv`
Rows = Sequence[Mapping[str, float]]
# By its label, the runs of each method
Methods = Mapping[str, Sequence[Rows]]


def mixed_tasks(methods: Methods) -> list[int]:
    """
    :param methods: By label, the rows of ``returns.csv`` of each run
    :return: The tasks in which no episode ended in some of the runs, but in others. The return of the former is a reward per
        step, which is not to be compared with returns of episodes
    """
    # By task: whether an episode ended in it, of each run
    has_episodes: dict[int, list[bool]] = defaultdict(list)
    for runs in methods.values():
        for rows in runs:
            for task in dict.fromkeys(int(row["task_id"]) for row in rows):
                has_episodes[task].append(any(row["n_episodes"] > 0 for row in rows if row["task_id"] == task))
    return sorted(task for task, each in has_episodes.items() if any(each) and not all(each))


def common_tasks(methods: Methods) -> list[int]:
    """
    :param methods: By label, the rows of ``returns.csv`` of each run
    :return: The tasks that all runs have comparable returns on, in their order
    :raises ValueError: When there is none, or a method has no run
    """
    n_runs = {label: len(runs) for label, runs in methods.items()}
    if not n_runs or 0 in n_runs.values():
        raise ValueError(f"Each method must have at least one run; got, by label, {n_runs}")
    tasks = [list(dict.fromkeys(int(row["task_id"]) for row in rows)) for runs in methods.values() for rows in runs]
    mixed = mixed_tasks(methods)
    common = [task for task in tasks[0] if task not in mixed and all(task in others for others in tasks)]
    if not common:
        without = f"; in {', '.join(map(str, mixed))} not all runs have ended an episode" if mixed else ""
        raise ValueError(f"The runs must have a task in common; got the tasks {'; '.join(map(str, tasks))}{without}")
    return common


def comparison_table(methods: Methods) -> Table:
    r"""
    :param methods: By label, the rows of ``returns.csv`` of each run; differences are from the first
    :return: For each method the number of runs, the mean return on each of the :func:`common_tasks`, and
        :math:`J(\mathbb{T})`, their mean: its mean over the runs with its 95 % interval, by Student's t, and how much more it
        is than that of the first method, by Welch's t-test. There are no intervals for a single run, or where all runs are
        alike
    :raises ValueError: When the runs have no task in common, or a method has no run
    :raises ImportError: Without SciPy
    """
    tasks = common_tasks(methods)
    # By label: the return on each task, of each run, (n_runs, n_tasks)
    returns = {
        label: np.array([[task_averages(rows)[task] for task in tasks] for rows in runs]) for label, runs in methods.items()
    }
    scores = {label: [average_performance(averages) for averages in each] for label, each in returns.items()}
    first, *_ = methods
    table = Table(box=box.ASCII)
    table.add_column("task")
    for label in methods:
        table.add_column(escape(label), justify="right", overflow="fold")
    table.add_row("runs", *(str(len(runs)) for runs in methods.values()), end_section=True)
    for i, task in enumerate(tasks):
        table.add_row(str(task), *(f"{each[:, i].mean():.4g}" for each in returns.values()), end_section=task == tasks[-1])
    table.add_row("J(T)", *(f"{np.mean(each):.4g}" for each in scores.values()))
    table.add_row("95 % interval", *(_interval_text(mean_interval(each)) for each in scores.values()), end_section=True)
    if len(methods) > 1:
        others = [scores[label] for label in methods if label != first]
        table.add_row(escape(f"minus {first}"), "", *(f"{np.mean(each) - np.mean(scores[first]):.4g}" for each in others))
        intervals = [difference_interval(each, scores[first]) for each in others]
        table.add_row("95 % interval", "", *map(_interval_text, intervals))
    return table


def _interval_text(interval: tuple[float, float] | None) -> str:
    return "" if interval is None else "{:.4g} to {:.4g}".format(*interval)


def draw_comparison(methods: Methods, window: int) -> "Figure":
    """
    Draw returns against environment steps: of each method a line for the mean over its runs, and a band of ± 1 standard error,
    without a band for a single run; dashed vertical lines where the task switches. The :func:`mixed_tasks` are left out.

    :param methods: By label, the rows of ``returns.csv`` of each run
    :param window: Rows that the running mean goes over, inside a task
    :return: The picture
    :raises ImportError: Without matplotlib
    """
    mixed = mixed_tasks(methods)
    with new_figure(9, 4) as figure:
        axes = figure.add_subplot()
        curves = {label: [_curves(rows, window, mixed) for rows in runs] for label, runs in methods.items()}
        for number, (label, runs) in enumerate(curves.items()):
            color, style = f"C{number}", LINE_STYLES[number % len(LINE_STYLES)]
            name: str | None = f"{label}, {len(runs)} run{'s' if len(runs) > 1 else ''}"
            for curves_in_task in zip(*runs, strict=False):  # as many tasks as all runs have reached
                draw_band(axes, curves_in_task, color=color, linestyle=style, linewidth=1.8, label=name)
                name = None  # once in the legend
        longest = max((run for runs in curves.values() for run in runs), key=len)
        for steps, _ in longest[:-1]:
            axes.axvline(steps[-1], color="0.35", linestyle="--", linewidth=1)
        smoothing = f"\nrunning mean of {window} rows" if window > 1 else ""
        spread = " ± 1 standard error" if any(len(runs) > 1 for runs in methods.values()) else ""
        axes.set(xlabel="environment steps", ylabel=f"mean return{spread}{smoothing}")
        axes.xaxis.set_major_formatter(import_matplotlib().ticker.EngFormatter(sep=""))  # 20k, 1M
        axes.spines[["top", "right"]].set_visible(False)
        figure.legend(loc="outside lower center", ncols=min(len(methods), 4), handlelength=3, frameon=False)
    return figure


def _curves(rows: Rows, window: int, left_out: Sequence[int]) -> list[Series]:
    """The curve of each task, in the order of training; a task that comes back has several."""
    tasks = [
        list(rows_of_task) for task, rows_of_task in groupby(rows, key=lambda row: row["task_id"]) if task not in left_out
    ]
    return [
        (np.array([row["timesteps"] for row in each]), smoothed(np.array([row["mean_return"] for row in each]), window))
        for each in tasks
    ]
