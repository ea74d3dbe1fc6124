"""The cells of a table: runs of one method in one environment that differ in their seed alone."""

import math
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from benchmarks.grid.results import Result
from benchmarks.report.estimates import Interval, bootstrap_interval, mean_and_error

Cells = dict[tuple[str, str], "Cell"]

# By which rule runs are scored, in the tables that compare them
JT, RELEASED = "J(T)", "released code"


@dataclass(frozen=True)
class Cell:
    """
    All runs of one method in one environment.

    :param results: The runs, by their seeds
    :param scores: J(T) of each: the mean over its tasks of J(T_i)
    """

    results: tuple[Result, ...]
    scores: tuple[float, ...]

    @cached_property
    def released_scores(self) -> tuple[float, ...] | None:
        """The score of each by the rule of the released code, None unless all runs have logged it in all tasks."""
        scores = tuple(float(np.mean(result.released_averages())) for result in self.results)
        return scores if all(map(math.isfinite, scores)) else None

    @property
    def paper_scores(self) -> tuple[float, ...]:
        """Those to compare with the paper: by the rule of the released code where it was logged, else the scores."""
        return self.released_scores or self.scores

    @property
    def seeds(self) -> list[int]:
        """Seeds of the runs."""
        return [result.seed for result in self.results]

    def scores_by(self, rule: str) -> tuple[float, ...]:
        """
        :param rule: ``JT``, or ``RELEASED`` where the runs logged that
        :return: The score of each run by that rule
        """
        return self.paper_scores if rule == RELEASED else self.scores

    def with_seeds(self, seeds: Container[int]) -> "Cell":
        """
        :param seeds: Some of its seeds
        :return: A cell of their runs
        """
        runs = [(run, score) for run, score in zip(self.results, self.scores, strict=True) if run.seed in seeds]
        return Cell(tuple(run for run, _ in runs), tuple(score for _, score in runs))

    @property
    def mean(self) -> float:
        """Mean over the seeds."""
        return mean_and_error(self.scores)[0]

    @property
    def error(self) -> float | None:
        """Standard error of the mean, None for a single seed."""
        return mean_and_error(self.scores)[1]

    @property
    def interval(self) -> Interval | None:
        """95 % bootstrap interval of the mean, None for a single seed."""
        return bootstrap_interval(self.scores)

    @property
    def versions(self) -> list[tuple[str, list[int]]]:
        """Each set of versions among the runs (only the packages in which they differ), and the seeds that have it."""
        names = sorted({name for result in self.results for name in result.versions})
        differing = [name for name in names if len({result.versions.get(name) for result in self.results}) > 1]
        by_versions: dict[str, list[int]] = {}
        for result in self.results:
            versions = {name: result.versions.get(name, "unknown") for name in differing}
            by_versions.setdefault(versions_text(versions), []).append(result.seed)
        return list(by_versions.items())


def common_rule(cells: Iterable[Cell]) -> str:
    """
    :param cells: Cells that are compared with each other
    :return: The rule to score them all by: ``RELEASED`` where all runs have logged that, else ``JT``
    """
    return RELEASED if all(cell.released_scores is not None for cell in cells) else JT


def make_cells(results: Iterable[Result]) -> tuple[Cells, list[str]]:
    """
    :param results: Runs of one suite and budget
    :return: Cells by environment id and method; and for each run whose J(T) is not defined the reason, in one line. Its cell
        is left out as a whole: to leave out that seed alone would be a choice by its outcome
    :raises ValueError: When runs that should differ in their seed alone differ in other settings, or are there twice; or when
        lengths differ in an environment
    """
    by_cell: dict[tuple[str, str], list[Result]] = {}
    for result in sorted(results, key=lambda result: result.seed):
        by_cell.setdefault((result.env_id, result.line), []).append(result)
    lengths: dict[str, Result] = {}
    cells: Cells = {}
    left_out: list[str] = []
    for key, runs in by_cell.items():
        _check_equal(runs, [name for name in runs[0].settings if name != "seed"])
        _check_equal([lengths.setdefault(key[0], runs[0]), *runs], ["n_tasks", "steps_per_task"])
        for one, other in pairwise(runs):
            if one.seed == other.seed:
                raise ValueError(f"Seed {one.seed} is there twice: {one.path} and {other.path}")
        averages = [result.task_averages() for result in runs]
        scores = tuple(sum(run_averages) / len(run_averages) for run_averages in averages)
        if all(map(math.isfinite, scores)):
            cells[key] = Cell(tuple(runs), scores)
            continue
        for result, run_averages in zip(runs, averages, strict=True):
            for task in (task for task, average in enumerate(run_averages) if not math.isfinite(average)):
                left_out.append(f"{key[0]}, {key[1]}, seed {result.seed}: no return in {result.task_names[task]}")
    return cells, left_out


def versions_text(versions: dict[str, str]) -> str:
    """
    :param versions: Versions of packages
    :return: As text
    """
    return ", ".join(f"{name} {version}" for name, version in sorted(versions.items()))


def _check_equal(runs: Sequence[Result], names: Sequence[str]) -> None:
    for result in runs[1:]:
        for name in names:
            one, other = runs[0].settings[name], result.settings[name]
            if one != other:
                paths = f"{runs[0].path} and {result.path}"
                raise ValueError(f"Runs of one table must not differ in `{name}`: {paths} have {one} and {other}")
