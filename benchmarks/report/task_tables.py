"""Tables of single runs: returns of each task, what the runs cost, and other quantities over the tasks."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks.grid.results import Result
from benchmarks.report.markdown import escaped, markdown_table
from benchmarks.report.quantities import Quantity
from sb3_cchain.methods.registry import Method

MISSING = "–"


def in_order(results: Sequence[Result], lines: Mapping[str, Method]) -> list[Result]:
    """
    :param results: Runs
    :param lines: Methods or variants, in their order
    :return: The runs in that order, then by their seeds
    """
    return sorted(results, key=lambda result: (list(lines).index(result.line), result.seed))


def returns_rows(results: Sequence[Result], lines: Mapping[str, Method], digits: int = 1) -> list[list[str]]:
    """
    :param results: Runs in one environment, of one length
    :param lines: Label of each method or variant, in their order
    :param digits: Digits after the point
    :return: For each run its method, seed, J(T_i) of each task, and J(T)
    """
    return [
        [lines[result.line].label, str(result.seed), *average_cells(result.task_averages(), digits)]
        for result in in_order(results, lines)
    ]


def mean_rows(results: Sequence[Result], lines: Mapping[str, Method]) -> list[list[str]]:
    """
    :param results: Runs in one environment, of one length
    :param lines: Label of each method or variant, in their order
    :return: Rows like those of :func:`returns_rows`, in bold: for each method the mean over its seeds
    """
    rows = []
    for name in dict.fromkeys(result.line for result in in_order(results, lines)):
        averages = np.mean([result.task_averages() for result in results if result.line == name], axis=0)
        rows.append([f"**{cell}**" for cell in (lines[name].label, "mean", *average_cells(averages))])
    return rows


def average_cells(averages: Sequence[float] | np.ndarray, digits: int = 1) -> list[str]:
    """
    :param averages: An average of each task
    :param digits: Digits after the point
    :return: They and their mean, as cells
    """
    return [MISSING if math.isnan(value) else f"{value:.{digits}f}" for value in (*averages, float(np.mean(averages)))]


def returns_header(task_names: Sequence[str]) -> list[str]:
    """
    :param task_names: Names of the tasks
    :return: Header of the tables of returns
    """
    return ["method", "seed", *map(escaped, task_names), "J(T)"]


def cost_table(results: Sequence[Result], lines: Mapping[str, Method]) -> str:
    """
    :param results: Runs
    :param lines: Label of each method or variant, in their order
    :return: For each run environment steps per second (start included), and peak memory
    """
    rows = []
    for result in in_order(results, lines):
        memory = MISSING if result.peak_memory is None else f"{result.peak_memory / 1e9:.1f} GB"
        rows.append([lines[result.line].label, str(result.seed), f"{result.steps_per_second:.0f}", memory])
    return markdown_table(["method", "seed", "steps per second", "peak memory"], rows)


def quantities_table(
    results: Sequence[Result], lines: Mapping[str, Method], quantities: Sequence[Quantity], per_seed: bool = False
) -> str:
    """
    :param results: Runs in one environment, of one length
    :param lines: Label of each method or variant, in their order
    :param quantities: What is tabled
    :param per_seed: Whether each seed has a number of its own, in place of the mean over the seeds
    :return: For each quantity and method its mean over the values logged in each task
    """
    rows = []
    for quantity in quantities:
        for name, line in lines.items():
            runs = in_order([result for result in results if result.line == name], lines)
            if not runs:
                continue
            means = np.array([[_mean(quantity.series(run, task)[1]) for task in range(run.n_tasks)] for run in runs])
            cells = (means if per_seed else means.mean(axis=0, keepdims=True)).T
            texts = [" / ".join(MISSING if math.isnan(mean) else f"{mean:.3g}" for mean in cell) for cell in cells]
            rows.append([quantity.label, line.label, seeds_text([run.seed for run in runs]), *texts])
    return markdown_table(["", "method", "seeds", *map(escaped, results[0].task_names)], rows)


def seeds_text(seeds: Sequence[int]) -> str:
    """
    :param seeds: Seeds
    :return: As text
    """
    return " ".join(map(str, seeds))


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else math.nan
