"""Dormant scores, worked by hand."""

import torch as th

from sb3_cchain.analysis.metrics.dormancy import dormant_scores, mean_activity


def test_activity_by_hand():
    # Two samples of three units
    activations = th.tensor([[1.0, -2.0, 0.0], [3.0, 2.0, 0.0]])
    assert mean_activity(activations).tolist() == [2.0, 2.0, 0.0]


def test_activity_of_filters_by_hand():
    # One sample of two filters, at 2×2 positions
    activations = th.tensor([[[[1.0, -1.0], [2.0, 0.0]], [[0.0, 0.0], [0.0, 4.0]]]])
    assert mean_activity(activations).tolist() == [1.0, 1.0]
    both = th.cat([activations, 3 * activations])
    assert mean_activity(both).tolist() == [2.0, 2.0]


def test_scores_by_hand():
    # Their mean is 2
    assert dormant_scores(th.tensor([5.0, 1.0, 0.0, 2.0])).tolist() == [2.5, 0.5, 0.0, 1.0]


def test_a_layer_without_any_activity_is_dormant():
    assert dormant_scores(th.zeros(3)).tolist() == [0.0, 0.0, 0.0]
