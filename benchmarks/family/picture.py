"""The learning curves of a case."""

from pathlib import Path

import numpy as np

from benchmarks.family.case import Case
from benchmarks.family.tables import Evaluations
from sb3_cchain.analysis.plots import import_matplotlib

# By position: the base algorithm, C-CHAIN with its defaults, others
COLORS = ("tab:gray", "tab:blue", "tab:orange", "tab:green")


def plot(case: Case, evaluations: Evaluations, path: Path) -> None:
    """
    Draw a panel for each variant: its seeds as thin lines, their mean, and the mean of the first variant for comparison.

    :param case: A case
    :param evaluations: Its results, of at least one run
    :param path: PNG file
    """
    names = [name for name in case.variants if evaluations[name]]
    colors = dict(zip(case.variants, COLORS, strict=False))
    base = next(iter(case.variants))
    matplotlib = import_matplotlib()
    figure = matplotlib.figure.Figure(figsize=(3.6 * len(names), 3.2), layout="constrained")
    panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    for panel, name in zip(panels, names, strict=True):
        seeds = list(evaluations[name].values())
        for each in seeds:
            panel.plot(*each.T, color=colors[name], alpha=0.4, linewidth=0.8)
        if name != base and evaluations[base]:
            label = f"{case.variants[base].label}, mean"
            panel.plot(*_mean(list(evaluations[base].values())).T, color="black", linestyle="--", linewidth=1, label=label)
        label = f"mean of {len(seeds)} seed{'s' if len(seeds) > 1 else ''}"
        panel.plot(*_mean(seeds).T, color=colors[name], linewidth=2, label=label)
        for task in range(1, case.n_tasks):
            panel.axvline(task * case.steps / case.n_tasks, color="black", linewidth=0.6, linestyle=":")
        if case.solved is not None:
            panel.axhline(case.solved, color="black", linewidth=0.6, linestyle=":")
        panel.set(title=case.variants[name].label, xlabel="environment steps")
        panel.title.set_fontsize(10)
        panel.xaxis.set_major_formatter(matplotlib.ticker.EngFormatter(sep=""))  # 20k, 1M
        panel.spines[["top", "right"]].set_visible(False)
        panel.legend(fontsize=8, frameon=False)
    if case.solved is not None:
        panels[0].set_ylim(bottom=case.worst)  # of all panels; after all curves, for which the top is no longer changed
    what = "success rate" if case.score == "success_rate" else "mean return"
    panels[0].set_ylabel(f"{what} of {case.n_eval_episodes} episodes")
    figure.suptitle(f"{case.title}: thin lines are seeds", fontsize=11)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _mean(seeds: list[np.ndarray]) -> np.ndarray:
    return np.mean(seeds, axis=0)
