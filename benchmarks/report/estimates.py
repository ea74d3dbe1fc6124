"""Statistics of a few seeds: pure functions of scores, where greater is better."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from rliable import library, metrics
from scipy import stats

METRICS: dict[str, Callable[[np.ndarray], float]] = {
    "mean": metrics.aggregate_mean,
    "median": metrics.aggregate_median,
    "IQM": metrics.aggregate_iqm,
    "optimality gap": metrics.aggregate_optimality_gap,
}

# Resamples of rliable's bootstrap over seeds, stratified by environment
N_RESAMPLES = 2000

Interval = tuple[float, float]


class Sample(NamedTuple):
    """
    What is known of a method's scores in an environment.

    :param mean: Mean over the seeds
    :param error: Its standard error, None for a single seed
    :param n: Number of seeds
    """

    mean: float
    error: float | None
    n: int


class Difference(NamedTuple):
    """
    One mean minus another.

    :param value: The difference
    :param interval: Welch's 95 % interval of it, None where one of the samples is a single seed or neither varies
    :param effect: Hedges' g: the difference over the root of the mean of the two variances, corrected for few seeds; None
        where there is no interval
    """

    value: float
    interval: Interval | None
    effect: float | None


def mean_and_error(scores: Sequence[float]) -> tuple[float, float | None]:
    """
    :param scores: One score per seed
    :return: Mean, and its standard error (standard deviation with n - 1, over √n), None for a single seed
    """
    error = float(np.std(scores, ddof=1) / np.sqrt(len(scores))) if len(scores) > 1 else None
    return float(np.mean(scores)), error


def bootstrap_interval(scores: Sequence[float]) -> Interval | None:
    """
    95 % percentile bootstrap of the mean, of resamples that are always the same. With three seeds or fewer it reaches from the
    lowest to the highest, because each of these alone makes up more than 2.5 % of the resamples.

    :param scores: One score per seed
    :return: Its ends, None for a single seed
    """
    if len(scores) < 2:
        return None
    means = np.random.default_rng(0).choice(scores, (10_000, len(scores))).mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


def sample(scores: Sequence[float]) -> Sample:
    """
    :param scores: One score per seed
    :return: What the report knows of them
    """
    return Sample(*mean_and_error(scores), len(scores))


def difference(one: Sample, other: Sample) -> Difference:
    """
    :param one: A sample
    :param other: Another, independent of it
    :return: The mean of the one minus that of the other
    """
    value = one.mean - other.mean
    if one.error is None or other.error is None or one.error == other.error == 0:
        return Difference(value, None, None)
    squares = one.error**2, other.error**2
    freedom = sum(squares) ** 2 / (squares[0] ** 2 / (one.n - 1) + squares[1] ** 2 / (other.n - 1))
    low, high = stats.t.interval(0.95, freedom, loc=value, scale=sum(squares) ** 0.5)
    deviation = ((one.n * squares[0] + other.n * squares[1]) / 2) ** 0.5
    effect = value / deviation * (1 - 3 / (4 * (one.n + other.n - 2) - 1))
    return Difference(value, (float(low), float(high)), effect)


def agrees(interval: Interval, mean: float, standard_error: float) -> bool:
    """
    :param interval: Interval of the mean here
    :param mean: Mean in the paper
    :param standard_error: Its standard error
    :return: Whether the interval overlaps the paper's mean ± 2 standard errors
    """
    return interval[0] <= mean + 2 * standard_error and mean - 2 * standard_error <= interval[1]


def best_two(means: Mapping[str, float]) -> dict[str, str]:
    """
    :param means: Mean of each method
    :return: ``"best"`` and ``"second"`` by method. As in the paper, the Oracle does not compete, two methods have no second,
        and a single one is no best
    """
    competing = {method: mean for method, mean in means.items() if method != "oracle"}
    marks = ["best", "second"][: len(competing) - 1]
    ranks = {method: sum(other > mean for other in competing.values()) for method, mean in competing.items()}
    return {method: marks[rank] for method, rank in ranks.items() if rank < len(marks)}


def normalized(scores: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """
    :param scores: ``(n_seeds, n_environments)``
    :param low: Score that becomes 0, ``(n_environments,)``
    :param high: Score that becomes 1, ``(n_environments,)``
    :return: ``(n_seeds, n_environments)``
    """
    return (scores - low) / (high - low)


def reliable_metrics(scores: Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """
    Mean, median, interquartile mean and optimality gap (Agarwal et al., 2021) over environments and seeds.

    :param scores: Normalised scores of each method, ``(n_seeds, n_environments)``
    :return: By method, ``METRICS``, ``(4,)``, and ends of their 95 % intervals, ``(2, 4)``
    """

    def compute(method_scores: np.ndarray) -> np.ndarray:
        return np.array([metric(method_scores) for metric in METRICS.values()])

    with _seeded():
        return library.get_interval_estimates(dict(scores), compute, reps=N_RESAMPLES)


def probability_of_improvement(scores: Mapping[str, np.ndarray], method: str) -> dict[str, tuple[float, Interval]]:
    """
    :param scores: Scores of each method, ``(n_seeds, n_environments)``
    :param method: One of them
    :return: For each other method, the probability that a run of ``method`` scores higher than one of the other, a tie
        counting as a half, mean over the environments; and the 95 % interval
    """
    pairs = {other: (scores[method], scores[other]) for other in scores if other != method}
    with _seeded():
        estimates, intervals = library.get_interval_estimates(pairs, _improvement, reps=N_RESAMPLES)
    return {other: (float(estimates[other]), tuple(intervals[other][:, 0].tolist())) for other in pairs}


def _improvement(first: np.ndarray, second: np.ndarray) -> float:
    """``rliable.metrics.probability_of_improvement``, without the p-values that make it a hundred times slower."""
    difference = first[:, None] - second[None]
    return float(np.mean((difference > 0) + 0.5 * (difference == 0)))


@contextmanager
def _seeded() -> Iterator[None]:
    """rliable resamples with NumPy's global generator, whatever `random_state` it is given."""
    state = np.random.get_state()
    np.random.seed(0)
    try:
        yield
    finally:
        np.random.set_state(state)
