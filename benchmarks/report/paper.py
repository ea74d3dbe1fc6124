"""The numbers of the paper, as ``paper_tables.csv`` holds them."""

import csv
from dataclasses import dataclass
from pathlib import Path

TABLES = Path(__file__).with_name("paper_tables.csv")

# Name of the row that sums up a suite's environments
AGGREGATE = "aggregate"


@dataclass(frozen=True)
class Figure:
    """
    One cell of the paper's tables.

    :param mean: Average episode return over the task sequence, mean over the seeds; in ``AGGREGATE``, the sum over the
        environments
    :param standard_error: Its standard error, NaN in ``AGGREGATE``, for which the paper states none
    :param mark: What it is marked as: ``"best"``, ``"second"`` or nothing
    """

    mean: float
    standard_error: float
    mark: str


@dataclass(frozen=True)
class Table:
    """
    One table of the paper.

    :param figures: By environment id (or ``AGGREGATE``) and method
    :param lengths: Tasks, and environment steps per task, of each environment
    :param n_seeds: Seeds of each figure
    """

    figures: dict[tuple[str, str], Figure]
    lengths: dict[str, tuple[int, int]]
    n_seeds: int

    @property
    def methods(self) -> list[str]:
        """Methods that it compares."""
        return list(dict.fromkeys(method for _, method in self.figures))

    def means(self, env_id: str) -> dict[str, float]:
        """
        :param env_id: Environment id, or ``AGGREGATE``
        :return: The mean of each method
        """
        return {method: figure.mean for (name, method), figure in self.figures.items() if name == env_id}


def read_tables() -> dict[str, Table]:
    """
    :return: The tables by suite
    """
    tables: dict[str, Table] = {}
    with open(TABLES, newline="") as file:
        # The first lines name the source
        for row in csv.DictReader(line for line in file if not line.startswith("#")):
            table = tables.setdefault(row["suite"], Table({}, {}, int(row["seeds"] or 0)))
            standard_error = float(row["standard_error"] or "nan")
            table.figures[row["env_id"], row["method"]] = Figure(float(row["mean"]), standard_error, row["mark"])
            if row["env_id"] != AGGREGATE:
                table.lengths[row["env_id"]] = int(row["n_tasks"]), int(row["steps_per_task"])
    return tables
