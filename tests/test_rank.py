"""Ranks, worked by hand."""

import math

import pytest
import torch as th

from sb3_cchain.analysis.metrics.rank import condition_number, effective_rank, singular_values, srank


def values(*numbers):
    return th.tensor(numbers, dtype=th.float64)


def test_singular_values_by_hand():
    # A Aᵀ is diagonal: 3² + 4² = 25, 2² = 4
    matrix = th.tensor([[3.0, 0.0, 4.0], [0.0, -2.0, 0.0]], requires_grad=True)
    of_matrix = singular_values(matrix)
    assert of_matrix.dtype == th.float64 and not of_matrix.requires_grad
    assert of_matrix.tolist() == pytest.approx([5.0, 2.0], rel=1e-12)


def test_singular_values_are_in_double_precision():
    # Nearly singular, but exact in single precision, in which the lesser value would be off by a tenth
    matrix = th.tensor([[1.0, 1.0], [1.0, 1.0 + 2.0**-20]])
    first, second = singular_values(matrix).tolist()
    assert first * second == pytest.approx(2.0**-20, rel=1e-9)  # the determinant


@pytest.mark.parametrize("entry", [math.nan, math.inf])
def test_of_a_matrix_that_is_not_finite(entry):
    with pytest.raises(ValueError, match="`matrix` must be finite"):
        singular_values(th.tensor([[1.0, entry]]))


@pytest.mark.parametrize(
    "numbers, delta, rank",
    [
        ((5.0, 3.0, 2.0), 0.01, 3),
        ((5.0, 3.0, 2.0), 0.2, 2),  # 8 of 10 are enough
        ((5.0, 3.0, 2.0), 0.19, 3),
        ((5.0, 3.0, 2.0), 0.5, 1),
        ((98.0, 1.5, 0.5), 0.01, 2),
        ((99.0, 1.0), 0.01, 1),
        ((4.0, 4.0, 0.0), 0.0, 2),
        ((4.0,), 1.0, 1),
        ((0.0, 0.0), 0.01, 0),
        ((), 0.01, 0),
    ],
)
def test_srank_by_hand(numbers, delta, rank):
    assert srank(values(*numbers), delta) == rank


def test_srank_is_not_the_stable_rank():
    # Whose value is (4 + 1) / 4
    assert srank(values(2.0, 1.0)) == 2


def test_srank_at_its_default():
    assert srank(values(*[1.0] * 200)) == 198
    assert isinstance(srank(values(1.0)), int)


@pytest.mark.parametrize("delta", [-0.1, 1.1])
def test_delta_out_of_its_range(delta):
    with pytest.raises(ValueError, match=f"`delta` must be a number between 0 and 1, got {delta}"):
        srank(values(1.0), delta)


@pytest.mark.parametrize(
    "numbers, rank",
    [
        ((3.0, 3.0, 3.0), 3.0),
        ((7.0,), 1.0),
        ((7.0, 0.0), 1.0),
        # Shares ½, ¼, ¼: entropy ½ ln 2 + ½ ln 4 = 1.5 ln 2
        ((2.0, 1.0, 1.0), 2**1.5),
        ((0.0, 0.0), 0.0),
        ((), 0.0),
    ],
)
def test_effective_rank_by_hand(numbers, rank):
    assert effective_rank(values(*numbers)) == pytest.approx(rank, rel=1e-12)


@pytest.mark.parametrize(
    "numbers, condition", [((8.0, 4.0, 0.5), 16.0), ((3.0,), 1.0), ((1.0, 0.0), math.inf), ((0.0,), math.inf), ((), math.inf)]
)
def test_condition_number_by_hand(numbers, condition):
    assert condition_number(values(*numbers)) == condition


def test_of_a_matrix():
    # Of rank 1: (1, 2) times (3, 4)
    of_matrix = singular_values(th.tensor([[3.0, 4.0], [6.0, 8.0]]))
    assert srank(of_matrix) == 1
    assert effective_rank(of_matrix) == pytest.approx(1.0, abs=1e-12)
    assert condition_number(of_matrix) > 1e15
