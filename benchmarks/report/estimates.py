"""Statistics of a few seeds: pure functions of scores, where greater is better."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np
from rliable import library, metrics

METRICS: dict[str, Callable[[np.ndarray], float]] = {
    "mean": metrics.aggregate_mean,
    "median": metrics.aggregate_median,
    "IQM": metrics.aggregate_iqm,
    "optimality gap": metrics.aggregate_optimality_gap,
}

# Resamples of rliable's bootstrap over seeds, stratified by environment
N_RESAMPLES = 2000

Interval = tuple[float, float]


def mean_and_error(scores: Sequence[float]) -> tuple[float, float | None]:
    """
    :param scores: One score per seed
    :return: Mean, and its standard error (standard deviation with n - 1, over √n), None for a single seed
    """
    error = float(np.std(scores, ddof=1) / np.sqrt(len(scores))) if len(scores) > 1 else None
    return float(np.mean(scores)), error


def bootstrap_interval(scores: Sequence[float], n_resamples: int = 10_000, level: float = 0.95) -> Interval | None:
    """
    Percentile bootstrap of the mean. With three seeds or fewer it reaches from the lowest to the highest, because
    each of these alone makes up more than 2.5 % of the resamples.

    :param scores: One score per seed
    :param n_resamples: Resamples, always the same ones
    :param level: Share of the resamples' means that lies in the interval
    :return: Its ends, None for a single seed
    """
    if len(scores) < 2:
        return None
    means = np.random.default_rng(0).choice(scores, (n_resamples, len(scores))).mean(axis=1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


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
