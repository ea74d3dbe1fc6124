"""Whether a cell agrees with the paper's, and whether C-CHAIN − Vanilla has the paper's sign."""

from collections.abc import Mapping

from benchmarks.grid.run import short_name
from benchmarks.report.cells import Cell, Cells, common_rule
from benchmarks.report.estimates import Difference, Sample, agrees, bootstrap_interval, difference, sample
from benchmarks.report.markdown import markdown_table
from benchmarks.report.paper import Figure, Table
from benchmarks.report.task_tables import MISSING

AGREES, DISAGREES, TOO_FEW = "✓ agrees", "✗ disagrees", "not enough runs"
# Fewer seeds have no verdict
ENOUGH_SEEDS = 3


def lacks(cell: Cell, length: tuple[int, int]) -> list[str]:
    """
    :param cell: A cell
    :param length: The paper's number of tasks, and environment steps per task
    :return: What it lacks for a verdict, in a few words each
    """
    words = []
    if len(cell.seeds) < ENOUGH_SEEDS:
        words.append(f"{len(cell.seeds)} seed{'s' if len(cell.seeds) > 1 else ''}")
    if (cell.results[0].n_tasks, cell.results[0].steps_per_task) != length:
        words.append("other length")
    return words


def verdict(cell: Cell, figure: Figure, length: tuple[int, int]) -> str:
    """
    :param cell: A cell
    :param figure: The paper's
    :param length: The paper's number of tasks, and environment steps per task
    :return: ``AGREES``, ``DISAGREES`` or ``TOO_FEW``
    """
    interval = bootstrap_interval(cell.paper_scores)
    if interval is None or lacks(cell, length):
        return TOO_FEW
    return AGREES if agrees(interval, figure.mean, figure.standard_error) else DISAGREES


def verdict_words(cell: Cell, figure: Figure, length: tuple[int, int]) -> str:
    """
    :param cell: A cell
    :param figure: The paper's
    :param length: The paper's number of tasks, and environment steps per task
    :return: The verdict; where there is none, what the cell lacks
    """
    text = verdict(cell, figure, length)
    return f"{TOO_FEW}: {', '.join(lacks(cell, length))}" if text == TOO_FEW else text


def verdicts_table(cells: Cells, paper: Table, labels: Mapping[str, str]) -> str:
    """
    :param cells: Cells of a suite
    :param paper: The paper's table
    :param labels: Label of each of its methods
    :return: The verdict of each of the paper's cells
    """
    rows = []
    for env_id, length in paper.lengths.items():
        row = [short_name(env_id)]
        for method in labels:
            cell, figure = cells.get((env_id, method)), paper.figures.get((env_id, method))
            row.append(MISSING if cell is None or figure is None else verdict_words(cell, figure, length))
        rows.append(row)
    return markdown_table(["", *labels.values()], rows)


def signs_table(cells: Cells, paper: Table, cchain: str, digits: int) -> str:
    """
    :param cells: Cells of a suite
    :param paper: The paper's table
    :param cchain: The line that stands for C-CHAIN
    :param digits: Digits of returns after the point
    :return: C-CHAIN − Vanilla in each environment that has both, beside the paper's
    """
    rows = []
    for env_id in paper.lengths:
        vanilla, churn = cells.get((env_id, "vanilla")), cells.get((env_id, cchain))
        if vanilla is None or churn is None:
            continue
        rule = common_rule((churn, vanilla))
        here = difference(*(sample(cell.scores_by(rule)) for cell in (churn, vanilla)))
        figures = [paper.figures[env_id, method] for method in ("cchain", "vanilla")]
        printed = difference(*(Sample(figure.mean, figure.standard_error, paper.n_seeds) for figure in figures))
        seeds = f"{len(churn.seeds)} − {len(vanilla.seeds)}"
        row = [short_name(env_id), rule, seeds, *difference_cells(here, digits), *difference_cells(printed, digits)]
        if 1 in (len(churn.seeds), len(vanilla.seeds)):
            row[4] = "none: one seed"
        rows.append([*row, sign_words(here, printed)])
    columns = ["95 % interval", "effect size"]
    header = ["C-CHAIN − Vanilla", "score", "seeds", "here", *columns, "paper", *columns, "sign"]
    return markdown_table(header, rows)


def difference_cells(one: Difference, digits: int) -> list[str]:
    """
    :param one: A difference
    :param digits: Digits after the point
    :return: It, its interval and its effect size
    """
    interval = MISSING if one.interval is None else f"[{one.interval[0]:+.{digits}f}, {one.interval[1]:+.{digits}f}]"
    return [f"{one.value:+.{digits}f}", interval, MISSING if one.effect is None else f"{one.effect:+.1f}"]


def sign_words(here: Difference, printed: Difference) -> str:
    """
    :param here: The difference here
    :param printed: The paper's
    :return: Whether the signs are the same, and whether chance would explain the one here
    """
    if here.value == 0:
        return "none: no difference"
    text = "the paper's" if here.value * printed.value > 0 else "**not the paper's**"
    if here.interval is None:
        return f"{text}; no interval"
    return f"{text}; the interval holds 0" if here.interval[0] <= 0 <= here.interval[1] else f"{text}; clear of 0"
