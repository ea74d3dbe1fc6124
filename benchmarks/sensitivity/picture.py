"""J(T) against β and against the size of the reference batch."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.grid.run import short_name, suite_methods
from benchmarks.sensitivity.costs import BASE, Cost
from benchmarks.sensitivity.runs import PARAMETERS, SUITE, Parameter, Scores
from sb3_cchain.analysis.plots import import_matplotlib


def plot(scores: Mapping[str, tuple[Scores, Scores]], costs: Mapping[str, Mapping[str, Cost]], path: Path, title: str) -> Any:
    """
    Draw a row of panels for each parameter and a column for each environment: dots are seeds, the line goes through their
    means, the dashed line is PPO, the dotted ones its seeds. Values without a run are grey.

    :param scores: J(T) of C-CHAIN PPO and of PPO, by key of ``PARAMETERS``
    :param costs: Processor time, by environment and model
    :param path: PNG file
    :param title: Title
    :return: The figure
    """
    matplotlib = import_matplotlib()
    env_ids = list(next(iter(scores.values()))[0])
    figure = matplotlib.figure.Figure(figsize=(4.8 * len(env_ids), 3.4 * len(scores) + 0.6), dpi=110, layout="constrained")
    grid = figure.subplots(len(scores), len(env_ids), squeeze=False, sharey="col")
    for panels, (name, (values, base)) in zip(grid, scores.items(), strict=True):
        for panel, env_id in zip(panels, env_ids, strict=True):
            shown_costs = costs.get(env_id, {}) if name == "reference" else {}
            _draw(panel, PARAMETERS[name], env_id, values[env_id], base[env_id][BASE], shown_costs)
    for panel, env_id in zip(grid[0], env_ids, strict=True):
        panel.set_title(short_name(env_id))
    for panels in grid:
        panels[0].set_ylabel("J(T)")
    handles = dict(zip(*reversed(grid[0, 0].get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles), frameon=False)
    figure.suptitle(title, fontsize=10)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    return figure


def _draw(
    panel: Any,
    parameter: Parameter,
    env_id: str,
    values: Mapping[str, Mapping[int, float]],
    base: Mapping[int, float],
    costs: Mapping[str, Cost],
) -> None:
    ppo, cchain = (suite_methods(SUITE)[name] for name in ("vanilla", "cchain"))
    means = [np.mean(list(scores.values())) if scores else np.nan for scores in values.values()]
    panel.plot(range(len(means)), means, color=cchain.color, linewidth=1.5, label=f"{cchain.label}, mean")
    for place, (scores, mean) in enumerate(zip(values.values(), means, strict=True)):
        if scores:
            dots = panel.plot([place] * len(scores), list(scores.values()), "o", color=cchain.color, markersize=4, alpha=0.6)
            dots[0].set_label(f"{cchain.label}, seeds")
            panel.plot([place], [mean], "_", color=cchain.color, markersize=14, markeredgewidth=2)
        else:
            panel.axvspan(place - 0.4, place + 0.4, color="0.93", zorder=0)
            across = panel.get_xaxis_transform()  # heights from 0 to 1
            panel.text(place, 0.97, "no run", color="0.5", rotation=90, ha="center", va="top", transform=across)
    if base:
        panel.axhline(np.mean(list(base.values())), color=ppo.color, linestyle="--", linewidth=1.2, label=f"{ppo.label}, mean")
    for score in base.values():
        seed = panel.axhline(score, color=ppo.color, linestyle=":", linewidth=0.9)
        seed.set_label(f"{ppo.label}, seeds")
    labels = []
    for value in values:
        shipped = "\nshipped" if parameter.is_shipped(value, env_id) else ""
        cost = f"\n{costs[value].ratios[0]:.2f}×" if value in costs else ""
        labels.append(f"{value}{cost}{shipped}")
    panel.set_xticks(range(len(labels)), labels, fontsize=8)
    panel.set_xlim(-0.6, len(labels) - 0.4)
    panel.set_xlabel(f"{parameter.label}\nand time of an iteration / PPO's" if costs else parameter.label)
    panel.spines[["top", "right"]].set_visible(False)
