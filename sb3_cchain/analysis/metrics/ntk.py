"""Figures of an empirical neural tangent kernel (NTK): pure functions of gradients and of the matrix."""

import math
from collections.abc import Sequence

import torch as th

from sb3_cchain.analysis.metrics.rank import condition_number, effective_rank, singular_values, srank

STATISTICS = ("srank", "effective_rank", "off_diagonal_sum", "diagonal_sum", "condition_number")


def gram_matrix(gradients: Sequence[th.Tensor]) -> th.Tensor:
    r"""
    :math:`N(i, j) = g_i^\top g_j`, in double precision.

    :param gradients: For each parameter ``(n, *parameter.shape)``: its part of :math:`g_1, \dots, g_n`
    :return: ``(n, n)``
    """
    n = len(gradients[0])
    matrix = th.zeros(n, n, dtype=th.float64, device=gradients[0].device)
    for gradient in gradients:
        part = gradient.flatten(start_dim=1).double()
        matrix += part @ part.T
    return matrix


def off_diagonal_sum(matrix: th.Tensor) -> float:
    """
    :param matrix: A square matrix
    :return: Sum of the absolute values off the diagonal: for an NTK, how much the gradients of minibatches have in common
    """
    return (matrix.abs().sum() - matrix.diagonal().abs().sum()).item()


def diagonal_sum(matrix: th.Tensor) -> float:
    """
    :param matrix: A square matrix
    :return: Sum of the absolute values on the diagonal: for an NTK, of the squared norms of the gradients
    """
    return matrix.diagonal().abs().sum().item()


def ntk_statistics(matrix: th.Tensor, delta: float = 0.01) -> dict[str, float]:
    """
    :param matrix: An NTK
    :param delta: δ of :func:`~sb3_cchain.analysis.metrics.rank.srank`
    :return: ``srank``, ``effective_rank``, ``off_diagonal_sum``, ``diagonal_sum`` and ``condition_number``; not a number
        where the matrix is not finite
    """
    if not matrix.isfinite().all():
        return dict.fromkeys(STATISTICS, math.nan)
    values = singular_values(matrix)
    figures = (
        srank(values, delta),
        effective_rank(values),
        off_diagonal_sum(matrix),
        diagonal_sum(matrix),
        condition_number(values),
    )
    return dict(zip(STATISTICS, figures, strict=True))
