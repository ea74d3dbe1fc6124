"""Accuracy over the tasks."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from benchmarks.supervised.learner import METHODS
from benchmarks.supervised.tables import Results
from benchmarks.supervised.tasks import PROBLEMS
from sb3_cchain.analysis.plots import import_matplotlib
from sb3_cchain.methods.registry import REGISTRY

COLORS = {row.name: row.color for row in REGISTRY}


def plot(problems: Mapping[str, Results], path: Path) -> None:
    """
    Draw a panel for each problem: the mean of each method over its seeds, and each seed as a thin line.

    :param problems: Results by key of ``PROBLEMS``
    :param path: PNG file
    """
    matplotlib = import_matplotlib()
    figure = matplotlib.figure.Figure(figsize=(5.2 * len(problems), 3.6), layout="constrained")
    for panel, (name, results) in zip(figure.subplots(1, len(problems), squeeze=False)[0], problems.items(), strict=True):
        for method, label in METHODS.items():
            runs = [result.accuracies for result in results[method].values()]
            if not runs:
                continue
            for accuracies in runs if len(runs) > 1 else ():
                panel.plot(np.arange(1, len(accuracies) + 1), accuracies, color=COLORS[method], alpha=0.3, linewidth=0.6)
            n_tasks = min(map(len, runs))
            mean = np.mean([accuracies[:n_tasks] for accuracies in runs], axis=0)
            marker = "." if n_tasks < 20 else None
            panel.plot(np.arange(1, n_tasks + 1), mean, color=COLORS[method], linewidth=1.6, marker=marker, label=label)
        panel.set(title=PROBLEMS[name].title, xlabel="task", ylabel="online accuracy")
        panel.xaxis.get_major_locator().set_params(integer=True, min_n_ticks=1)
        panel.spines[["top", "right"]].set_visible(False)
        if panel.lines:
            panel.legend(fontsize=8, frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
