"""What learning curves of several seeds are drawn from: running means, and the band around their mean."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]

# Environment steps and values of one run
Series = tuple[Array, Array]

N_POINTS = 100


def smoothed(values: Array, window: int) -> Array:
    """
    :param values: A series
    :param window: Length of the running mean
    :return: Mean of the last ``window`` values at each point, of fewer at the beginning
    """
    n_values = len(values)
    width = min(window, n_values)
    if n_values == 0:
        return np.zeros(0)
    # Not by differences of cumulated sums, in which a value that is NaN or infinite would spoil all that follow
    padded = np.concatenate([np.zeros(width - 1), values])
    return sliding_window_view(padded, width).sum(axis=1) / np.minimum(np.arange(1, n_values + 1), width)


def band(curves: Sequence[Series], logarithmic: bool = False) -> tuple[Array, Array, Array, Array]:
    """
    :param curves: Environment steps and values of each seed
    :param logarithmic: Whether mean and standard error are those of the logarithms, which no single seed dominates
    :return: Where all seeds have values, by interpolation: environment steps, mean, mean - standard error, mean + standard
        error (the mean itself for a single seed). Empty where no step lies between the first and the last of each
    """
    start, end = max(steps[0] for steps, _ in curves), min(steps[-1] for steps, _ in curves)
    grid = np.linspace(start, end, N_POINTS if start < end else int(start == end))
    transform: Callable[[Array], Array] = np.asarray
    inverse = transform
    if logarithmic:
        smallest = np.finfo(float).tiny  # in place of 0 and of what rounding made negative
        transform, inverse = lambda values: np.log(np.maximum(values, smallest)), np.exp
    seeds = np.array([np.interp(grid, steps, transform(values)) for steps, values in curves])
    mean = seeds.mean(axis=0)
    error = seeds.std(axis=0, ddof=1) / np.sqrt(len(curves)) if len(curves) > 1 else np.zeros_like(mean)
    return grid, inverse(mean), inverse(mean - error), inverse(mean + error)


def draw_band(axes: Any, curves: Sequence[Series], logarithmic: bool = False, **style: Any) -> None:
    """
    Draw the mean of several seeds and a band of ± 1 standard error, an error bar where there is a single point.

    :param axes: matplotlib's
    :param curves: Environment steps and values of each seed
    :param logarithmic: As for :func:`band`
    :param style: ``color``, ``label`` and others of ``axes.plot()``
    """
    grid, mean, low, high = band(curves, logarithmic)
    axes.plot(grid, mean, marker="o" if len(grid) == 1 else None, **style)
    if len(grid) == 1:
        axes.vlines(grid, low, high, color=style["color"], linewidth=4, alpha=0.4)
    else:
        axes.fill_between(grid, low, high, color=style["color"], alpha=0.2, linewidth=0)
