"""How many dimensions a matrix really has: pure functions of its singular values."""

import math

import torch as th

from sb3_cchain.validation import check_number


def singular_values(matrix: th.Tensor) -> th.Tensor:
    r"""
    :math:`\sigma_1 \ge \sigma_2 \ge \dots \ge 0`, always computed in double precision and on the CPU.

    :param matrix: ``(n_rows, n_columns)``
    :return: ``(min(n_rows, n_columns),)``, the greatest first, without gradient
    :raises ValueError: When an entry is not finite, because algorithms for singular values then fail with unclear errors
    """
    if not matrix.isfinite().all():
        raise ValueError("`matrix` must be finite, got entries that are infinite or not a number")
    return th.linalg.svdvals(matrix.detach().to("cpu", th.float64))


def srank(singular_values: th.Tensor, delta: float = 0.01) -> int:
    r"""
    Approximate rank: the least number of singular values that hold all but a share δ of their sum,

    .. math:: \mathrm{srank}_\delta = \min \{k : \textstyle\sum_{i=1}^k \sigma_i \ge (1 - \delta) \sum_{i=1}^d \sigma_i\}

    Yang et al. (ICLR 2020, https://arxiv.org/abs/1909.12255), Kumar et al. (ICLR 2021, https://arxiv.org/abs/2010.14498),
    Appendix B of the C-CHAIN paper. It is not what is called stable rank elsewhere,
    :math:`\sum_i \sigma_i^2 / \sigma_1^2`.

    :param singular_values: :func:`singular_values` of a matrix, the greatest first
    :param delta: δ. The default is that of all three papers.
    :return: From 1 to the number of singular values; 0 for a matrix of zeros, and for no singular values
    :raises ValueError: When δ is not between 0 and 1
    """
    check_number("delta", delta, 0, 1)
    sums = singular_values.cumsum(dim=0)
    if not singular_values.any():
        return 0
    return int((sums < (1 - delta) * sums[-1]).sum()) + 1


def effective_rank(singular_values: th.Tensor) -> float:
    r"""
    The exponential of the entropy of the singular values' shares of their sum,

    .. math:: \exp\big(-\textstyle\sum_i p_i \ln p_i\big), \quad p_i = \sigma_i / \sum_k \sigma_k

    Roy & Vetterli (EUSIPCO 2007, https://ieeexplore.ieee.org/document/7098875) call it effective rank. The literature on
    :func:`srank` uses the same name for that one.

    :param singular_values: :func:`singular_values` of a matrix
    :return: From 1 to the number of singular values that are not 0; 0 for a matrix of zeros, and for no singular values
    """
    if not singular_values.any():
        return 0.0
    shares = singular_values / singular_values.sum()
    return th.special.entr(shares).sum().exp().item()


def condition_number(singular_values: th.Tensor) -> float:
    r"""
    :math:`\sigma_1 / \sigma_d`. Of a matrix without full rank it would be infinite, if rounding did not leave a
    :math:`\sigma_d` of about :math:`10^{-16} \sigma_1`: values from about :math:`10^{15}` on tell no more than that.

    :param singular_values: :func:`singular_values` of a matrix, the greatest first
    :return: At least 1; infinite when the least is 0, which includes a matrix of zeros, and for no singular values
    """
    if len(singular_values) == 0 or singular_values[-1] == 0:
        return math.inf
    return (singular_values[0] / singular_values[-1]).item()
