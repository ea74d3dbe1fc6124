"""
All methods beside each other: J(T) on three continual environments, and what an iteration costs. Trains nothing.

    python -m benchmarks.run --suite shelf     # makes the runs that are missing
    python -m benchmarks.shelf                 # prints the table
    python -m benchmarks.shelf --write         # table and picture, into the documentation
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from benchmarks.grid.arguments import add_folder_arguments
from benchmarks.grid.plan import SHELF_SUITES, shelf_runs
from benchmarks.grid.results import Result, read_result
from benchmarks.grid.run import Run, short_name, suite_methods
from benchmarks.report.markdown import markdown_table
from benchmarks.report.places import LINE_LENGTH, PLACE, write_tables
from benchmarks.report.task_tables import MISSING
from sb3_cchain.analysis.plots import import_matplotlib
from sb3_cchain.methods.registry import Method

PICTURE = "images/shelf.png"
# The page with the table of `benchmarks.speed --case related`
COSTS = "results/speed.md"

# J(T) of each seed, by environment and method
Scores = Mapping[str, Mapping[str, Sequence[float]]]


def read_shelf(runs: Sequence[Run], results: Path) -> dict[Run, Result]:
    """
    :param runs: The runs of the shelf
    :param results: Folder of all results
    :return: Those that are done, also with other hyperparameters than are shipped now
    """
    found = {run: read_result(run.path_in(results)) for run in runs}
    return {run: result for run, result in found.items() if result and _plan(result) == _plan(run)}


def _plan(run: Run) -> dict[str, Any]:
    """What determines the run, but for the hyperparameters."""
    return {name: value for name, value in run.settings.items() if name != "hyperparameters"}


def scores_of(runs: Sequence[Run], done: Mapping[Run, Result]) -> Scores:
    """
    :param runs: The runs of the shelf
    :param done: Those that are done
    :return: J(T) of those
    """
    scores: dict[str, dict[str, list[float]]] = {}
    for run in runs:
        of_method = scores.setdefault(run.env_id, {}).setdefault(run.method, [])
        if run in done:
            of_method.append(float(np.mean(done[run].task_averages())))
    return scores


def otherwise_line(done: Mapping[Run, Result], methods: Mapping[str, Method]) -> str:
    """
    :param done: The runs that are done
    :param methods: The methods, by name
    :return: Which of them had other hyperparameters than are shipped now; empty when none had
    """
    others: dict[str, list[str]] = {}
    for run, result in done.items():
        if result.settings != run.settings:
            others.setdefault(short_name(run.env_id), []).append(methods[run.method].label)
    listed = "; ".join(f"{name}: {', '.join(dict.fromkeys(labels))}" for name, labels in others.items())
    return fill(f"Made with other hyperparameters than are shipped now: {listed}.", LINE_LENGTH) if listed else ""


def read_costs(page: Path) -> dict[str, float]:
    """
    :param page: Page with the table of ``benchmarks.speed --case related``
    :return: By label, the time of an iteration divided by PPO's
    """
    (table,) = (place[0] for place in PLACE.finditer(page.read_text()) if place[1] == "related")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines() if line.startswith("| 3 it")]
    return {label: float(cost.split()[0]) for _, label, _, cost in rows}


def order(scores: Scores, methods: Mapping[str, Method]) -> list[str]:
    """
    :param scores: J(T)
    :param methods: The methods, by name
    :return: Their names, from the best mean rank over the environments to the worst; those without a score in one of them last
    """
    ranks: dict[str, list[float]] = {name: [] for name in methods}
    for of_env in scores.values():
        means = {name: float(np.mean(values)) for name, values in of_env.items() if values}
        for rank, name in enumerate(sorted(means, key=means.__getitem__, reverse=True)):
            ranks[name].append(rank)
    n_envs = len(scores)
    return sorted(methods, key=lambda name: (-len(ranks[name]), np.mean(ranks[name]) if ranks[name] else n_envs))


def shelf_table(scores: Scores, costs: Mapping[str, float], methods: Mapping[str, Method]) -> str:
    """
    :param scores: J(T)
    :param costs: Time of an iteration divided by PPO's, by label
    :param methods: The methods, by name
    :return: A row for each: J(T) of each seed and the mean in each environment, and the cost
    """
    rows = []
    for name in order(scores, methods):
        label = methods[name].label
        cells = []
        for of_env in scores.values():
            values = of_env.get(name, [])
            cells += [" ".join(f"{value:.0f}" for value in values) or MISSING, f"{np.mean(values):.0f}" if values else MISSING]
        rows.append([label, *cells, f"{costs[label]:.2f}" if label in costs else MISSING])
    header = ["method"]
    for env_id in scores:
        header += [f"{short_name(env_id)}, by seed", "mean"]
    return markdown_table([*header, "time / PPO"], rows)


def plot(scores: Scores, costs: Mapping[str, float], methods: Mapping[str, Method], path: Path) -> None:
    """
    Draw a row for each method: its J(T) in each environment that has runs, a dot for each seed, and its cost.

    :param scores: J(T)
    :param costs: Time of an iteration divided by PPO's, by label
    :param methods: The methods, by name
    :param path: PNG file
    """
    names = [name for name in order(scores, methods) if any(of_env.get(name) for of_env in scores.values())]
    scores = {env_id: of_env for env_id, of_env in scores.items() if any(of_env.values())}
    matplotlib = import_matplotlib()
    figure = matplotlib.figure.Figure(figsize=(10, 1.2 + 0.27 * len(names)), layout="constrained")
    panels = figure.subplots(1, len(scores) + 1, sharey=True, width_ratios=[*[3] * len(scores), 2.4])
    heights = np.arange(len(names))[::-1]
    for panel, (env_id, of_env) in zip(panels, scores.items(), strict=False):
        for height, name in zip(heights, names, strict=True):
            if values := of_env.get(name):
                color = methods[name].color
                panel.plot(values, [height] * len(values), "o", color=color, markersize=4, alpha=0.6)
                panel.plot([np.mean(values)], [height], "|", color=color, markersize=13, markeredgewidth=2.5)
        if of_env.get("vanilla"):
            panel.axvline(np.mean(of_env["vanilla"]), color="black", linestyle="--", linewidth=0.8)
        panel.set(title=short_name(env_id), xlabel="J(T)")
    shown = [costs.get(methods[name].label, np.nan) for name in names]
    panels[-1].barh(heights, shown, color=[methods[name].color for name in names], height=0.6)
    panels[-1].axvline(1, color="black", linestyle="--", linewidth=0.8)
    panels[-1].set(title="cost", xlabel="time of an iteration / PPO")
    panels[0].set_yticks(heights, [methods[name].label for name in names])
    for panel in panels:
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(axis="y", linewidth=0.4, alpha=0.5)
        panel.tick_params(axis="y", length=0)
    figure.suptitle("Dots are seeds, bars their means, the dashed line is PPO", fontsize=10)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def main(arguments: Sequence[str] | None = None) -> None:
    """
    :param arguments: Arguments of the command line
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_folder_arguments(parser)
    parser.add_argument("--write", action="store_true", help="Put table and picture into the documentation")
    args = parser.parse_args(arguments)
    runs = shelf_runs()
    done = read_shelf(runs, args.results)
    scores = scores_of(runs, done)
    costs = read_costs(args.docs / COSTS)
    there = {run.method for run in runs}
    methods = {name: method for name, method in suite_methods(SHELF_SUITES[0]).items() if name in there}
    table = "\n\n".join(part for part in (shelf_table(scores, costs, methods), otherwise_line(done, methods)) if part)
    print(table)
    if args.write:
        plot(scores, costs, methods, args.docs / PICTURE)
        write_tables({"shelf": table}, args.docs)


if __name__ == "__main__":
    main()
