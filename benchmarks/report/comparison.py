"""The table and the learning curves of methods side by side in one environment."""

from collections.abc import Mapping, Sequence

from benchmarks.grid.results import Result
from benchmarks.report.figures import plot_learning_curves
from benchmarks.report.markdown import markdown_table
from benchmarks.report.random_policy import TaskLook
from benchmarks.report.task_tables import average_cells, cost_table, mean_rows, returns_header, returns_rows
from sb3_cchain.methods.registry import Method


def write_comparison(results: Sequence[Result], lines: Mapping[str, Method], looks: Sequence[TaskLook] = ()) -> None:
    """
    Print the tables, and write them and the curves into the folder of the environment.

    :param results: Results of one environment, which differ in their method or variant and seed
    :param lines: Methods or variants in order
    :param looks: What each task is without an agent; empty to leave that out
    """
    rows = [*returns_rows(results, lines), *mean_rows(results, lines)]
    if looks:
        rows.append(["random policy", "", *average_cells([look.random_return for look in looks])])
    tables = f"{markdown_table(returns_header(results[0].task_names), rows)}\n\n{cost_table(results, lines)}"
    folder = results[0].path.parents[1]
    (folder / "table.md").write_text(tables + "\n")
    plot_learning_curves(results, folder / "curves.png", lines, results[0].env_id, looks)
    print(f"{tables}\n\nWritten: {folder}/table.md, {folder}/curves.png")
