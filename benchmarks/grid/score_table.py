"""The average performance of the runs that are done, in short; ``benchmarks.report`` says more."""

from collections.abc import Iterable

import numpy as np
from rich import box
from rich.table import Table

from benchmarks.grid.results import Result
from benchmarks.grid.run import short_name


def score_table(results: Iterable[Result]) -> Table:
    """
    :param results: Runs that are done
    :return: For each environment and method the number of seeds, and the mean of J(T) over them with its standard error, as
        far as there are several
    """
    scores: dict[tuple[str, str], list[float]] = {}
    for result in results:
        scores.setdefault((short_name(result.env_id), result.line), []).append(float(np.mean(result.task_averages())))
    table = Table("environment", "method", box=box.ASCII)
    for title in ("seeds", "J(T)", "standard error"):
        table.add_column(title, justify="right")
    for (env, line), values in scores.items():
        error = f"{np.std(values, ddof=1) / np.sqrt(len(values)):.2g}" if len(values) > 1 else ""
        table.add_row(env, line, str(len(values)), f"{np.mean(values):.4g}", error)
    return table
