"""The tables of the results."""

import math
from collections.abc import Iterable, Mapping, Sequence
from statistics import fmean
from textwrap import fill

import numpy as np

from benchmarks.family.case import Case
from benchmarks.family.training import Run, read
from benchmarks.number_text import thousands
from benchmarks.report.markdown import markdown_table
from benchmarks.report.places import LINE_LENGTH
from sb3_cchain.analysis.metrics.intervals import difference_interval

# Of the evaluations of each task, the last fifth is its end
END = 0.2

NOTHING = "No run is done yet."

# Evaluations of the runs that are done: by variant, then by seed
Evaluations = Mapping[str, Mapping[int, np.ndarray]]


def read_all(runs: Iterable[Run]) -> dict[str, dict[int, np.ndarray]]:
    """
    :param runs: Runs of a case, done or not
    :return: The evaluations of those that are done, by variant and seed
    """
    evaluations: dict[str, dict[int, np.ndarray]] = {}
    for run in runs:
        evaluations.setdefault(run.variant_name, {})
        if run.result.exists():
            evaluations[run.variant_name][run.seed] = read(run)
    return evaluations


def over_training(case: Case, evaluations: np.ndarray) -> float:
    """
    :param case: The case
    :param evaluations: Evaluations of a run, ``(n_evaluations, 2)``
    :return: Mean score of all evaluations
    """
    return float(evaluations[:, 1].mean())


def at_the_end(case: Case, evaluations: np.ndarray) -> float:
    """
    :param case: The case
    :param evaluations: Evaluations of a run, ``(n_evaluations, 2)``
    :return: Mean score of the last fifth of the evaluations of each task
    """
    tasks = np.array_split(evaluations[:, 1], case.n_tasks)
    return float(np.mean([task[-max(round(END * len(task)), 1) :].mean() for task in tasks]))


MEASURES = {"over training": over_training, "at the end": at_the_end}


def summary_table(cases: Mapping[str, tuple[Case, Evaluations]]) -> str:
    """
    :param cases: Cases and their results, by name
    :return: A table with a row for each C-CHAIN variant, against the first variant of its case, over the seeds that both have,
        and what is missing
    """
    rows = []
    missing: dict[str, list[str]] = {}
    for case, evaluations in cases.values():
        base, *others = case.variants
        for name in others:
            if not name.startswith("cchain"):
                continue
            label, seeds = case.variants[name].label, sorted(evaluations[base].keys() & evaluations[name].keys())
            if not seeds:
                missing.setdefault(case.title, []).append(label)
                continue
            cells: list[str] = []
            for measure in MEASURES.values():
                before, after = ([measure(case, evaluations[key][seed]) for seed in seeds] for key in (base, name))
                cells += _compared(before, after)
            rows.append([case.title, label, str(len(seeds)), *cells])
    header = ["", "", "seeds", *(cell for name in MEASURES for cell in (name, "difference"))]
    table = markdown_table(header, rows)
    if not missing:
        return table
    words = "; ".join(f"{title} ({', '.join(labels)})" for title, labels in missing.items())
    return f"{table}\n\n{fill(f'Not done yet: {words}.', LINE_LENGTH)}"


def _compared(before: Sequence[float], after: Sequence[float]) -> tuple[str, str]:
    """Both means, and their difference with its 95 % interval, which is bold where it leaves out 0."""
    means, difference = f"{number(fmean(before))} → {number(fmean(after))}", fmean(after) - fmean(before)
    interval = difference_interval(after, before)
    if interval is None:
        return means, number(difference)
    low, high = interval
    text = f"{number(difference)} ({number(low)} to {number(high)})"
    return means, f"**{text}**" if low > 0 or high < 0 else text


def case_table(case: Case, evaluations: Evaluations) -> str:
    """
    :param case: A case
    :param evaluations: Its results
    :return: A table with the scores of each seed, and which runs are missing
    """
    if not any(evaluations.values()):
        return NOTHING
    rows = []
    for name, variant in case.variants.items():
        seeds = evaluations[name]
        row = [variant.label]
        for measure in MEASURES.values():
            scores = [measure(case, seeds[seed]) for seed in sorted(seeds)]
            row += [", ".join(map(number, scores)), number(fmean(scores)) if scores else ""]
        if case.monitor is not None:
            row += _churn_shares(evaluations, name)
        rows.append(row)
    header = ["", *(cell for name in MEASURES for cell in (f"{name}, by seed", "mean"))]
    if case.monitor is not None:
        header += ["churn of the policy", "churn of the values"]
    return _with_missing(markdown_table(header, rows), case, evaluations)


def _churn_shares(evaluations: Evaluations, name: str) -> list[str]:
    """Mean churn of a variant, of the policy and of the values, as shares of the first variant's with the same seeds."""
    base = next(iter(evaluations))
    seeds = evaluations[base].keys() & evaluations[name].keys()
    if not seeds:
        return ["", ""]
    churn, churn_of_base = (np.nanmean([evaluations[key][seed][:, 2:] for seed in seeds], axis=(0, 1)) for key in (name, base))
    return [number(share) for share in churn / churn_of_base]


def _with_missing(table: str, case: Case, evaluations: Evaluations) -> str:
    missing = {
        name: seeds
        for name in case.variants
        if (seeds := [str(seed) for seed in range(case.seeds) if seed not in evaluations[name]])
    }
    if not missing:
        return table
    words = "; ".join(f"{case.variants[name].label}: {', '.join(seeds)}" for name, seeds in missing.items())
    return f"{table}\n\n{fill(f'Seeds that are not done yet: {words}.', LINE_LENGTH)}"


def about(case: Case) -> str:
    """
    :param case: A case
    :return: How its runs are made
    """
    tasks = f"{case.n_tasks} tasks of " if case.n_tasks > 1 else ""
    steps, every = (
        thousands(steps) if steps >= 10_000 else str(steps) for steps in (case.steps // case.n_tasks, case.eval_freq)
    )
    words = (
        f"{tasks}{steps} steps; {case.source}. Evaluated every {every} steps, by {case.n_eval_episodes} episodes without "
        "exploration."
    )
    return fill(words, LINE_LENGTH)


def falls(evaluations: np.ndarray, solved: float, worst: float) -> tuple[float, float, float] | None:
    """
    :param evaluations: Evaluations of a run, ``(n_evaluations, 2)``
    :param solved: Mean return that counts as solved
    :param worst: Return of an agent that can do nothing
    :return: Step of the first evaluation that solved it, the lowest mean return after it, and the share of the evaluations
        after it below half of the way from ``worst`` to ``solved``, both NaN where none came after; None if it was never
        solved
    """
    first = np.flatnonzero(evaluations[:, 1] >= solved)
    if len(first) == 0:
        return None
    step, after = float(evaluations[first[0], 0]), evaluations[first[0] + 1 :, 1]
    if len(after) == 0:
        return step, math.nan, math.nan
    return step, float(after.min()), float((after < (solved + worst) / 2).mean())


def falls_table(case: Case, evaluations: Evaluations) -> str:
    """
    :param case: A case with a mean return that counts as solved
    :param evaluations: Its results
    :return: A table with a row per run, and which runs are missing
    """
    assert case.solved is not None
    if not any(evaluations.values()):
        return NOTHING
    rows = []
    for name, variant in case.variants.items():
        for seed, each in sorted(evaluations[name].items()):
            fall = falls(each, case.solved, case.worst)
            words = ["never", "", ""]
            if fall is not None:
                step, lowest, share = fall
                words = [f"{step:.0f}", *(["", ""] if math.isnan(lowest) else [number(lowest), f"{share:.0%}"])]
            rows.append([variant.label, str(seed), *words, number(each[-1, 1]), number(over_training(case, each))])
    header = ["", "seed", "solved at step", "lowest after it", "below half after it", "last", "mean"]
    return _with_missing(markdown_table(header, rows), case, evaluations)


def number(value: float) -> str:
    """
    :param value: A score
    :return: It with three digits; from 100 on, as a whole number
    """
    decimals = 0 if abs(value) >= 99.95 else 1 if abs(value) >= 9.995 else 2
    return f"{value:.{decimals}f}"
