"""How sure a few runs make us of a mean, by SciPy's t-tests: pure functions of scores, one for each run."""

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

LEVEL = 0.95


def mean_interval(scores: Sequence[float]) -> tuple[float, float] | None:
    """
    :param scores: One score per run
    :return: The 95 % interval of their mean by Student's t; None for a single run, or where all are alike
    :raises ImportError: Without SciPy
    """
    if np.ptp(scores) == 0:
        return None
    low, high = _scipy_stats().ttest_1samp(scores, 0.0).confidence_interval(LEVEL)
    return float(low), float(high)


def difference_interval(scores: Sequence[float], others: Sequence[float]) -> tuple[float, float] | None:
    """
    :param scores: One score per run
    :param others: Those of other runs, independent of these
    :return: The 95 % interval of the mean of ``scores`` minus that of ``others``, by Welch's t-test; None where one of them is
        a single run, or neither varies
    :raises ImportError: Without SciPy
    """
    if min(len(scores), len(others)) < 2 or np.ptp(scores) == np.ptp(others) == 0:
        return None
    with warnings.catch_warnings():
        # SciPy warns where all of `scores` or of `others` are alike, such as the worst return that there is
        warnings.filterwarnings("ignore", "Precision loss", RuntimeWarning)
        test = _scipy_stats().ttest_ind(scores, others, equal_var=False)
    low, high = test.confidence_interval(LEVEL)
    return float(low), float(high)


def _scipy_stats() -> Any:
    try:
        from scipy import stats
    except ImportError as error:
        raise ImportError(f'Intervals need SciPy ({error}): pip install "sb3-cchain[plots]"') from error
    return stats
