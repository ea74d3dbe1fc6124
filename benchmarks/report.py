"""Tables and learning curves of runs."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.runs import Run
from sb3_cchain.callbacks.continual_metrics import task_averages

LABELS = {"ppo": "PPO", "ppo_cchain": "C-CHAIN PPO", "double_dqn": "Double DQN", "dqn_cchain": "C-CHAIN DQN"}
COLORS = {"ppo": "tab:gray", "ppo_cchain": "tab:blue", "double_dqn": "tab:gray", "dqn_cchain": "tab:blue"}

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
    averages = averages_of(run, returns)
    return [LABELS[run.algo], str(run.seed), *(_figure(average) for average in [*averages, float(np.mean(averages))])]


def _figure(average: float) -> str:
    return f"{average:.0f}" if abs(average) >= 100 else f"{average:.1f}"


def markdown_table(runs: Sequence[Run], returns: Returns = Run.returns) -> str:
    """
    :param runs: Finished runs of one environment and length
    :param returns: Which returns
    :return: A row per run, and one per algorithm with the mean over its seeds
    """
    n_tasks = runs[0].n_tasks
    header = ["algorithm", "seed", *(f"task {task}" for task in range(n_tasks)), "J(T)"]
    lines = [header, ["---"] * len(header), *(row_of(run, returns) for run in runs)]
    for algo in dict.fromkeys(run.algo for run in runs):
        averages = np.mean([averages_of(run, returns) for run in runs if run.algo == algo], axis=0)
        cells = [_figure(average) for average in [*averages, averages.mean()]]
        lines.append([f"**{LABELS[algo]}**", "**mean**", *(f"**{cell}**" for cell in cells)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


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
    note: str = "",
    task_names: Sequence[str] | None = None,
) -> None:
    """
    Draw the return of each rollout (or evaluation) against environment steps, a thin line per run, a thick one for the mean
    over seeds, and the task switches.

    :param runs: Finished runs of one environment and length
    :param path: PNG file
    :param title: Title
    :param returns: Which returns
    :param window: Rollouts that the running mean goes over, inside a task
    :param note: Small print under the picture
    :param task_names: Names of the tasks, by default their numbers
    """
    plt.style.use("default")  # RL Zoo's plots leave seaborn's behind
    figure, axes = plt.subplots(figsize=(9, 4.2), layout="constrained")
    by_algo: Mapping[str, list[Run]] = {algo: [run for run in runs if run.algo == algo] for algo in LABELS}
    task_names = task_names or [f"task {task}" for task in range(runs[0].n_tasks)]
    n_tasks, steps_per_task = runs[0].n_tasks, runs[0].steps_per_task
    for algo, algo_runs in by_algo.items():
        if not algo_runs:
            continue
        label: str | None = LABELS[algo] + (f", mean of {len(algo_runs)} seeds" if len(algo_runs) > 1 else "")
        for task in range(n_tasks):
            curves = []
            grid = np.linspace(task * steps_per_task, (task + 1) * steps_per_task, 81)[1:]
            for run in algo_runs:
                rows = [row for row in returns(run) if row["task_id"] == task]
                steps = np.array([row["timesteps"] for row in rows])
                smooth = smoothed(np.array([row["mean_return"] for row in rows]), window)
                curves.append(np.interp(grid, steps, smooth))
                if len(algo_runs) > 1:
                    axes.plot(steps, smooth, color=COLORS[algo], linewidth=0.6, alpha=0.5)
            axes.plot(grid, np.mean(curves, axis=0), color=COLORS[algo], linewidth=2.2, label=label)
            label = None
    for task in range(n_tasks):
        middle = (task + 0.5) * steps_per_task
        axes.text(middle, 1.01, task_names[task], ha="center", va="bottom", transform=axes.get_xaxis_transform(), color="0.35")
        if task > 0:
            axes.axvline(task * steps_per_task, color="0.35", linestyle="--", linewidth=1)
    axes.set(xlabel="environment steps", ylabel="return per episode", xlim=(0, n_tasks * steps_per_task))
    axes.set_title(title, pad=20)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:.0f}k" if value else "0")
    figure.legend(loc="outside lower center", ncols=len(LABELS), frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    if note:
        figure.supxlabel(note, fontsize=8, color="0.35")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def report(runs: Sequence[Run], folder: Path, title: str, returns: Returns = Run.returns, **options: Any) -> None:
    """
    Write ``table.md`` and ``curves.png``, and print the table.

    :param runs: Finished runs of one environment and length
    :param folder: Where they go
    :param title: Title of the picture
    :param returns: Which returns
    :param options: Keyword arguments of :func:`plot_curves`
    """
    runs = sorted(runs, key=lambda run: (list(LABELS).index(run.algo), run.seed))
    table = markdown_table(runs, returns)
    (folder / "table.md").write_text(table + "\n")
    plot_curves(runs, folder / "curves.png", title, returns, **options)
    print(f"{table}\n\nWritten: {folder}/table.md, {folder}/curves.png")
