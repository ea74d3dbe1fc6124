"""The tables that set cells beside the paper's, in Markdown."""

from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks.grid.results import Result
from benchmarks.grid.run import lines_in_order, short_name, suite_lines
from benchmarks.grid.strengths import split_line
from benchmarks.number_text import with_error
from benchmarks.report.cells import JT, Cell, Cells
from benchmarks.report.estimates import best_two
from benchmarks.report.markdown import markdown_table
from benchmarks.report.paper import AGGREGATE, Table
from benchmarks.report.task_tables import MISSING, seeds_text
from benchmarks.report.verdicts import AGREES, DISAGREES, verdict


def method_label(suite: str, method: str) -> str:
    """
    :param suite: Name of a suite
    :param method: Name of a method, also with another strength
    :return: The method's label in that suite
    """
    return suite_lines(suite, [method])[method].label


def table_methods(cells: Cells, paper: Table) -> list[str]:
    """
    :param cells: Cells of a suite
    :param paper: The paper's table
    :return: The methods that are in either, also with another strength, in the order of the tables
    """
    return lines_in_order([*paper.methods, *(line for _, line in cells)])


def lengths_table(results: Sequence[Result], paper: Table) -> str:
    """
    :param results: Runs of a suite
    :param paper: The paper's table
    :return: The lengths of the runs beside the paper's, and what follows where they differ
    """
    lengths = {result.env_id: (result.n_tasks, result.steps_per_task) for result in results}
    rows = []
    for env_id in paper.lengths:
        if env_id in lengths:
            rows.append([short_name(env_id), *(f"{n} × {steps:,}" for n, steps in (lengths[env_id], paper.lengths[env_id]))])
    table = markdown_table(["tasks × environment steps", "here", "paper"], rows)
    seeds = f"The paper's means are of {paper.n_seeds} seeds."
    if all(paper.lengths[env_id] == length for env_id, length in lengths.items()):
        return f"{table}\n\nThe lengths are the paper's. {seeds}"
    return (
        f"{table}\n\n{seeds} Runs of another length than the paper's are not expected to agree with its numbers: in a shorter "
        "sequence the first task, which all methods learn alike, weighs more, and so does the time that learning takes."
    )


def results_table(suite: str, cells: Cells, paper: Table) -> str:
    """
    :param suite: Name of the suite
    :param cells: Its cells
    :param paper: The paper's table
    :return: For each environment, J(T) here, its interval, the paper's and the seeds; and the aggregates
    """
    methods = table_methods(cells, paper)
    digits = table_digits(paper)
    rows = []
    for env_id in paper.lengths:
        env_cells = {method: cells[env_id, method] for method in methods if (env_id, method) in cells}
        marks = best_two({method: cell.mean for method, cell in env_cells.items()})
        paper_marks = best_two(paper.means(env_id))
        here, interval, printed, seeds = [short_name(env_id), "here"], ["", "95 % interval"], ["", "paper"], ["", "seeds"]
        for method in methods:
            cell, figure = env_cells.get(method), paper.figures.get((env_id, method))
            here.append(MISSING)
            interval.append(MISSING)
            seeds.append(MISSING)
            if cell is not None:
                sign = ""
                if cell.interval is not None:
                    interval[-1] = f"[{cell.interval[0]:.{digits}f}, {cell.interval[1]:.{digits}f}]"
                if figure is not None:
                    sign = {AGREES: " ✓", DISAGREES: " ✗"}.get(verdict(cell, figure, paper.lengths[env_id]), "")
                different = " †" if len(cell.versions) > 1 else ""
                here[-1] = _marked(cell.mean, cell.error, digits, marks.get(method)) + sign + different
                seeds[-1] = seeds_text(cell.seeds)
            printed.append(_marked(figure.mean, figure.standard_error, digits, paper_marks.get(method)) if figure else MISSING)
        rows += [here, interval, printed, seeds] if env_cells else [here, printed]
    if printed_sums := paper.means(AGGREGATE):
        rows += [
            ["aggregate", "here", *_sums(aggregates(cells, methods, paper), methods, digits)],
            ["", "paper", *_sums(printed_sums, methods, digits)],
        ]
    return markdown_table(["J(T)", "", *(method_label(suite, method) for method in methods)], rows)


def aggregates(cells: Cells, methods: Sequence[str], paper: Table) -> dict[str, float]:
    """
    :param cells: Cells of a suite
    :param methods: Methods
    :param paper: The paper's table
    :return: For the methods that have all environments of the paper's table, the sum of their means
    """
    complete = [method for method in methods if all((env_id, method) in cells for env_id in paper.lengths)]
    return {method: sum(cells[env_id, method].mean for env_id in paper.lengths) for method in complete}


def mark_differences(suite: str, paper: Table) -> list[str]:
    """
    :param suite: Name of the suite
    :param paper: The paper's table
    :return: Where its marks do not follow from its numbers, or its aggregates differ from the sums of its cells by more than
        rounding
    """
    differences = []
    for (env_id, method), figure in paper.figures.items():
        means = paper.means(env_id)
        name, label = "Aggregate" if env_id == AGGREGATE else short_name(env_id), method_label(suite, method)
        if best_two(means).get(method, "") != figure.mark:
            rank = 1 + sum(mean > figure.mean for other, mean in means.items() if other != "oracle")
            marked = f"marked as {figure.mark}" if figure.mark else "not marked"
            differences.append(f"- {name}: {label} is {marked}; by its mean it is number {rank} (without the Oracle).")
        if env_id == AGGREGATE:
            total = sum(paper.figures[one, method].mean for one in paper.lengths)
            if abs(total - figure.mean) > 0.01:
                differences.append(f"- {name}: {label} is printed as {figure.mean}; its cells sum to {total:.3f}.")
    return differences


def score_matrices(
    cells: Cells, paper: Table, rule: str = JT
) -> tuple[list[str], dict[str, np.ndarray], dict[str, list[int]]]:
    """
    The part of a table that can be aggregated over environments: the environments in which both Vanilla and C-CHAIN
    (:func:`cchain_line`) have runs, and the methods and seeds that are in all of these.

    :param cells: Cells of a suite
    :param paper: The paper's table
    :param rule: What the runs are scored by
    :return: Environments; the scores of each method, ``(n_seeds, n_environments)``; and each method's seeds
    """
    env_ids = [env_id for env_id in paper.lengths if {(env_id, "vanilla"), (env_id, cchain_line(cells))} <= set(cells)]
    matrices, seeds_of = {}, {}
    for method in lines_in_order(line for _, line in cells):
        method_cells: list[Cell | None] = [cells.get((env_id, method)) for env_id in env_ids]
        complete = [cell for cell in method_cells if cell is not None]
        if not complete or len(complete) < len(env_ids):
            continue
        seeds = sorted(set.intersection(*(set(cell.seeds) for cell in complete)))
        if seeds:
            by_seed = [dict(zip(cell.seeds, cell.scores_by(rule), strict=True)) for cell in complete]
            matrices[method] = np.array([[scores[seed] for scores in by_seed] for seed in seeds])
            seeds_of[method] = seeds
    return env_ids, matrices, seeds_of


def cchain_line(cells: Cells) -> str:
    """
    :param cells: Cells of a suite
    :return: C-CHAIN or, where it was run with other β alone, the one of these that has most environments
    """
    lines = [line for _, line in cells if split_line(line)[0] == "cchain"]
    return "cchain" if "cchain" in lines or not lines else max(lines_in_order(lines), key=lines.count)


def table_digits(paper: Table) -> int:
    """
    :param paper: The paper's table
    :return: Digits after the point for returns of this size
    """
    means = [figure.mean for (env_id, _), figure in paper.figures.items() if env_id != AGGREGATE]
    return 1 if max(map(abs, means)) >= 100 else 2


def _sums(sums: Mapping[str, float], methods: Sequence[str], digits: int) -> list[str]:
    marks = best_two(sums)
    return [_marked(sums[method], None, digits, marks.get(method)) if method in sums else MISSING for method in methods]


def _marked(mean: float, error: float | None, digits: int, mark: str | None) -> str:
    return {None: "{}", "best": "**{}**", "second": "<ins>{}</ins>"}[mark].format(with_error(mean, error, digits))
