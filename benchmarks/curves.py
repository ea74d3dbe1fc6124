"""Tables and learning curves of runs of one environment."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.markdown import markdown_table
from benchmarks.runs import Run
from benchmarks.suites import Suite, Task
from sb3_cchain.callbacks.continual_metrics import task_averages

LABELS = {
    "ppo_oracle": "Oracle",
    "double_dqn_oracle": "Oracle",
    "ppo": "PPO",
    "double_dqn": "Double DQN",
    "ppo_trac": "TRAC",
    "ppo_weight_clipping": "Weight clipping",
    "ppo_l2_init": "L2 Init",
    "ppo_layer_norm": "LayerNorm",
    "ppo_redo": "ReDo",
    "ppo_adam_rel": "AdamRel",
    "ppo_cchain": "C-CHAIN PPO",
    "dqn_cchain": "C-CHAIN DQN",
}
COLORS = {
    **{algo: "tab:brown" for algo in ("ppo_oracle", "double_dqn_oracle")},
    **{algo: "tab:gray" for algo in ("ppo", "double_dqn")},
    **{algo: "tab:blue" for algo in ("ppo_cchain", "dqn_cchain")},
    "ppo_trac": "tab:orange",
    "ppo_weight_clipping": "tab:green",
    "ppo_l2_init": "tab:red",
    "ppo_layer_norm": "tab:purple",
    "ppo_redo": "tab:pink",
    "ppo_adam_rel": "tab:olive",
}

# Which returns of a run: those of training (`Run.returns`), or of evaluation (`Run.evaluations`)
Returns = Callable[[Run], list[dict[str, float]]]


def averages_of(run: Run, returns: Returns = Run.returns) -> list[float]:
    """
    :param run: A finished run
    :param returns: Which returns
    :return: J(T_i) of each task: the mean over its rollouts (or evaluations) of the mean return of their episodes
    """
    averages = task_averages(returns(run))
    return [averages.get(task, math.nan) for task in range(run.n_tasks)]


def row_of(run: Run, returns: Returns = Run.returns) -> list[str]:
    """
    :param run: A finished run
    :param returns: Which returns
    :return: Cells: algorithm, seed, average return of each task, mean over the tasks
    """
    return [LABELS[run.algo], str(run.seed), *_figures(averages_of(run, returns))]


def _figures(averages: Sequence[float] | np.ndarray) -> list[str]:
    """The averages of the tasks, and their mean."""
    return [f"{average:.0f}" if abs(average) >= 100 else f"{average:.1f}" for average in [*averages, np.mean(averages)]]


def returns_table(runs: Sequence[Run], returns: Returns = Run.returns, random_returns: Sequence[float] | None = None) -> str:
    """
    :param runs: Finished runs of one environment and length
    :param returns: Which returns
    :param random_returns: A random policy's return on each task
    :return: A row per run, one per algorithm with the mean over its seeds, and one for the random policy
    """
    n_tasks = runs[0].n_tasks
    header = ["algorithm", "seed", *(f"task {task}" for task in range(n_tasks)), "J(T)"]
    rows = [row_of(run, returns) for run in runs]
    for algo in dict.fromkeys(run.algo for run in runs):
        averages = np.mean([averages_of(run, returns) for run in runs if run.algo == algo], axis=0)
        rows.append([f"**{cell}**" for cell in (LABELS[algo], "mean", *_figures(averages))])
    if random_returns is not None:
        rows.append(["random policy", "", *_figures(random_returns)])
    return markdown_table(header, rows)


def cost_table(runs: Sequence[Run]) -> str:
    """
    :param runs: Finished runs
    :return: A row per run: environment steps per second, and peak memory
    """
    rows = []
    for run in runs:
        steps_per_second, memory = run.cost
        rows.append([LABELS[run.algo], str(run.seed), f"{steps_per_second:.0f}", f"{memory:.1f} GB"])
    return markdown_table(["algorithm", "seed", "steps per second", "peak memory"], rows)


def smoothed(values: np.ndarray, window: int) -> np.ndarray:
    """
    :param values: A series
    :param window: Length of the running mean
    :return: Mean of the last ``window`` values at each point, of fewer at the beginning
    """
    sums = np.cumsum(np.insert(values, 0, 0.0))
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(ends - window, 0)
    return (sums[ends] - sums[starts]) / (ends - starts)


def plot_curves(
    runs: Sequence[Run],
    path: Path,
    title: str,
    returns: Returns = Run.returns,
    window: int = 5,
    task_names: Sequence[str] | None = None,
    random_returns: Sequence[float] | None = None,
    own_scales: bool = False,
    frames: Sequence[np.ndarray] = (),
) -> None:
    """
    Draw the return of each rollout (or evaluation) against environment steps, a thin line per run, a thick one for the mean
    over seeds, and the task switches.

    :param runs: Finished runs of one environment and length
    :param path: PNG file
    :param title: Title
    :param returns: Which returns
    :param window: Rollouts that the running mean goes over, inside a task
    :param task_names: Names of the tasks, by default their numbers
    :param random_returns: A random policy's return on each task, drawn as a dotted line
    :param own_scales: Whether each task has a panel with a scale of its own, where tasks differ in the size of their returns
    :param frames: A picture of each task, drawn above the curves
    """
    plt.style.use("default")  # RL Zoo's plots leave seaborn's behind
    n_tasks, steps_per_task = runs[0].n_tasks, runs[0].steps_per_task
    task_names = task_names or [f"task {task}" for task in range(n_tasks)]
    frames_height = min(8 / n_tasks * max((frame.shape[0] / frame.shape[1] for frame in frames), default=0), 2.4)
    figure = plt.figure(figsize=(9, 4.2 + frames_height), layout="constrained")
    grid = figure.add_gridspec(2 if len(frames) else 1, n_tasks, height_ratios=[frames_height, 3.8] if len(frames) else [1])
    for task, frame in enumerate(frames):
        picture = figure.add_subplot(grid[0, task])
        picture.imshow(frame)
        picture.axis("off")
    if own_scales:
        panels = [figure.add_subplot(grid[-1, task]) for task in range(n_tasks)]
    else:
        panels = [figure.add_subplot(grid[-1, :])] * n_tasks
    axes: Any
    for task, axes in enumerate(panels):
        start, end = task * steps_per_task, (task + 1) * steps_per_task
        for algo in LABELS:
            _draw(axes, [run for run in runs if run.algo == algo], task, returns, window)
        if random_returns is not None:
            axes.hlines(random_returns[task], start, end, color="0.35", linestyle=":", label="random policy")
        at_middle: dict[str, Any] = dict(ha="center", va="bottom", transform=axes.get_xaxis_transform(), color="0.35")
        axes.text((start + end) / 2, 1.01, task_names[task], **at_middle)
        if task > 0 and not own_scales:
            axes.axvline(start, color="0.35", linestyle="--", linewidth=1)
        axes.set_xlim(start if own_scales else 0, end)
        axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}k" if value else "0")
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("return per episode")
    figure.suptitle(title)
    panels[n_tasks // 2].set_xlabel("environment steps")
    handles, labels = panels[0].get_legend_handles_labels()
    legend = dict(zip(labels, handles, strict=True))
    figure.legend(legend.values(), legend.keys(), loc="outside lower center", ncols=min(len(legend), 3), frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _draw(axes: Any, runs: Sequence[Run], task: int, returns: Returns, window: int) -> None:
    """One task's returns under one algorithm."""
    if not runs:
        return
    color = COLORS[runs[0].algo]
    curves = []
    for run in runs:
        rows = [row for row in returns(run) if row["task_id"] == task]
        steps = np.array([row["timesteps"] for row in rows])
        curves.append((steps, smoothed(np.array([row["mean_return"] for row in rows]), window)))
        if len(runs) > 1:
            axes.plot(*curves[-1], color=color, linewidth=0.6, alpha=0.5)
    grid = np.linspace(max(steps[0] for steps, _ in curves), min(steps[-1] for steps, _ in curves), 80)
    mean = np.mean([np.interp(grid, *curve) for curve in curves], axis=0)
    label = LABELS[runs[0].algo] + (f", mean of {len(runs)} seeds" if len(runs) > 1 else "")
    marker = "o" if grid[0] == grid[-1] else None  # a single rollout
    axes.plot(grid, mean, color=color, linewidth=2.2, marker=marker, label=label)


def report(suite: Suite, runs: Sequence[Run], folder: Path, tasks: Sequence[Task]) -> None:
    """
    Write ``table.md`` and ``curves.png``, and print the tables.

    :param suite: Suite of the runs
    :param runs: Finished runs of one environment and length
    :param folder: Where they go
    :param tasks: The tasks of the runs
    """
    runs = sorted(runs, key=lambda run: (list(LABELS).index(run.algo), run.seed))
    tables = f"{returns_table(runs, suite.returns, [task.random_return for task in tasks])}\n\n{cost_table(runs)}"
    (folder / "table.md").write_text(tables + "\n")
    plot_suite(suite, runs, folder / "curves.png", runs[0].env_id, tasks)
    print(f"{tables}\n\nWritten: {folder}/table.md, {folder}/curves.png")


def plot_suite(suite: Suite, runs: Sequence[Run], path: Path, title: str, tasks: Sequence[Task]) -> None:
    """
    The learning curves as the suite wants them.

    :param suite: Suite of the runs
    :param runs: Finished runs of one environment and length
    :param path: PNG file
    :param title: Title
    :param tasks: The tasks of the runs
    """
    plot_curves(
        runs,
        path,
        title,
        suite.returns,
        window=1 if suite.evaluates else 5,
        task_names=[task.name for task in tasks],
        random_returns=[task.random_return for task in tasks],
        own_scales=suite.own_scales,
        frames=[task.frame for task in tasks if task.frame is not None],
    )
