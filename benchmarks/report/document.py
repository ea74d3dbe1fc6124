"""The report: sections of a suite, and the page as a whole."""

import shlex
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from benchmarks.grid.results import Result
from benchmarks.grid.run import (
    as_json,
    lines_in_order,
    other_strength,
    paper_methods,
    shipped_hyperparameters,
    short_name,
    suite_lines,
    suite_methods,
)
from benchmarks.grid.suites import SUITES
from benchmarks.number_text import with_error
from benchmarks.report.best_of import WORDS as BEST_WORDS
from benchmarks.report.best_of import Best, best_strengths, best_table, write_best
from benchmarks.report.cells import Cells, make_cells
from benchmarks.report.continual_table import WORDS as CONTINUAL_WORDS
from benchmarks.report.continual_table import continual_table
from benchmarks.report.estimates import mean_and_error
from benchmarks.report.figures import plot_learning_curves, plot_quantities
from benchmarks.report.first_sight import WORDS as FIRST_SIGHT
from benchmarks.report.first_sight import first_sight, not_run
from benchmarks.report.markdown import code, escaped, markdown_table
from benchmarks.report.page import html_page
from benchmarks.report.paper import Table, read_tables
from benchmarks.report.pictures import Pictures
from benchmarks.report.quantities import NTK
from benchmarks.report.reliable import reliable_section
from benchmarks.report.tables import (
    lengths_table,
    mark_differences,
    method_label,
    results_table,
    table_digits,
    table_methods,
)
from benchmarks.report.task_tables import MISSING, quantities_table, returns_header, returns_rows, seeds_text
from benchmarks.report.verdicts import verdict_words

# Methods in a picture beside the base algorithm, where the paper does not compare them: more curves cannot be told apart
METHODS_BESIDE = 5

INTRODUCTION = """# The paper's tables, reproduced: budget {budget}

The numbers of this page are made from {n_runs} finished runs{seeds}, beside those printed in *Mitigating Plasticity Loss in
Continual Reinforcement Learning by Reducing Churn* (Tang et al., ICML 2025). All finished runs of this budget in
the results folder are included; the runs of a cell differ in their seed alone. The hyperparameters are those shipped when
the runs were made; the `run.json` of each run has them.

{suites}"""

READING = """\
## How to read the tables

- **J(T)**, what the cells hold, is the average return over the whole of learning, not that of the final policy: the mean
  return of the episodes that ended in a rollout (in MinAtar: of ten greedy episodes of an evaluation), mean over the
  rollouts of a task in which any ended, mean over the tasks (Eq. 1 of the paper). Greater is better. Where the released code
  of the paper scores runs by another rule, that score stands beside J(T), below each suite's table, and the verdicts go by
  it.
- **±** is the standard error of the mean over the seeds: their standard deviation (with n - 1) over √n.
- The **95 % interval** is a percentile bootstrap of the mean over the seeds, 10,000 resamples. With three seeds or fewer it
  reaches from the lowest seed to the highest, and holds the true mean less often than its name says: of three seeds, in
  about three cases of four.
- **✓** and **✗** are the verdicts of the first section; a cell with neither has not enough runs for one.
- In Gym Control and ProcGen the **paper's coefficients are tuned**: of C-CHAIN's β, weight clipping's κ and L2 Init's c it
  reports the best of 3, 4 and 5 values in each environment. The columns with a method's plain name have the shipped ones, one
  of each for a whole suite, and not chosen by the runs that the tables show. They stand below each suite's table. With runs of
  several there is a table of the best, which is marked as that.
- **Bold** is the best mean, <ins>underlined</ins> the second, without the Oracle, and no second of two methods, as the paper
  marks; of a single method nothing is marked. Marks go by the numbers, in the paper's rows too, and among the cells that are
  there.
- **{missing}** is missing: no finished run, or not in the paper. Nothing is filled in. *seeds* lists all that finished.
- The **aggregate** is the sum of the environments' means, as the paper's "Agg. Score"; missing unless all of them are there.
- *PPO*, in MinAtar *Double DQN*, is what the paper calls Vanilla. *Oracle* starts each task with fresh networks.
- **†** the seeds of the cell were not all run with the same versions of the packages; a note below the table says which. The
  commits of this repository that the runs were made at are listed at the end."""


RELEASED_WORDS = """\
{rule}

Both scores, of the cells all of whose runs logged what it takes. The verdicts go by this rule where all runs of a cell have
it. Where several cells are compared, all of them must have it; a column of the table, or the text, says which rule that is.
The other tables of this page have J(T)."""

NTK_WORDS = """\
Of the gradients of the policy objective on the minibatches of a rollout (Appendix B of the paper): srank is the number of
singular values that hold 99 % of their sum; the sums are those of the absolute values off and on the diagonal. In the table,
means over the logs of a task and over the seeds. In the pictures, a line for each seed (solid, dashed, dotted), or of more
than three seeds their mean (of the logarithms, for the sums) with a band of ± one standard error."""


def write_report(results: Sequence[Result], experiment: str, folder: Path, left_out: Sequence[str] = ()) -> list[str]:
    """
    Write ``report.md``, its pictures and ``report.html``.

    :param results: Finished runs of one experiment
    :param experiment: Its name: the budget
    :param folder: Where the report goes
    :param left_out: Runs that cannot be read, and why, in one line each
    :return: These and further runs that are left out, and why
    :raises ValueError: When runs are not comparable (:func:`benchmarks.report.cells.make_cells`)
    """
    tables = read_tables()
    by_suite: dict[str, list[Result]] = {suite: [] for suite in tables}
    left_out = list(left_out)
    for result in results:
        if result.suite not in tables or result.env_id not in tables[result.suite].lengths:
            left_out.append(f"{result.path}: the paper has no {result.env_id} in {result.suite}")
        elif (result.variant is not None or result.overrides) and not other_strength(result):
            left_out.append(f"{result.path}: not under the shipped hyperparameters, but with {', '.join(result.overrides)}")
        else:
            by_suite[result.suite].append(result)
    results = [result for runs in by_suite.values() for result in runs]
    if not results:
        raise ValueError("; ".join(["No run is left for the report", *left_out]))
    pictures = Pictures(folder)
    titles = {suite: SUITES[suite].title for suite in by_suite}
    contents = [f"- [{titles[suite]}](#{titles[suite].lower().replace(' ', '-')})" for suite, runs in by_suite.items() if runs]
    if missing := [titles[suite] for suite, runs in by_suite.items() if not runs]:
        contents.append(f"- Not run: {', '.join(missing)}.")
    n_seeds = len({result.seed for result in results})
    introduction = INTRODUCTION.format(
        budget=code(experiment),
        n_runs=len(results),
        seeds=f" of {n_seeds} seeds" if n_seeds > 1 else " of a single seed",
        suites="\n".join(contents),
    )
    cells_of = {suite: make_cells(runs) for suite, runs in by_suite.items() if runs}
    found = {suite: best_strengths(suite, cells, list(tables[suite].lengths)) for suite, (cells, _) in cells_of.items()}
    write_best([best for bests in found.values() for best in bests], folder / "best_of.csv")
    sight = [
        part
        for suite, (cells, _) in cells_of.items()
        for part in first_sight(suite, cells, by_suite[suite], tables[suite], experiment)
    ]
    sight += [part for suite, runs in by_suite.items() if not runs for part in not_run(suite, tables[suite], experiment)]
    sections = [
        _suite_section(suite, by_suite[suite], *cells_of[suite], found[suite], tables[suite], pictures) for suite in cells_of
    ]
    parts = [introduction, FIRST_SIGHT, *sight, READING.format(missing=MISSING), *sections]
    markdown = "\n\n".join([*parts, _runs_section(results, experiment, left_out)]) + "\n"
    (folder / "report.md").write_text(markdown)
    (folder / "report.html").write_text(html_page(markdown, pictures.drawn))
    return left_out


def _suite_section(
    suite: str,
    results: Sequence[Result],
    cells: Cells,
    left_out: Sequence[str],
    found: Sequence[Best],
    paper: Table,
    pictures: Pictures,
) -> str:
    """The section of a suite."""
    parts = [f"## {SUITES[suite].title}", lengths_table(results, paper), results_table(suite, cells, paper)]
    parts += _notes(suite, cells, paper, left_out)
    if marks := mark_differences(suite, paper):
        parts.append("Where the paper's own marks or sums do not follow from its numbers:\n\n" + "\n".join(marks))
    parts += _hyperparameters_section(suite, results, paper)
    parts += _released_section(suite, cells, paper)
    if found:
        parts += ["### Best of several strengths", BEST_WORDS, best_table(found, paper)]
    parts += reliable_section(suite, cells, paper, pictures)
    parts += _curves_section(suite, results, paper, pictures)
    parts += _continual_section(suite, results, paper)
    parts += _ntk_section(suite, results, paper, pictures)
    return "\n\n".join(parts)


def _notes(suite: str, cells: Cells, paper: Table, left_out: Sequence[str]) -> list[str]:
    """What readers should know about the cells."""
    notes = []
    different = [
        f"- † {short_name(env_id)}, {method_label(suite, method)}: "
        + "; ".join(f"seeds {seeds_text(seeds)} with {escaped(versions)}" for versions, seeds in cell.versions)
        for (env_id, method), cell in cells.items()
        if len(cell.versions) > 1
    ]
    if different:
        notes.append("\n".join(different))
    if any("@" in line for _, line in cells):
        notes.append(
            "Columns with β =, κ = or c = have the shipped hyperparameters but for that strength of the method. The paper has "
            "no cells of them: it prints the best of several under the method's name."
        )
    most = max((cell.seeds for cell in cells.values()), key=len, default=[])
    fewer: dict[str, list[str]] = {}
    for (env_id, method), cell in cells.items():
        if len(cell.seeds) < len(most):
            fewer.setdefault(seeds_text(cell.seeds), []).append(f"{short_name(env_id)} {method_label(suite, method)}")
    if fewer:
        lines = "\n".join(f"- {seeds} alone: {', '.join(names)}" for seeds, names in fewer.items())
        notes.append(f"Not all of the seeds {seeds_text(most)} finished, because time ran out or they failed:\n\n{lines}")
    if left_out:
        notes.append(
            "Left out, because their J(T) is not defined:\n\n" + "\n".join(f"- {escaped(reason)}" for reason in left_out)
        )
    return notes


def _released_section(suite: str, cells: Cells, paper: Table) -> list[str]:
    """J(T) by both rules, of the cells whose runs logged that of the released code."""
    digits = table_digits(paper)
    rows, without = [], []
    for env_id, length in paper.lengths.items():
        for method in table_methods(cells, paper):
            cell, figure = cells.get((env_id, method)), paper.figures.get((env_id, method))
            if cell is None:
                continue
            name = f"{short_name(env_id)}, {method_label(suite, method)}"
            if cell.released_scores is None:
                without.append(name)
                continue
            both = [with_error(*mean_and_error(scores), digits) for scores in (cell.scores, cell.released_scores)]
            printed = [MISSING, MISSING]
            if figure is not None:
                printed = [with_error(figure.mean, figure.standard_error, digits), verdict_words(cell, figure, length)]
            rows.append([name, seeds_text(cell.seeds), *both, *printed])
    score = SUITES[suite].score
    if score is None or not rows:
        return []
    header = ["", "seeds", "J(T)", "by the released code", "paper", "verdict, by the released code"]
    words = RELEASED_WORDS.format(rule=score.words)
    parts = ["### By the rule of the released code", words, markdown_table(header, rows)]
    return [*parts, f"Without it: {'; '.join(without)}."] if without else parts


def _hyperparameters_section(suite: str, results: Sequence[Result], paper: Table) -> list[str]:
    """How each method's settings differ from Vanilla's, and which runs had other hyperparameters than are shipped now."""
    methods = suite_methods(suite)
    differences: dict[tuple[str, str], list[str]] = {}
    for env_id, runs in _by_env(results, paper).items():
        shipped = as_json(shipped_hyperparameters(methods["vanilla"].algo, env_id) or {})
        # What is shipped now may differ from what the runs had
        vanilla = next((run.hyperparameters for run in runs if run.method == "vanilla"), shipped)
        shown = {run.line: {**run.hyperparameters, **other_strength(run)} for run in runs if run.method != "vanilla"}
        for method, hyperparameters in shown.items():
            differing = [code(f"{name}: {value}") for name, value in hyperparameters.items() if vanilla.get(name) != value]
            key = method_label(suite, method), ", ".join(differing) or "not in the settings"
            differences.setdefault(key, []).append(short_name(env_id))
    lines = [f"- {label} ({', '.join(names)}): {differing}" for (label, differing), names in differences.items()]
    parts = [
        "### Hyperparameters",
        f"How the settings of each method differ from {method_label(suite, 'vanilla')}'s:",
        "\n".join(lines) if lines else "Nothing else was run.",
    ]
    others = [
        f"- {short_name(result.env_id)}, {method_label(suite, result.line)}, seed {result.seed}"
        for result in results
        if result.hyperparameters != as_json(shipped_hyperparameters(result.algo, result.env_id))
    ]
    if others:
        parts += ["**Made with other hyperparameters than are shipped now:**", "\n".join(others)]
    return parts


def _curves_section(suite: str, results: Sequence[Result], paper: Table, pictures: Pictures) -> list[str]:
    """Learning curves of each environment."""
    lines = suite_lines(suite, (result.line for result in results))
    window = SUITES[suite].smoothing
    smooth = f", which is a running mean over {window} rollouts within a task" if window > 1 else ""
    parts = [
        "### Learning curves",
        f"A line for each seed (solid, dashed, dotted){smooth}; of more than three seeds of a method, their mean with a band "
        "of ± one standard error. The methods that the paper compares come first, then the others, a few at a time beside the "
        "base algorithm. Vertical lines are the task switches. Below, J(T_i) of each run and task: J(T) is their mean.",
    ]
    for env_id, runs in _by_env(results, paper).items():
        parts.append(f"{short_name(env_id)}:")
        for number, shown in enumerate(_distinguishable(runs), start=1):
            name = f"curves_{env_id.replace('/', '-')}" + (f"_{number}" if number > 1 else "")
            path, picture = pictures.add(name, f"Learning curves in {short_name(env_id)}")
            plot_learning_curves(shown, path, lines)
            parts.append(picture)
        parts.append(markdown_table(returns_header(runs[0].task_names), returns_rows(runs, lines, table_digits(paper))))
    return parts


def _distinguishable(results: Sequence[Result]) -> list[list[Result]]:
    """The runs of each picture: of the paper's methods, then of the others, a few at a time beside the base algorithm."""
    suite = results[0].suite
    compared = set(paper_methods(suite))
    others = [name for name in suite_methods(suite) if name not in compared and any(run.method == name for run in results)]
    groups = [compared]
    groups += [{"vanilla", *others[start : start + METHODS_BESIDE]} for start in range(0, len(others), METHODS_BESIDE)]
    return [shown for group in groups if (shown := [result for result in results if result.method in group])]


def _continual_section(suite: str, results: Sequence[Result], paper: Table) -> list[str]:
    """Plasticity, transfer, recovery and forgetting."""
    lines = suite_lines(suite, (result.line for result in results))
    parts = ["### Plasticity, transfer, recovery", CONTINUAL_WORDS]
    for env_id, runs in _by_env(results, paper).items():
        table = continual_table(runs, lines, table_digits(paper), SUITES[suite].own_scales)
        parts += [f"{short_name(env_id)}:", table]
    return parts


def _ntk_section(suite: str, results: Sequence[Result], paper: Table, pictures: Pictures) -> list[str]:
    """The neural tangent kernel, of the runs that logged it."""
    lines = suite_lines(suite, (result.line for result in results))
    logged = [result for result in results if NTK[0].name in result.metrics]
    if not logged:
        return []
    parts = [
        "### Neural tangent kernel",
        NTK_WORDS,
    ]
    for env_id, runs in _by_env(logged, paper).items():
        path, picture = pictures.add(f"ntk_{env_id.replace('/', '-')}", f"NTK in {short_name(env_id)}")
        plot_quantities(runs, path, lines, NTK)
        parts += [f"{short_name(env_id)}:", quantities_table(runs, lines, NTK), picture]
    return parts


def _by_env(results: Sequence[Result], paper: Table) -> dict[str, list[Result]]:
    by_env = {env_id: [result for result in results if result.env_id == env_id] for env_id in paper.lengths}
    return {env_id: runs for env_id, runs in by_env.items() if runs}


def _runs_section(results: Sequence[Result], experiment: str, left_out: Sequence[str]) -> str:
    """How the runs were made, and which were left out."""
    hours = sum(result.seconds for result in results) / 3600
    commits = Counter(result.git_commit or "no checkout" for result in results)
    counted = [f"- {n} runs at {escaped(name)}" for name, n in commits.items()]
    budget = shlex.quote(" ".join(experiment.split()))
    commands = []
    for (suite, seeds, methods), env_ids in _same_runs(results).items():
        options = f"--env {' '.join(env_ids)} --method {' '.join(methods)} --seeds {' '.join(map(str, seeds))}"
        commands.append(f"python -m benchmarks.run --suite {suite} --budget {budget} {options}")
    commands.append(f"python -m benchmarks.report --budget {budget}")
    parts = [
        "## The runs",
        f"{len(results)} runs, {hours:.1f} hours of them in total. The `run.json` of each holds its command, "
        "versions and commit, too.",
        "\n".join(counted),
        "These commands make the runs of this page, and the page:",
        "```bash\n" + "\n".join(commands) + "\n```",
    ]
    if left_out:
        parts += ["These are left out:", "\n".join(f"- {escaped(reason)}" for reason in left_out)]
    return "\n\n".join(parts)


def _same_runs(results: Sequence[Result]) -> dict[tuple[str, tuple[int, ...], tuple[str, ...]], list[str]]:
    """By suite, seeds and methods, the environments that have just these methods with these seeds."""
    seeds: dict[tuple[str, str, str], list[int]] = {}
    for run in results:
        seeds.setdefault((run.suite, run.env_id, run.line), []).append(run.seed)
    by_seeds: dict[tuple[str, str, tuple[int, ...]], list[str]] = {}
    for (suite, env_id, line), with_line in seeds.items():
        by_seeds.setdefault((suite, env_id, tuple(sorted(with_line))), []).append(line)
    env_ids: dict[tuple[str, tuple[int, ...], tuple[str, ...]], list[str]] = {}
    for (suite, env_id, same), lines in by_seeds.items():
        env_ids.setdefault((suite, same, tuple(lines_in_order(lines))), []).append(env_id)
    return env_ids
