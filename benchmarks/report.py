"""
What the runs of a budget say beside the paper's numbers: tables, learning curves, rliable's metrics and NTK figures, as
``report.md`` with pictures and as ``report.html``, one page that needs nothing beside it.

    python -m benchmarks.report --budget reduced
"""

import argparse
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.cells import Cells, cells_of, in_words
from benchmarks.curves import LABELS
from benchmarks.estimates import METRICS, agrees, normalized, probability_of_improvement, reliable_metrics
from benchmarks.figures import plot_learning_curves, plot_ntk, plot_reliable_metrics
from benchmarks.markdown import markdown_table
from benchmarks.page import html_page
from benchmarks.paper import AGGREGATE, Table, read_tables
from benchmarks.quantities import NTK
from benchmarks.results import METHODS, Result, in_json, read_results
from benchmarks.runs import shipped_hyperparameters
from benchmarks.suites import SUITES
from benchmarks.tables import (
    MISSING,
    digits_of,
    label_of,
    lengths_table,
    listed,
    mark_differences,
    methods_of,
    name_of,
    ntk_table,
    results_table,
    score_matrices,
    tasks_table,
)

TITLES = {
    "gym_control": "Continual Gym Control",
    "procgen": "Continual ProcGen",
    "dmc": "Continual DeepMind Control",
    "minatar": "Continual MinAtar",
}
PICTURES = "pictures"

INTRODUCTION = """# The paper's tables, reproduced: budget `{budget}`

The numbers of this page are made from {n_runs} finished runs{seeds}, beside those printed in *Mitigating Plasticity Loss in
Continual Reinforcement Learning by Reducing Churn* (Tang et al., ICML 2025). Every finished run of this budget that is in
the folder of results is in; the runs of a cell differ in their seed alone. The hyperparameters are those shipped at the
time, which the `run.json` of each run holds.

{suites}

## How to read the tables

- **J(T)**, what the cells hold, is the average return over the whole of learning, not that of the final policy: the mean
  return of the episodes that ended in a rollout (in MinAtar: of ten greedy episodes of an evaluation), mean over the
  rollouts of a task in which any ended, mean over the tasks (Eq. 1 of the paper). Greater is better. In DeepMind Control,
  too, the episodes are those of training, where the paper evaluates every 20,000 steps.
- **±** is the standard error of the mean over the seeds: their standard deviation (with n - 1) over √n.
- The **95 % interval** is a percentile bootstrap of the mean over the seeds, 10,000 resamples. With three seeds or fewer it
  reaches from the lowest seed to the highest, and holds the true mean less often than its name says: of three seeds, in
  about three cases of four.
- **✓** the cell agrees with the paper: the interval overlaps the paper's mean ± 2 standard errors. **✗** it does not.
  Overlap is a mild test; wide intervals agree easily. A single seed has no ±, no interval and neither sign. Between runs of
  different lengths neither sign says much.
- In Gym Control and ProcGen the **paper's coefficients are tuned**: of C-CHAIN's β, weight clipping's κ and L2 Init's c it
  reports the best of 3, 4 and 5 values in each environment. Those here are the shipped ones, one of each for a whole suite,
  and not chosen by the runs that the tables show. They stand below each suite's table.
- **Bold** is the best mean, <ins>underlined</ins> the second, without the Oracle, and no second of two methods, as the paper
  marks; of a single method nothing is marked. Marks go by the numbers, in the paper's rows too, and among the cells that are
  there.
- **{missing}** is missing: no finished run, or not in the paper. Nothing is filled in. *seeds* are all that finished.
- The **aggregate** is the sum of the environments' means, as the paper's "Agg. Score"; missing unless all of them are there.
- *PPO*, in MinAtar *Double DQN*, is what the paper calls Vanilla. *Oracle* starts anew at each task.
- **†** the seeds of the cell were not all run with the same versions of the packages; which is said below the table. The
  commits of this repository that the runs were made at are listed at the end."""


NORMALIZATION = """\
Scores are J(T), normalised in each environment so that 0 is the lowest and 1 the highest of the paper's means of all its
methods, the Oracle among them: a scale that the runs here do not move. (From the paper's Vanilla to its Oracle is no scale:
they lie too close together in Leaper, and the other way round in Quadruped.) The optimality gap is what is missing to 1, on
average, scores above counting as 1: less is better. In brackets the 95 % interval, bootstrapped over seeds within each
environment. An environment in which the paper's means lie close together, as in Leaper, moves the mean more than others do,
and the IQM less."""

IMPROVEMENT = """\
The probability of improvement is that a run of C-CHAIN has a higher J(T) than one of the other method, mean over the
environments; 0.5 says nothing either way. Beside it, in how many environments C-CHAIN's mean is the higher one, of the seeds
of the table above."""

NTK_WORDS = """\
Of the gradients of the policy objective on the minibatches of a rollout (Appendix B of the paper): srank is the number of
singular values that hold 99 % of their sum; the sums are those of the absolute values off and on the diagonal. In the table,
means over the logs of a task and over the seeds. In the pictures, the mean over the seeds (of the logarithms, for the sums)
with a band of ± one standard error."""


def write_report(results: Sequence[Result], budget: str, folder: Path) -> None:
    """
    Write ``report.md``, its pictures and ``report.html``.

    :param results: Finished runs of one budget
    :param budget: Its name
    :param folder: Where they go
    :raises ValueError: When runs are not comparable (:func:`benchmarks.cells.cells_of`), or of an environment that the paper
        does not have
    """
    tables = read_tables()
    for result in results:
        if result.suite not in tables or result.env_id not in tables[result.suite].lengths:
            raise ValueError(f"The paper has no {result.env_id} in suite {result.suite!r}: {result.path}")
    (folder / PICTURES).mkdir(parents=True, exist_ok=True)
    by_suite = {suite: [result for result in results if result.suite == suite] for suite in tables}
    sections = [_suite_section(suite, runs, tables[suite], folder) for suite, runs in by_suite.items() if runs]
    without = [TITLES[suite] for suite, runs in by_suite.items() if not runs]
    suites = [f"- [{TITLES[suite]}](#{TITLES[suite].lower().replace(' ', '-')})" for suite, runs in by_suite.items() if runs]
    if without:
        suites.append(f"- Not run: {', '.join(without)}.")
    n_seeds = len({result.seed for result in results})
    introduction = INTRODUCTION.format(
        budget=budget,
        n_runs=len(results),
        seeds=f" of {n_seeds} seeds" if n_seeds > 1 else " of a single seed",
        suites="\n".join(suites),
        missing=MISSING,
    )
    markdown = "\n\n".join([introduction, *sections, _runs_section(results, budget)]) + "\n"
    (folder / "report.md").write_text(markdown)
    (folder / "report.html").write_text(html_page(markdown, folder))


def _suite_section(suite: str, results: Sequence[Result], paper: Table, folder: Path) -> str:
    """All that is said of a suite."""
    cells, left_out = cells_of(results)
    parts = [f"## {TITLES[suite]}", lengths_table(results, paper), results_table(suite, cells, paper)]
    parts += _notes(suite, cells, paper, left_out)
    if marks := mark_differences(suite, paper):
        parts.append("Where the paper's own marks or sums are not those of its numbers:\n\n" + "\n".join(marks))
    parts += _hyperparameters_section(suite, results, paper)
    parts += _reliable_section(suite, cells, paper, folder)
    parts += _curves_section(suite, results, paper, folder)
    parts += _ntk_section(suite, results, paper, folder)
    return "\n\n".join(parts)


def _notes(suite: str, cells: Cells, paper: Table, left_out: Sequence[str]) -> list[str]:
    """How much there is and how much of it agrees, and what is peculiar in it."""
    wanted = {key: figure for key, figure in paper.figures.items() if key[0] != AGGREGATE}
    there = {key: cells[key].interval for key in wanted if key in cells}
    tested = {key: interval for key, interval in there.items() if interval is not None}
    n_agree = sum(agrees(interval, wanted[key].mean, wanted[key].standard_error) for key, interval in tested.items())
    notes = [
        f"{len(there)} of the paper's {len(wanted)} cells have runs. Of the {len(tested)} with more than one seed, "
        f"{n_agree} agree with the paper."
    ]
    different = [
        f"- † {name_of(env_id)}, {label_of(suite, method)}: "
        + "; ".join(f"seeds {listed(seeds)} with {versions}" for versions, seeds in cell.versions)
        for (env_id, method), cell in cells.items()
        if len(cell.versions) > 1
    ]
    if different:
        notes.append("\n".join(different))
    most = max((cell.seeds for cell in cells.values()), key=len, default=[])
    fewer: dict[str, list[str]] = {}
    for (env_id, method), cell in cells.items():
        if len(cell.seeds) < len(most):
            fewer.setdefault(listed(cell.seeds), []).append(f"{name_of(env_id)} {label_of(suite, method)}")
    if fewer:
        lines = "\n".join(f"- {seeds} alone: {', '.join(names)}" for seeds, names in fewer.items())
        notes.append(f"Not all of the seeds {listed(most)} finished, for want of time or because they failed:\n\n{lines}")
    if left_out:
        notes.append("Left out, as their J(T) is not defined:\n\n" + "\n".join(f"- {reason}" for reason in left_out))
    return notes


def _hyperparameters_section(suite: str, results: Sequence[Result], paper: Table) -> list[str]:
    """What makes a method of Vanilla, as the runs had it; and which had other hyperparameters than are shipped now."""
    differences: dict[tuple[str, str], list[str]] = {}
    for env_id, runs in _by_env(results, paper).items():
        vanilla = in_json(shipped_hyperparameters(SUITES[suite].methods["vanilla"], env_id))
        for method, hyperparameters in {run.method: run.hyperparameters for run in runs if run.method != "vanilla"}.items():
            differing = [f"`{name}: {value}`" for name, value in hyperparameters.items() if vanilla.get(name) != value]
            key = label_of(suite, method), ", ".join(differing) or "nothing in the settings"
            differences.setdefault(key, []).append(name_of(env_id))
    lines = [f"- {label} ({', '.join(names)}): {differing}" for (label, differing), names in differences.items()]
    parts = [
        "### Hyperparameters",
        f"What the settings of each method have beside {label_of(suite, 'vanilla')}'s, or instead:",
        "\n".join(lines) if lines else "Nothing else was run.",
    ]
    others = [
        f"- {name_of(result.env_id)}, {label_of(suite, result.method)}, seed {result.seed}"
        for result in results
        if result.hyperparameters != in_json(shipped_hyperparameters(result.algo, result.env_id))
    ]
    if others:
        parts += ["**Not under the hyperparameters that are shipped now:**", "\n".join(others)]
    return parts


def _reliable_section(suite: str, cells: Cells, paper: Table, folder: Path) -> list[str]:
    """rliable's metrics over the environments."""
    env_ids, scores, seeds = score_matrices(cells, paper)
    if not {"vanilla", "cchain"} <= set(scores):
        return []
    low, high = (np.array([end(paper.means(env_id).values()) for env_id in env_ids]) for end in (min, max))
    algos = {method: SUITES[suite].methods[method] for method in scores}
    estimates, intervals = reliable_metrics({method: normalized(of_method, low, high) for method, of_method in scores.items()})
    several = [method for method in scores if len(seeds[method]) > 1]

    rows = []
    for method, of_method in estimates.items():
        figures = [f"{estimate:.2f}" for estimate in of_method]
        if method in several:
            figures = [f"{figure} [{lo:.2f}, {hi:.2f}]" for figure, lo, hi in zip(figures, *intervals[method], strict=True)]
        rows.append([LABELS[algos[method]], listed(seeds[method]), *figures])
    without = [label_of(suite, method) for method in methods_of(cells, paper) if method not in scores]
    words = [
        f"Over {', '.join(map(name_of, env_ids))}, where Vanilla and C-CHAIN both have runs. "
        + (f"Left out, as they do not have runs in all of them: {', '.join(without)}. " if without else "")
        + NORMALIZATION
    ]
    picture = f"{PICTURES}/metrics_{suite}.png"
    if several:
        plot_reliable_metrics(
            {method: estimates[method] for method in several},
            intervals,
            {method: algos[method] for method in several},
            folder / picture,
        )
    header = ["method", "seeds", *METRICS]
    return [
        "### Over the environments",
        *words,
        markdown_table(header, rows),
        *([f"![Metrics over the environments of {TITLES[suite]}]({picture})"] if several else []),
        *_improvement(suite, env_ids, scores, several, paper),
    ]


def _improvement(
    suite: str, env_ids: Sequence[str], scores: Mapping[str, np.ndarray], several: Sequence[str], paper: Table
) -> list[str]:
    """C-CHAIN against each other method."""
    rows = []
    for method, (probability, interval) in probability_of_improvement(scores, "cchain").items():
        text = f"{probability:.2f}"
        if method in several and "cchain" in several:
            text += f" [{interval[0]:.2f}, {interval[1]:.2f}]"
        higher = int((scores["cchain"].mean(axis=0) > scores[method].mean(axis=0)).sum())
        of_paper = MISSING
        if method in paper.methods:
            means = [paper.means(env_id) for env_id in env_ids]
            of_paper = f"{sum(mean['cchain'] > mean[method] for mean in means)} of {len(env_ids)}"
        rows.append([label_of(suite, method), text, f"{higher} of {len(env_ids)}", of_paper])
    header = ["C-CHAIN over", "probability of improvement", "higher mean, here", "higher mean, paper"]
    return [
        IMPROVEMENT,
        markdown_table(header, rows),
    ]


def _curves_section(suite: str, results: Sequence[Result], paper: Table, folder: Path) -> list[str]:
    """Learning curves of each environment."""
    window = 1 if SUITES[suite].evaluates else 5
    smooth = f", a running mean over {window} rollouts within a task," if window > 1 else ""
    parts = [
        "### Learning curves",
        f"The mean{smooth} over all seeds of each method, with a band of ± one standard error; a single seed has no band. "
        "Dashed: the task switches. Below, J(T_i) of each run and task: J(T) is their mean.",
    ]
    for env_id, runs in _by_env(results, paper).items():
        picture = f"{PICTURES}/curves_{env_id.replace('/', '-')}.png"
        plot_learning_curves(runs, folder / picture, window, SUITES[suite].own_scales)
        parts += [
            f"{name_of(env_id)}:",
            f"![Learning curves in {name_of(env_id)}]({picture})",
            tasks_table(runs, digits_of(paper)),
        ]
    return parts


def _ntk_section(suite: str, results: Sequence[Result], paper: Table, folder: Path) -> list[str]:
    """The neural tangent kernel, of the runs that logged it."""
    logged = [result for result in results if NTK[0].name in result.metrics]
    if not logged:
        return []
    parts = [
        "### Neural tangent kernel",
        NTK_WORDS,
    ]
    for env_id, runs in _by_env(logged, paper).items():
        picture = f"{PICTURES}/ntk_{env_id.replace('/', '-')}.png"
        plot_ntk(runs, folder / picture)
        parts += [f"{name_of(env_id)}:", ntk_table(runs), f"![NTK in {name_of(env_id)}]({picture})"]
    return parts


def _by_env(results: Sequence[Result], paper: Table) -> dict[str, list[Result]]:
    by_env = {env_id: [result for result in results if result.env_id == env_id] for env_id in paper.lengths}
    return {env_id: runs for env_id, runs in by_env.items() if runs}


def _runs_section(results: Sequence[Result], budget: str) -> str:
    """How the runs were made."""
    hours = sum(result.seconds for result in results) / 3600
    versions = Counter(in_words(result.versions) for result in results)
    commits = Counter(result.git_commit or "no checkout" for result in results)
    counted = [f"- {n} runs with {name}" for name, n in versions.items()] + [
        f"- {n} runs at {name}" for name, n in commits.items()
    ]
    commands = []
    for suite in dict.fromkeys(result.suite for result in results):
        of_suite = [result for result in results if result.suite == suite]
        methods = " ".join(method for method in METHODS if any(result.method == method for result in of_suite))
        n_seeds = 1 + max(result.seed for result in of_suite)
        commands.append(f"python -m benchmarks.run --suite {suite} --budget {budget} --method {methods} --seeds {n_seeds}")
    commands.append(f"python -m benchmarks.report --budget {budget}")
    return "\n\n".join(
        [
            "## The runs",
            f"{len(results)} runs, {hours:.1f} hours of them in total. The `run.json` of each holds its command, "
            "versions and commit, too.",
            "\n".join(counted),
            "The same command makes those that are missing:",
            "```bash\n" + "\n".join(commands) + "\n```",
        ]
    )


def main() -> None:
    """Parse the command line, read, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results"), help="Folder of all results")
    parser.add_argument("--budget", default="reduced", help="Name of the budget")
    parser.add_argument("--output", type=Path, help="Folder of the report, by default the budget's in the results")
    args = parser.parse_args()

    try:
        results = read_results(args.results)
        of_budget = [result for result in results if result.budget == args.budget]
        if not of_budget:
            budgets = ", ".join(sorted({result.budget for result in results})) or "none"
            raise ValueError(f"no results of --budget {args.budget} in {args.results}; the budgets there: {budgets}")
        folder = args.output or args.results / args.budget
        write_report(of_budget, args.budget, folder)
    # Damaged results, too, or such as are not comparable
    except ValueError as error:
        parser.error(str(error))
    print(f"Written: {folder}/report.md, {folder}/report.html")


if __name__ == "__main__":
    main()
