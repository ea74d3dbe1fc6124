"""What a reader asks first: does it agree with the paper, what was run on what, what is missing and how long does it take."""

from collections import Counter
from collections.abc import Sequence

from benchmarks.grid.plan import BUDGETS, N_SEEDS, Rates, budget_length
from benchmarks.grid.results import Result
from benchmarks.grid.run import Run, lines_in_order, short_name, strength_of
from benchmarks.grid.strengths import split_line
from benchmarks.grid.suites import SUITES
from benchmarks.report.best_of import paper_strengths
from benchmarks.report.cells import Cells, versions_text
from benchmarks.report.markdown import code, escaped, markdown_table
from benchmarks.report.paper import AGGREGATE, Table
from benchmarks.report.tables import cchain_line, method_label, table_digits
from benchmarks.report.task_tables import MISSING
from benchmarks.report.verdicts import AGREES, DISAGREES, ENOUGH_SEEDS, TOO_FEW, signs_table, verdict, verdicts_table

WORDS = f"""\
## At first sight

- **{AGREES}**: at least {ENOUGH_SEEDS} seeds of the paper's length, and their 95 % interval overlaps the paper's mean ± 2
  standard errors. **{DISAGREES}**: as many, and it does not. Overlap is a mild test; wide intervals agree easily.
- **{TOO_FEW}**: fewer seeds, or another length than the paper's. Such a cell never agrees or disagrees, however close it
  is.
- What is compared is the score by the rule of the released code, where the runs logged that, else J(T). The paper's C-CHAIN,
  weight clipping and L2 Init are the best of several strengths in Gym Control and ProcGen, those here have the shipped one."""

SIGN_WORDS = """\
Does C-CHAIN beat Vanilla, as in the paper? The interval is Welch's, of the difference of two means; with two seeds it is
very wide. The effect size is Hedges' g: the difference in standard deviations between seeds. A method with a single seed has
no standard deviation: there is neither interval nor effect size, and the sign may be chance. The paper's are computed from its
means and standard errors."""


def first_sight(suite: str, cells: Cells, results: Sequence[Result], paper: Table, budget: str) -> list[str]:
    """
    :param suite: Name of the suite
    :param cells: Its cells
    :param results: Its runs
    :param paper: The paper's table
    :param budget: Name of the budget
    :return: Paragraphs
    """
    labels = {method: method_label(suite, method) for method in paper.methods}
    cchain = cchain_line(cells)
    wanted = {key: figure for key, figure in paper.figures.items() if key[0] != AGGREGATE}
    counts = Counter(
        verdict(cells[key], figure, paper.lengths[key[0]]) if key in cells else MISSING for key, figure in wanted.items()
    )
    parts = [
        f"**{SUITES[suite].title}**. Of the paper's {len(wanted)} cells {counts[AGREES]} agree, {counts[DISAGREES]} disagree, "
        f"{counts[TOO_FEW]} have not enough runs, {counts[MISSING]} have no run.",
        verdicts_table(cells, paper, labels),
    ]
    if any({(env_id, "vanilla"), (env_id, cchain)} <= set(cells) for env_id in paper.lengths):
        parts += [SIGN_WORDS, signs_table(cells, paper, cchain, table_digits(paper))]
        if cchain != "cchain":
            parts.append(f"C-CHAIN is here {method_label(suite, cchain)}: there are no runs with the shipped β.")
    return [
        *parts,
        "What was run on which versions:",
        versions_list(suite, results),
        *missing_section(suite, results, paper, budget),
    ]


def versions_list(suite: str, results: Sequence[Result]) -> str:
    """
    :param suite: Name of the suite
    :param results: Its runs
    :return: For each set of versions its runs
    """
    by_versions: dict[str, list[Result]] = {}
    for result in results:
        by_versions.setdefault(versions_text(result.versions), []).append(result)
    lines = []
    for versions, runs in by_versions.items():
        methods: dict[str, list[str]] = {}
        for env_id in dict.fromkeys(run.env_id for run in runs):
            there = lines_in_order(run.line for run in runs if run.env_id == env_id)
            methods.setdefault(", ".join(method_label(suite, line) for line in there), []).append(short_name(env_id))
        words = "; ".join(f"{', '.join(names)}: {there}" for there, names in methods.items())
        lines.append(f"- {len(runs)} runs with {escaped(versions)} ({words})")
    return "\n".join(lines)


def missing_runs(
    suite: str, results: Sequence[Result], paper: Table, budget: str, lines: Sequence[str] | None = None
) -> list[Run]:
    """
    :param suite: Name of the suite
    :param results: Its runs
    :param paper: The paper's table
    :param budget: One of ``BUDGETS``
    :param lines: Methods, also with another strength; by default those of the paper's table
    :return: Those of their runs that are not there
    """
    done = {(run.env_id, run.line, run.seed) for run in results}
    return [
        Run(suite, env_id, split_line(line)[0], seed, *budget_length(suite, length, budget), budget, variant=line)
        for env_id, length in paper.lengths.items()
        for line in lines or paper.methods
        for seed in range(N_SEEDS.get(budget, paper.n_seeds))
        if (env_id, line, seed) not in done
    ]


def not_run(suite: str, paper: Table, budget: str) -> list[str]:
    """
    :param suite: Name of a suite without any run
    :param paper: The paper's table
    :param budget: Name of the budget
    :return: What its runs take, and the command that makes them; nothing of budgets other than ``BUDGETS``
    """
    section = missing_section(suite, [], paper, budget)
    return [f"**{SUITES[suite].title}**: no run of this budget.", *section] if section else []


def missing_section(suite: str, results: Sequence[Result], paper: Table, budget: str) -> list[str]:
    """
    :param suite: Name of the suite
    :param results: Its runs
    :param paper: The paper's table
    :param budget: Name of the budget; nothing is known of others than ``BUDGETS``
    :return: What is missing, what it takes, and the commands that make it
    """
    if budget not in BUDGETS:
        return []
    rates = Rates(results)
    missing = missing_runs(suite, results, paper, budget)
    by_cell: dict[tuple[str, str], list[float]] = {}
    for run in missing:
        by_cell.setdefault((run.env_id, run.line), []).append(rates.seconds(run) / 3600)
    rows = [
        [code(env_id), *(_hours(by_cell.get((env_id, method), [])) for method in paper.methods)] for env_id in paper.lengths
    ]
    command = f"python -m benchmarks.run --suite {suite} --budget {budget}"
    lines = [f"{command}    # all of them"]
    if missing:
        lines.append(f"{command} --env {missing[0].env_id} --method {missing[0].method}    # one cell")
    parts = [
        f"Missing of the budget's {N_SEEDS.get(budget, paper.n_seeds)} seeds: {len(missing)} runs, "
        f"{sum(map(sum, by_cell.values())):,.1f} core-hours, by the rates of the runs that are there, and where there are "
        "none by those of `benchmarks/grid/suites.py`."
    ]
    if missing and results:
        parts.append(markdown_table(["core-hours", *map(code, paper.methods)], rows))
    for method in paper.methods:
        if others := other_strengths(suite, method):
            hours = sum(map(rates.seconds, missing_runs(suite, results, paper, budget, others))) / 3600
            lines.append(f"{command} --method {' '.join(others)}    # for the best of several: {hours:,.1f} core-hours")
    if budget != "paper":
        whole = [
            Run(suite, env_id, method, 0, *length, "paper")
            for env_id, length in paper.lengths.items()
            for method in paper.methods
        ]
        hours = ENOUGH_SEEDS * sum(map(rates.seconds, whole)) / 3600
        command = f"python -m benchmarks.run --suite {suite} --budget paper --seeds {' '.join(map(str, range(ENOUGH_SEEDS)))}"
        lines.append(f"{command}    # for verdicts: {hours:,.0f} core-hours in all")
    return [*parts, "```bash\n" + "\n".join(lines) + "\n```"]


def other_strengths(suite: str, method: str) -> list[str]:
    """
    :param suite: Name of the suite
    :param method: Name of a method
    :return: The method with each of the paper's strengths but the shipped one
    """
    strengths = paper_strengths(suite, method)
    if not strengths:
        return []
    shipped = strength_of(Run(suite, SUITES[suite].env_ids[0], method, 0, 1, 1, "paper"))
    return [f"{method}@{strength}" for strength in strengths if strength != shipped]


def _hours(hours: Sequence[float]) -> str:
    """Core-hours of a cell, and of how many runs."""
    return f"{sum(hours):.1f} ({len(hours)} seed{'s' if len(hours) > 1 else ''})" if hours else "done"
