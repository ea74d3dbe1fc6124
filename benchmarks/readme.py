"""
The table and the picture of the README, and the tables behind them in the documentation, from the committed results of Gym
Control. Trains nothing.

    python -m benchmarks.run --suite gym_control --method vanilla cchain oracle --seeds 0 1   # makes the runs
    python -m benchmarks.readme            # prints the tables
    python -m benchmarks.readme --write    # tables and picture, into README and documentation
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from textwrap import fill

from benchmarks.grid.results import Result, read_results
from benchmarks.grid.run import ROOT, short_name, suite_lines
from benchmarks.grid.suites import SUITES
from benchmarks.number_text import thousands, with_error
from benchmarks.report.cells import Cell, Cells, make_cells
from benchmarks.report.collapses import COLLAPSED, collapses, collapses_table
from benchmarks.report.markdown import markdown_table
from benchmarks.report.paper import Table, read_tables
from benchmarks.report.places import LINE_LENGTH, write_tables
from benchmarks.report.tables import method_label, table_methods
from benchmarks.report.task_tables import MISSING, returns_header, returns_rows
from sb3_cchain.analysis.curves import smoothed
from sb3_cchain.analysis.plots import import_matplotlib

SUITE, BUDGET = "gym_control", "paper"
METHODS = ("oracle", "vanilla", "cchain")

# The picture
PICTURED = "Continual/LunarLander-v3"
PICTURE = ROOT / "docs/images/loss_of_plasticity.png"
TITLES = {"vanilla": "PPO: stops learning", "cchain": "C-CHAIN PPO: recovers, except in one task"}


def read_cells(results: Path) -> Cells:
    """
    :param results: Folder of all results
    :return: The runs of the README, by environment id and method
    """
    found, _ = read_results(results / BUDGET / SUITE)
    cells, _ = make_cells([result for result in found if result.line in METHODS])
    return cells


def readme_table(cells: Cells) -> str:
    """
    :param cells: The runs, by environment id and method
    :return: J(T) in each environment, here and in the paper, and how many tasks end in a collapse
    """
    paper = read_tables()[SUITE]
    rows = []
    for env_id in SUITES[SUITE].env_ids:
        here = [cells[env_id, method] for method in METHODS]
        lengths = f"{here[0].results[0].n_tasks} × {thousands(here[0].results[0].steps_per_task)}"
        n_seeds = ", ".join(map(str, sorted({len(cell.seeds) for cell in here})))
        printed = [_printed(paper, env_id, method) for method in ("vanilla", "cchain")]
        rows.append([short_name(env_id), lengths, n_seeds, *map(_score, here), *printed])
    labels = [method_label(SUITE, method) for method in METHODS]
    header = ["J(T)", "tasks × steps", "seeds", *labels, "PPO, paper", "C-CHAIN, paper"]
    counts = {
        method: collapses([result for env_id in COLLAPSED for result in cells[env_id, method].results]) for method in METHODS
    }
    ends = {method: f"{collapsed} of {tasks}" for method, (collapsed, tasks) in counts.items()}
    names = ", ".join(map(_game, COLLAPSED))
    sentence = (
        f"{names}: PPO has collapsed at the end of {ends['vanilla']} tasks after a switch, C-CHAIN PPO of {ends['cchain']}, "
        f"Oracle of {ends['oracle']}: the policy repeats one action."
    )
    return f"{markdown_table(header, rows)}\n\n{fill(sentence, LINE_LENGTH)}"


def documentation_tables(results: Path) -> dict[str, str]:
    """
    :param results: Folder of all results
    :return: The tables of the documentation, by their names: J(T) of all methods; for each environment the mean return of
        each run on each task; and the policy churn in the first iteration of each task
    """
    runs, _ = read_results(results / BUDGET / SUITE)
    lines = suite_lines(SUITE, {run.line for run in runs})
    tables, churn = {"gym_control_scores": scores_table(runs)}, []
    for env_id in SUITES[SUITE].env_ids:
        here, name = [run for run in runs if run.env_id == env_id], short_name(env_id)
        header = returns_header([str(task) for task in range(here[0].n_tasks)])
        tables[f"{_game(env_id).lower()}_tasks"] = markdown_table(header, returns_rows(here, lines, digits=0))
        if env_id in COLLAPSED:
            churn.append(f"{name}:\n\n{collapses_table(here, lines)}")
    return {**tables, "gym_control_collapses": "\n\n".join(churn)}


def scores_table(runs: Sequence[Result]) -> str:
    """
    :param runs: Runs of the suite
    :return: For each method J(T) in each environment, here and in the paper
    """
    cells, _ = make_cells(runs)
    paper, env_ids = read_tables()[SUITE], SUITES[SUITE].env_ids
    header = ["J(T)", *(name for env_id in env_ids for name in (_game(env_id), "paper"))]
    rows = []
    for method in table_methods(cells, paper):
        row = [method_label(SUITE, method)]
        for env_id in env_ids:
            row += [_score(cells.get((env_id, method))), _printed(paper, env_id, method)]
        rows.append(row)
    return markdown_table(header, rows)


def _game(env_id: str) -> str:
    """The name of an environment without its version."""
    return short_name(env_id).split("-")[0]


def _score(cell: Cell | None) -> str:
    if cell is None:
        return MISSING
    return with_error(cell.mean, cell.error, 0)


def _printed(paper: Table, env_id: str, method: str) -> str:
    figure = paper.figures.get((env_id, method))
    return MISSING if figure is None else with_error(figure.mean, figure.standard_error, 0)


def plot(cells: Cells, path: Path) -> None:
    """
    Draw the learning curves of PPO and of C-CHAIN PPO beside each other, a line for each seed.

    :param cells: The runs, by environment id and method
    :param path: PNG file
    """
    matplotlib = import_matplotlib()
    figure = matplotlib.figure.Figure(figsize=(7.5, 3.4), layout="constrained")  # small, so that a phone shows large letters
    panels = figure.subplots(1, len(TITLES), sharey=True)
    for panel, (method, title) in zip(panels, TITLES.items(), strict=True):
        results = cells[PICTURED, method].results
        for index, result in enumerate(results):
            for task in range(result.n_tasks):
                steps, returns = result.returns_in_task(task)
                label = None if task else f"seed {result.seed}"
                panel.plot(steps, smoothed(returns, 10), color=f"C{index}", label=label)
        for end in results[0].task_boundaries[:-1]:
            panel.axvline(end, color="0.35", linestyle="--", linewidth=1)
        panel.axhline(cells[PICTURED, "oracle"].mean, color="black", linestyle=":", linewidth=1, label="Oracle, mean")
        panel.set_title(title, fontsize="medium", fontweight="bold")
        panel.xaxis.set_major_locator(matplotlib.ticker.MultipleLocator(400_000))
        panel.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}k" if value else "0")
        panel.spines[["top", "right"]].set_visible(False)
    figure.supxlabel("environment steps; the world changes at the dashed lines", fontsize="medium")
    panels[0].set_ylabel("return per episode")
    panels[-1].legend(loc="lower right", framealpha=1, edgecolor="white")
    figure.savefig(path, dpi=160)


def main(arguments: Sequence[str] | None = None) -> None:
    """
    :param arguments: Arguments of the command line
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=ROOT / "benchmarks/results", help="Folder of all results")
    parser.add_argument("--write", action="store_true", help="Put tables and picture into README and documentation")
    args = parser.parse_args(arguments)
    cells = read_cells(args.results)
    missing = [f"{env_id} {method}" for env_id in SUITES[SUITE].env_ids for method in METHODS if (env_id, method) not in cells]
    if missing:
        parser.error(f"--results must have runs of {', '.join(missing)}; there are none in {args.results}")
    table, others = readme_table(cells), documentation_tables(args.results)
    print(table, *others.values(), sep="\n\n")
    if args.write:
        write_tables({"readme": table}, ROOT / "README.md")
        write_tables(others, ROOT / "docs")
        plot(cells, PICTURE)


if __name__ == "__main__":
    main()
