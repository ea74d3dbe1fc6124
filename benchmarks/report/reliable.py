"""rliable's metrics over a suite's environments, normalised in two ways, and how often C-CHAIN is better."""

from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks.grid.run import short_name, suite_lines
from benchmarks.grid.suites import SUITES
from benchmarks.report.cells import RELEASED, Cells, common_rule
from benchmarks.report.estimates import METRICS, normalized, probability_of_improvement, reliable_metrics
from benchmarks.report.figures import plot_reliable_metrics
from benchmarks.report.markdown import markdown_table
from benchmarks.report.paper import Table
from benchmarks.report.pictures import Pictures
from benchmarks.report.tables import cchain_line, method_label, score_matrices, table_methods
from benchmarks.report.task_tables import MISSING, seeds_text

NORMALIZATION = """\
Scores are {scores}, normalised in each environment so that 0 is the lowest and 1 the highest of the paper's means of all its
methods, the Oracle among them: a scale that the runs here do not move. (The paper's Vanilla and Oracle would make no
scale: they are too close together in Leaper, and in the opposite order in Quadruped.) The optimality gap is what is missing
to 1, on average, scores above counting as 1: less is better. In brackets the 95 % interval, bootstrapped over seeds within
each environment. An environment in which the paper's means lie close together, as in Leaper, moves the mean more than others
do, and the IQM less."""

# Of fewer seeds the report says that the bootstrap's intervals are too narrow
BOOTSTRAP_SEEDS = 5

FEW_SEEDS = """\
In this section the intervals of fewer than five seeds, here those of {methods}, are too narrow: they hold the true value less
often than 95 % promises."""

IMPROVEMENT = """\
The probability of improvement is that a run of C-CHAIN has a higher score than one of the other method, mean over the
environments; 0.5 says nothing either way. Beside it, in how many environments C-CHAIN's mean is the higher one, of the seeds
of the table above."""

ORACLE_WORDS = """\
Normalised by the Oracle, as in the paper's figure: scores over the mean of {oracle} in that environment. The rows of the paper
are made from the means of its table, so they have neither seeds nor intervals, and no IQM, which is over runs."""

NO_ORACLE = """\
The paper's figure of these metrics normalises by the Oracle. In this suite that has no meaning: there is no Oracle whose
returns are greater than 0 in all environments."""


def reliable_section(suite: str, cells: Cells, paper: Table, pictures: Pictures) -> list[str]:
    """
    :param suite: Name of the suite
    :param cells: Its cells
    :param paper: The paper's table
    :param pictures: Pictures of the report
    :return: Paragraphs; none without environments in which both Vanilla and C-CHAIN have runs
    """
    rule = common_rule(cells.values())
    env_ids, scores, seeds = score_matrices(cells, paper, rule)
    cchain = cchain_line(cells)
    if not {"vanilla", cchain} <= set(scores):
        return []
    low, high = (np.array([end(paper.means(env_id).values()) for env_id in env_ids]) for end in (min, max))
    several = [method for method in scores if len(seeds[method]) > 1]
    without = [method_label(suite, method) for method in table_methods(cells, paper) if method not in scores]
    words = (
        f"Over {', '.join(map(short_name, env_ids))}, where Vanilla and {cchain_words(suite, cchain)} both have runs. "
        + (f"Left out, because they do not have runs in all of them: {', '.join(without)}. " if without else "")
        + NORMALIZATION.format(scores="by the rule of the released code" if rule == RELEASED else rule)
    )
    few = [method_label(suite, method) for method in several if len(seeds[method]) < BOOTSTRAP_SEEDS]
    scaled = {method: normalized(matrix, low, high) for method, matrix in scores.items()}
    return [
        "### Over the environments",
        words,
        *([FEW_SEEDS.format(methods=", ".join(few))] if few else []),
        *_metrics(suite, "metrics", scaled, seeds, [], pictures),
        *_over_oracle(suite, env_ids, scores, seeds, paper, pictures),
        *_improvement(suite, env_ids, cchain, scores, several, paper),
    ]


def paper_over_oracle(paper: Table, env_ids: Sequence[str]) -> dict[str, np.ndarray]:
    """
    :param paper: The paper's table
    :param env_ids: Some of its environments
    :return: The mean of each method over that of the Oracle, ``(n_environments,)``; nothing in a suite where
        the Oracle's means are not all greater than 0
    """
    if not all(paper.means(env_id).get("oracle", 0) > 0 for env_id in paper.lengths):
        return {}
    means = [paper.means(env_id) for env_id in env_ids]
    return {method: np.array([mean[method] / mean["oracle"] for mean in means]) for method in paper.methods}


def _over_oracle(
    suite: str,
    env_ids: Sequence[str],
    scores: Mapping[str, np.ndarray],
    seeds: Mapping[str, Sequence[int]],
    paper: Table,
    pictures: Pictures,
) -> list[str]:
    """The metrics as the paper's figure has them, by the Oracle here or, without its runs, by the paper's."""
    printed = paper_over_oracle(paper, env_ids)
    oracle = (
        scores["oracle"].mean(axis=0) if "oracle" in scores else np.array([paper.means(e).get("oracle", 0) for e in env_ids])
    )
    if not printed or not (oracle > 0).all():
        return [NO_ORACLE]
    rows = [
        [
            f"{method_label(suite, method)}, paper",
            MISSING,
            f"{np.mean(ratios):.2f}",
            f"{np.median(ratios):.2f}",
            MISSING,
            MISSING,
        ]
        for method, ratios in printed.items()
    ]
    whose = "the Oracle's runs here" if "oracle" in scores else "the paper's Oracle (without runs in some of them here)"
    scaled = {method: matrix / oracle for method, matrix in scores.items()}
    return [ORACLE_WORDS.format(oracle=whose), *_metrics(suite, "metrics_by_oracle", scaled, seeds, rows, pictures)]


def _metrics(
    suite: str,
    name: str,
    scaled: Mapping[str, np.ndarray],
    seeds: Mapping[str, Sequence[int]],
    further: Sequence[Sequence[str]],
    pictures: Pictures,
) -> list[str]:
    """The table of the metrics and their picture, of methods with several seeds."""
    estimates, intervals = reliable_metrics(scaled)
    several = [method for method in scaled if len(seeds[method]) > 1]
    rows = []
    for method, values in estimates.items():
        figures = [f"{value:.2f}" for value in values]
        if method in several:
            figures = [f"{figure} [{lo:.2f}, {hi:.2f}]" for figure, lo, hi in zip(figures, *intervals[method], strict=True)]
        rows.append([method_label(suite, method), seeds_text(seeds[method]), *figures])
    table = markdown_table(["method", "seeds", *METRICS], [*rows, *further])
    if not several:
        return [table]
    words = "" if name == "metrics" else ", normalised by the Oracle"
    path, picture = pictures.add(f"{name}_{suite}", f"Metrics over the environments of {SUITES[suite].title}{words}")
    lines = suite_lines(suite, several)
    names = [f"{metric}\n(less is better)" if metric == "optimality gap" else metric for metric in METRICS]
    plot_reliable_metrics({method: estimates[method] for method in several}, intervals, names, lines, seeds, path)
    return [table, picture]


def cchain_words(suite: str, line: str) -> str:
    """
    :param suite: Name of a suite
    :param line: C-CHAIN, or C-CHAIN with another β
    :return: How the text calls it
    """
    return "C-CHAIN" if line == "cchain" else method_label(suite, line)


def _improvement(
    suite: str, env_ids: Sequence[str], cchain: str, scores: Mapping[str, np.ndarray], several: Sequence[str], paper: Table
) -> list[str]:
    """C-CHAIN against each other method."""
    rows = []
    for method, (probability, interval) in probability_of_improvement(scores, cchain).items():
        text = f"{probability:.2f}"
        if method in several and cchain in several:
            text += f" [{interval[0]:.2f}, {interval[1]:.2f}]"
        higher = int((scores[cchain].mean(axis=0) > scores[method].mean(axis=0)).sum())
        in_paper = MISSING
        if method in paper.methods:
            means = [paper.means(env_id) for env_id in env_ids]
            in_paper = f"{sum(mean['cchain'] > mean[method] for mean in means)} of {len(env_ids)}"
        rows.append([method_label(suite, method), text, f"{higher} of {len(env_ids)}", in_paper])
    header = [f"{cchain_words(suite, cchain)} over", "probability of improvement", "higher mean, here", "higher mean, paper"]
    return [
        IMPROVEMENT,
        markdown_table(header, rows),
    ]
