"""The tables of the results."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from textwrap import fill
from typing import Any

import numpy as np

from benchmarks.number_text import with_error
from benchmarks.report.markdown import markdown_table
from benchmarks.report.places import LINE_LENGTH
from benchmarks.supervised.learner import BATCH_SIZE, METHODS
from benchmarks.supervised.tasks import PROBLEMS
from benchmarks.supervised.training import read_about, read_accuracies

# The paper's table in Appendix A.4: mean and standard error over three seeds
PAPER = {
    "random_label_mnist": {
        "vanilla": (0.1501, 0.0030),
        "cchain": (0.2482, 0.0141),
        "l2_init": (0.8607, 0.0021),
        "weight_clipping": (0.4304, 0.0052),
    },
    "permuted_mnist": {
        "vanilla": (0.6430, 0.0029),
        "cchain": (0.6797, 0.0042),
        "l2_init": (0.8039, 0.0027),
        "weight_clipping": (0.8281, 0.0001),
    },
}
PAPER_SEEDS = 3

# Part of the tasks that counts as their beginning and their end
PART = 0.1

NOTHING = "No run is done yet."


@dataclass(frozen=True)
class Result:
    """
    What a run has left.

    :param accuracies: Online accuracy of each task
    :param about: Its settings, versions, updates and seconds
    """

    accuracies: np.ndarray
    about: dict[str, Any]


# By method, then by seed
Results = Mapping[str, Mapping[int, Result]]


def read_results(folder: Path, problem_name: str) -> dict[str, dict[int, Result]]:
    """
    :param folder: Folder of all results
    :param problem_name: Key of ``PROBLEMS``
    :return: The results of the problem
    """
    results: dict[str, dict[int, Result]] = {method: {} for method in METHODS}
    for method, seeds in results.items():
        paths = (folder / problem_name).glob(f"{method}_seed_*/accuracy.csv")
        for path in sorted(paths, key=lambda path: int(path.parent.name.rpartition("_")[2])):
            accuracies, about = read_accuracies(path.parent), read_about(path.parent)
            seeds[about["settings"]["seed"]] = Result(accuracies, about)
    return results


def results_table(problem_name: str, results: Results) -> str:
    """
    :param problem_name: Key of ``PROBLEMS``
    :param results: Its results
    :return: A table with a row for each method, beside the paper's numbers, and what they were made with
    """
    if not any(results.values()):
        return NOTHING
    problem = PROBLEMS[problem_name]
    rows = []
    for method, label in METHODS.items():
        # Only as many tasks as all seeds have
        n_tasks = min((len(result.accuracies) for result in results[method].values()), default=0)
        cells = [""] * 3
        if n_tasks:
            runs = [result.accuracies[:n_tasks] for result in results[method].values()]
            n_part = max(round(PART * n_tasks), 1)
            cells = [
                _mean([run[part].mean() for run in runs]) for part in (slice(n_tasks), slice(n_part), slice(-n_part, None))
            ]
        rows.append(
            [label, str(len(results[method])), str(n_tasks), *cells, with_error(*PAPER[problem_name][method], digits=4)]
        )
    columns = ["accuracy", f"first {PART:.0%} of tasks", f"last {PART:.0%}"]
    header = ["", "seeds", "tasks", *columns, f"paper ({PAPER_SEEDS} seeds, {problem.n_tasks} tasks)"]
    parts = [markdown_table(header, rows), fill(_made_with(results), LINE_LENGTH)]
    if missing := _missing(problem_name, results):
        parts.append(fill(missing, LINE_LENGTH))
    return "\n\n".join(parts)


def _made_with(results: Results) -> str:
    settings = [result.about["settings"] for seeds in results.values() for result in seeds.values()]
    lengths = dict.fromkeys(
        f"{each['images']} images, {each['epochs']} epoch{'s' if each['epochs'] > 1 else ''}" for each in settings
    )
    sources = dict.fromkeys(each["data"] for each in settings)
    speeds = "; ".join(
        f"{METHODS[method]}: {speed:.0f}" for method in METHODS if (speed := _updates_per_second(results[method])) is not None
    )
    return f"Data: {' and '.join(sources)}. A task: {' or '.join(lengths)}. Updates in a second of processor time: {speeds}."


def _updates_per_second(seeds: Mapping[int, Result]) -> float | None:
    seconds = sum(result.about["processor_seconds"] for result in seeds.values())
    return sum(result.about["updates"] for result in seeds.values()) / seconds if seconds else None


def _missing(problem_name: str, results: Results) -> str:
    """What the paper's length lacks, and what it would take."""
    problem = PROBLEMS[problem_name]
    updates_per_task = problem.n_images // BATCH_SIZE * problem.n_epochs
    words, hours, priced = [], 0.0, True
    for method, label in METHODS.items():
        done = [len(result.accuracies) for result in results[method].values()]
        n_missing = problem.n_tasks * max(PAPER_SEEDS, len(done)) - sum(min(n, problem.n_tasks) for n in done)
        if n_missing <= 0:
            continue
        words.append(f"{label}: {n_missing} tasks")
        speed = _updates_per_second(results[method])
        if speed is None:
            priced = False
        else:
            hours += n_missing * updates_per_task / speed / 3600
    if not words:
        return ""
    price = f"{hours:.1f} core-hours at this speed" + ("" if priced else ", without the methods that have no run yet")
    return f"Missing for the paper's length, {PAPER_SEEDS} seeds: {'; '.join(words)}. That is {price}."


def _mean(values: list[float]) -> str:
    """Their mean, and its standard error where there are several seeds."""
    error = stdev(values) / math.sqrt(len(values)) if len(values) > 1 else None
    return with_error(fmean(values), error, digits=4)
