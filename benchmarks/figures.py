"""The report's pictures: a mean over seeds and a band of its standard error, in the colours of the methods."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from rliable.plot_utils import plot_interval_estimates

from benchmarks.curves import COLORS, LABELS, smoothed
from benchmarks.estimates import METRICS
from benchmarks.quantities import NTK
from benchmarks.results import METHODS, Result, Series

N_POINTS = 100


def band(curves: Sequence[Series], logarithmic: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """
    :param curves: Environment steps and values of each seed
    :param logarithmic: Whether mean and standard error are those of the logarithms, which no single seed dominates
    :return: Where all seeds have values, by interpolation: environment steps, mean, mean - standard error, mean + standard
        error (the mean itself of a single seed)
    """
    start, end = max(steps[0] for steps, _ in curves), min(steps[-1] for steps, _ in curves)
    grid = np.linspace(start, end, N_POINTS if start < end else 1)
    to, back = (np.log, np.exp) if logarithmic else (np.asarray, np.asarray)
    seeds = np.array([np.interp(grid, steps, to(values)) for steps, values in curves])
    mean = seeds.mean(axis=0)
    error = seeds.std(axis=0, ddof=1) / np.sqrt(len(curves)) if len(curves) > 1 else np.zeros_like(mean)
    return grid, back(mean), back(mean - error), back(mean + error)


def plot_learning_curves(results: Sequence[Result], path: Path, window: int, own_scales: bool) -> None:
    """
    :param results: All runs in one environment
    :param path: PNG file
    :param window: Rollouts that the running mean goes over, inside a task
    :param own_scales: Whether each task has a panel of its own, where tasks differ in the size of their returns
    """
    plt.style.use("default")  # RL Zoo's plots leave seaborn's behind
    n_tasks = results[0].n_tasks
    figure, axes = plt.subplots(1, n_tasks if own_scales else 1, figsize=(9, 4), squeeze=False, layout="constrained")
    panels = list(axes[0]) if own_scales else [axes[0, 0]] * n_tasks
    _draw(panels, results, Result.returns_of_task, window=window)
    panels[0].set_ylabel("return per episode")
    for panel, name in zip(panels, results[0].task_names, strict=True) if own_scales else ():
        panel.set_title(name, fontsize="medium")
    _save(figure, panels, path)


def plot_ntk(results: Sequence[Result], path: Path) -> None:
    """
    :param results: Runs in one environment whose NTK was logged
    :param path: PNG file
    """
    plt.style.use("default")
    figure, axes = plt.subplots(1, len(NTK), figsize=(12, 3.4), layout="constrained")
    for panel, quantity in zip(axes, NTK, strict=True):

        def series(result: Result, task: int, name: str = quantity.name) -> Series:
            return result.metric_of_task(name, task)

        _draw([panel] * results[0].n_tasks, results, series, logarithmic=quantity.logarithmic)
        panel.set_title(quantity.label, fontsize="medium")
        if quantity.logarithmic:
            panel.set_yscale("log")
    _save(figure, list(axes), path)


def plot_reliable_metrics(
    estimates: Mapping[str, np.ndarray], intervals: Mapping[str, np.ndarray], algos: Mapping[str, str], path: Path
) -> None:
    """
    :param estimates: Of each method, ``METRICS``
    :param intervals: Of each method, the ends of their intervals
    :param algos: Name on the command line of each method
    :param path: PNG file
    """
    plt.style.use("default")
    height = max(1.6, 0.45 * len(estimates))  # inches
    upwards = list(estimates)[::-1]
    figure, _ = plot_interval_estimates(
        {LABELS[algos[method]]: estimates[method] for method in upwards},
        {LABELS[algos[method]]: intervals[method] for method in upwards},
        list(METRICS),
        colors={LABELS[algo]: COLORS[algo] for algo in algos.values()},
        row_height=height / len(estimates),
        xlabel_y_coordinate=-0.5 / height,
        xlabel="normalised score",
        max_ticks=3,
    )
    figure.savefig(path, dpi=90, bbox_inches="tight")
    plt.close(figure)


def _draw(
    panels: Sequence[Any],
    results: Sequence[Result],
    series: Callable[[Result, int], Series],
    window: int = 1,
    logarithmic: bool = False,
) -> None:
    """Each task in its panel, a line and a band per method that has values there, and the switches."""
    boundaries = results[0].task_boundaries
    by_method = {method: [result for result in results if result.method == method] for method in METHODS}
    algos = {result.method: result.algo for result in results}
    for task, panel in enumerate(panels):
        for method, of_method in by_method.items():
            curves = [series(result, task) for result in of_method]
            curves = [(steps, smoothed(values, window)) for steps, values in curves if len(steps)]
            if not curves:
                continue
            grid, mean, low, high = band(curves, logarithmic)
            color, marker = COLORS[algos[method]], "o" if len(grid) == 1 else None
            panel.plot(grid, mean, color=color, linewidth=1.8, marker=marker, label=LABELS[algos[method]])
            panel.fill_between(grid, low, high, color=color, alpha=0.2, linewidth=0)
        if task > 0 and panel is panels[task - 1]:
            panel.axvline(boundaries[task - 1], color="0.35", linestyle="--", linewidth=1)
        panel.set_xlim(boundaries[task - 1] if task and panel is not panels[0] else 0, boundaries[task])
        panel.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}k" if value else "0")
        panel.spines[["top", "right"]].set_visible(False)


def _save(figure: Any, panels: Sequence[Any], path: Path) -> None:
    """With one legend of all panels."""
    panels[len(panels) // 2].set_xlabel("environment steps")
    legend = {}
    for panel in panels:
        legend.update({label: handle for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)})
    figure.legend(legend.values(), legend.keys(), loc="outside lower center", ncols=min(len(legend), 5), frameon=False)
    figure.savefig(path, dpi=100)
    plt.close(figure)
