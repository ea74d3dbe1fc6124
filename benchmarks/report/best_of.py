"""Best of β: in each environment the best of the β that were run, as the paper reports it, beside the shipped one."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.grid.run import other_beta, short_name, split_line
from benchmarks.report.cells import Cell, Cells
from benchmarks.report.markdown import markdown_table
from benchmarks.report.paper import Table
from benchmarks.report.tables import method_label, table_digits
from benchmarks.report.task_tables import MISSING
from benchmarks.report.verdicts import TOO_FEW, verdict_words

# Of which β the paper takes the best in each environment; in the other suites it has one
PAPER_BETAS = {"gym_control": ("1e3", "1e4", "1e5"), "procgen": ("1e3", "1e4", "1e5")}

COLUMNS = ("suite", "env_id", "method", "betas", "seeds", "best_beta", "best_mean", "shipped_beta", "shipped_mean")

WORDS = """\
In each environment the best of the β that were run, by the mean over the seeds that all of them have, beside the shipped
one. *Best of n* was chosen by the very runs that it is the mean of: it is **biased upwards**. Of equally good β, the best
mean is above the true one by 0.56 standard errors for n = 2, and by 0.85 for n = 3. The *shipped* β was fixed beforehand. The
paper's numbers are best-of-three, so the best of the same three is what compares with them: with fewer β there is no
verdict. The outcome is kept in `best_of.csv`."""


@dataclass(frozen=True)
class Best:
    """
    The best β of a method in an environment.

    :param env_id: The environment
    :param method: The method
    :param cells: The cell of each β that was run
    :param seeds: Seeds that all of them have; there is no best without any
    :param beta: The best of them
    :param shipped: The β that the shipped hyperparameters have, None where it was not run
    """

    env_id: str
    method: str
    cells: dict[str, Cell]
    seeds: list[int]
    beta: str
    shipped: str | None

    def mean(self, beta: str | None) -> float | None:
        """
        :param beta: A β
        :return: Its mean over ``seeds``, None where it was not run
        """
        return None if beta is None else _means(self.cells, self.seeds)[beta]


def best_betas(cells: Cells, env_ids: Sequence[str]) -> list[Best]:
    """
    :param cells: Cells of a suite
    :param env_ids: Its environments
    :return: The best β of each method that has runs with another β than the shipped one
    """
    methods = dict.fromkeys(split_line(line)[0] for _, line in cells if "@" in line)
    found = []
    for env_id in env_ids:
        for method in methods:
            by_beta: dict[str, Cell] = {}
            shipped = None
            for (name, line), cell in cells.items():
                if name != env_id or split_line(line)[0] != method:
                    continue
                beta = _beta(cell)
                if line == method:
                    shipped = beta
                # The shipped β under its own name is the same method
                if line == method or beta not in by_beta:
                    by_beta[beta] = cell
            seeds = sorted(set.intersection(*(set(cell.seeds) for cell in by_beta.values()))) if by_beta else []
            if seeds:
                means = _means(by_beta, seeds)
                by_beta = {beta: by_beta[beta] for beta in sorted(by_beta, key=float)}
                found.append(Best(env_id, method, by_beta, seeds, max(by_beta, key=means.__getitem__), shipped))
    return found


def best_table(suite: str, found: Sequence[Best], paper: Table) -> str:
    """
    :param suite: Name of the suite
    :param found: The best β
    :param paper: The paper's table
    :return: Best of β and the shipped one beside the paper's number
    """
    digits = table_digits(paper)
    rows = []
    for best in found:
        figure = paper.figures.get((best.env_id, best.method))
        lacking = [beta for beta in PAPER_BETAS.get(suite, ()) if beta not in best.cells]
        words = MISSING
        if figure is not None:
            words = verdict_words(best.cells[best.beta], figure, paper.lengths[best.env_id])
            if lacking:
                words = f"{TOO_FEW}: β = {', '.join(lacking)} missing"
        rows.append(
            [
                f"{short_name(best.env_id)}, {method_label(suite, best.method)}",
                ", ".join(best.cells),
                " ".join(map(str, best.seeds)),
                f"{best.mean(best.beta):.{digits}f} (best of {len(best.cells)}: β = {best.beta})",
                MISSING if best.shipped is None else f"{best.mean(best.shipped):.{digits}f} (β = {best.shipped})",
                MISSING if figure is None else f"{figure.mean:.{digits}f} ± {figure.standard_error:.{digits}f}",
                words,
            ]
        )
    header = ["J(T)", "β", "seeds", "best of n", "shipped, fixed", "paper, best of 3", "best of n against the paper"]
    if suite not in PAPER_BETAS:
        header[5] = "paper, one β"
    return markdown_table(header, rows)


def write_best(found: Sequence[tuple[str, Best]], path: Path) -> None:
    """
    Write the outcome, a row for each environment.

    :param found: Suites and their best β
    :param path: CSV file; without any outcome none is written, and an older one removed
    """
    path.unlink(missing_ok=True)
    if not found:
        return
    with open(path, "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for suite, best in found:
            means = ["" if mean is None else round(mean, 3) for mean in map(best.mean, (best.beta, best.shipped))]
            values = best.beta, means[0], best.shipped, means[1]
            betas, seeds = " ".join(best.cells), " ".join(map(str, best.seeds))
            writer.writerow([suite, best.env_id, best.method, betas, seeds, *values])


def _beta(cell: Cell) -> str:
    run = cell.results[0]
    value = {**run.hyperparameters, **other_beta(run)}["target_churn_ratio"]
    return split_line(f"cchain@{value}")[1] or ""


def _means(cells: dict[str, Cell], seeds: Sequence[int]) -> dict[str, float]:
    """Of each β, by the same rule for all: that of the paper where all have it."""
    by_paper = all(cell.scores_with_cut is not None for cell in cells.values())
    means = {}
    for beta, cell in cells.items():
        scores = dict(zip(cell.seeds, cell.paper_scores if by_paper else cell.scores, strict=True))
        means[beta] = float(np.mean([scores[seed] for seed in seeds]))
    return means
