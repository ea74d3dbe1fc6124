"""All pictures: for each method or variant the mean over its seeds, with its standard error or, of few seeds, all of them."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.grid.results import Result
from benchmarks.grid.suites import SUITES
from benchmarks.report.quantities import RETURNS, Quantity
from benchmarks.report.random_policy import TaskLook
from sb3_cchain.analysis.curves import Series, draw_band, smoothed
from sb3_cchain.methods.registry import Method

SWITCH_STYLE: dict[str, Any] = dict(color="0.35", linestyle="--", linewidth=1)

# The lines of more methods than these hide each other in one panel
MOST_IN_A_PANEL = 3

# Of no more seeds than these each has a line: the mean of one that learns and one that collapses is neither
SEED_STYLES = ("-", "--", ":")


def plot_learning_curves(
    results: Sequence[Result],
    path: Path,
    lines: Mapping[str, Method],
    title: str | None = None,
    looks: Sequence[TaskLook] = (),
) -> None:
    """
    Returns against environment steps. In a suite whose tasks differ in the size of their returns each task has a panel of its
    own; elsewhere each method has one, where there are many and neither frames nor a random policy.

    :param results: All runs in one environment, of one length
    :param path: PNG file
    :param lines: Label and colour of each method or variant, in their order
    :param title: Title
    :param looks: What each task looks like without an agent: its frame is drawn above the curves, the return of the random
        policy as a dotted line
    """
    suite, n_tasks, ends = SUITES[results[0].suite], results[0].n_tasks, results[0].task_boundaries
    shown = {name: line for name, line in lines.items() if any(result.line == name for result in results)}
    if len(shown) > MOST_IN_A_PANEL and not suite.own_scales and not looks:
        _plot_below_each_other(results, path, shown, title)
        return
    frames = [look.frame for look in looks if look.frame is not None]
    frames_height = min(8 / n_tasks * max((frame.shape[0] / frame.shape[1] for frame in frames), default=0), 2.4)
    figure = _new_figure(9, 4 + frames_height)
    grid = figure.add_gridspec(2 if frames else 1, n_tasks, height_ratios=[frames_height, 3.8] if frames else [1])
    for task, frame in enumerate(frames):
        picture = figure.add_subplot(grid[0, task])
        picture.imshow(frame)
        picture.axis("off")
    if suite.own_scales:
        panels = [figure.add_subplot(grid[-1, task]) for task in range(n_tasks)]
    else:
        panels = [figure.add_subplot(grid[-1, :])] * n_tasks
    _draw(panels, results, lines, RETURNS, suite.smoothing)
    for task, look in enumerate(looks):
        start = ends[task - 1] if task else 0
        panels[task].hlines(look.random_return, start, ends[task], color="0.35", linestyle=":", label="random policy")
    for task, name in enumerate(results[0].task_names) if suite.own_scales or looks else ():
        middle = ends[task] - results[0].steps_per_task / 2
        above: dict[str, Any] = dict(ha="center", va="bottom", transform=panels[task].get_xaxis_transform())
        panels[task].text(middle, 1.01, name, parse_math=False, **above)
    panels[0].set_ylabel(RETURNS.label)
    panels[n_tasks // 2].set_xlabel("environment steps")
    if title:
        figure.suptitle(title, parse_math=False)
    _add_legend(figure, panels)
    _save(figure, path)


def plot_quantities(
    results: Sequence[Result],
    path: Path,
    lines: Mapping[str, Method],
    quantities: Sequence[Quantity],
    title: str | None = None,
    window: int = 1,
) -> None:
    """
    Several quantities against environment steps, a panel each.

    :param results: Runs in one environment, of one length
    :param path: PNG file
    :param lines: Label and colour of each method or variant, in their order
    :param quantities: What is drawn
    :param title: Title
    :param window: Logged values that the running mean goes over, inside a task
    """
    n_rows = math.ceil(len(quantities) / 3)
    figure = _new_figure(12, 3.4 * n_rows)
    panels = list(figure.subplots(n_rows, 3, squeeze=False).flat)
    for panel in panels[len(quantities) :]:
        panel.axis("off")
    panels = panels[: len(quantities)]
    for panel, quantity in zip(panels, quantities, strict=True):
        _draw([panel] * results[0].n_tasks, results, lines, quantity, window)
        panel.set_title(quantity.label, fontsize="medium")
        greatest = max((np.max(line.get_ydata()) for line in panel.get_lines() if line.get_label()[0] != "_"), default=0)
        if quantity.logarithmic and greatest > 0:
            panel.set_yscale("log")
            # What a policy that repeats one action is left with would take most of the scale
            panel.set_ylim(bottom=max(1e-4 * greatest, panel.get_ylim()[0]))
    if title:
        figure.suptitle(title)
    panels[max(len(panels) - 2, 0)].set_xlabel("environment steps")  # in the middle of the last row
    _add_legend(figure, panels)
    _save(figure, path)


def plot_reliable_metrics(
    estimates: Mapping[str, np.ndarray],
    intervals: Mapping[str, np.ndarray],
    metric_names: Sequence[str],
    lines: Mapping[str, Method],
    seeds: Mapping[str, Sequence[int]],
    path: Path,
) -> None:
    """
    Metrics over environments, a panel each: a line for the estimate, a bar for its interval.

    :param estimates: Of each method, the metrics
    :param intervals: Of each method, the ends of their intervals
    :param metric_names: Names of the metrics
    :param lines: Label and colour of each method
    :param seeds: Seeds of each method
    :param path: PNG file
    """
    from rliable.plot_utils import plot_interval_estimates  # only the report needs it

    plt.style.use("default")
    height = max(1.6, 0.45 * len(estimates))  # inches
    labels = {method: f"{lines[method].label}, {len(seeds[method])} seeds" for method in list(estimates)[::-1]}  # upwards
    figure, panels = plot_interval_estimates(
        {label: estimates[method] for method, label in labels.items()},
        {label: intervals[method] for method, label in labels.items()},
        list(metric_names),
        colors={label: lines[method].color for method, label in labels.items()},
        row_height=height / len(estimates),
        xlabel_y_coordinate=-0.5 / height,
        xlabel="normalised score: line, estimate; bar, 95 % bootstrap interval over seeds",
        max_ticks=3,
        wspace=0.2,
    )
    for panel in panels:  # bars end before the edge
        panel.use_sticky_edges = False
        panel.margins(x=0.08)
    figure.savefig(path, dpi=90, bbox_inches="tight")
    plt.close(figure)


def _new_figure(width: float, height: float) -> Any:
    plt.style.use("default")  # RL Zoo's plots leave seaborn's behind
    return plt.figure(figsize=(width, height), layout="constrained")


def _plot_below_each_other(results: Sequence[Result], path: Path, lines: Mapping[str, Method], title: str | None) -> None:
    """A panel for each method, which names it."""
    figure = _new_figure(9, 1.3 * len(lines) + 0.5)
    panels = figure.subplots(len(lines), 1, sharex=True, sharey=True)
    for panel, (name, line) in zip(panels, lines.items(), strict=True):
        _draw([panel] * results[0].n_tasks, results, {name: line}, RETURNS, SUITES[results[0].suite].smoothing)
        panel.set_title(line.label, loc="left", fontsize="medium", fontweight="bold", color=line.color)
    panels[-1].set_xlabel("environment steps")
    figure.supylabel(RETURNS.label, fontsize="medium")
    if title:
        figure.suptitle(title, parse_math=False)
    _save(figure, path)


def _draw(
    panels: Sequence[Any], results: Sequence[Result], lines: Mapping[str, Method], quantity: Quantity, window: int
) -> None:
    """Each task in its panel: for each method that has values there its seeds, or their mean with a band, and the switches."""
    boundaries = results[0].task_boundaries
    for task, panel in enumerate(panels):
        for name, line in lines.items():
            runs = sorted((result for result in results if result.line == name), key=lambda result: result.seed)
            curves = [quantity.series(run, task) for run in runs]
            if any(len(steps) for steps, _ in curves):
                smooth = [(steps, smoothed(values, window)) for steps, values in curves]
                _draw_seeds(panel, smooth, line, quantity.logarithmic)
        if task > 0 and panel is panels[task - 1]:
            panel.axvline(boundaries[task - 1], **SWITCH_STYLE)
        panel.set_xlim(boundaries[task - 1] if task and panel is not panels[0] else 0, boundaries[task])
        panel.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}k" if value else "0")
        panel.spines[["top", "right"]].set_visible(False)


def _draw_seeds(panel: Any, curves: Sequence[Series], line: Method, logarithmic: bool) -> None:
    """A line for each seed, or of more than three seeds their mean and a band."""
    style: dict[str, Any] = dict(color=line.color, linewidth=1.6, label=line.label)
    if len(curves) > len(SEED_STYLES):
        draw_band(panel, [curve for curve in curves if len(curve[0])], logarithmic, **style)
        return
    for (steps, values), linestyle in zip(curves, SEED_STYLES, strict=False):
        if len(steps):
            panel.plot(steps, values, linestyle=linestyle, marker="o" if len(steps) == 1 else None, **style)


def _add_legend(figure: Any, panels: Sequence[Any]) -> None:
    """One for all panels."""
    legend: dict[str, Any] = {}
    for panel in panels:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            legend.setdefault(label, handle)
    for n_columns in range(min(len(legend), 5), 0, -1):
        drawn = figure.legend(legend.values(), legend.keys(), loc="outside lower center", ncols=n_columns, frameon=False)
        if n_columns == 1 or drawn.get_window_extent().width <= figure.bbox.width:
            break
        drawn.remove()


def _save(figure: Any, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    plt.close(figure)
