"""Weight clipping, by hand."""

import pytest
import torch as th
from torch import nn

from sb3_cchain.methods import WeightClipping


def step(layers, clip_ratio, value=7.0):
    """An update that would set all entries to ``value``."""
    parameters = list(layers.parameters())
    optimizer = WeightClipping(parameters, lr=1.0, clip_ratio=clip_ratio, base_class=th.optim.SGD)
    for parameter in parameters:
        parameter.grad = parameter.detach() - value
    optimizer.step()
    return optimizer


@pytest.mark.parametrize("clip_ratio", [0.1, 0.5, 1, 10])
@pytest.mark.parametrize("value", [70.0, -70.0])
@pytest.mark.parametrize(
    "layer, bound",
    [
        (nn.Linear(16, 3), 1 / 4),
        (nn.Linear(25, 3, bias=False), 1 / 5),
        (nn.Conv2d(4, 5, kernel_size=3), 1 / 6),  # 4 · 3 · 3
        (nn.Conv2d(4, 6, kernel_size=3, groups=2), 1 / 18**0.5),  # 2 · 3 · 3
        (nn.Conv1d(3, 2, kernel_size=12), 1 / 6),
    ],
)
def test_bounds_by_hand(layer, bound, value, clip_ratio):
    optimizer = step(layer, clip_ratio, value)
    for parameter in layer.parameters():
        assert th.allclose(parameter, th.full_like(parameter, clip_ratio * bound * value / abs(value)))
    assert optimizer.metrics() == {"weight_clipping/share": 1.0}


def test_default_initialisation_is_within():
    layers = nn.Sequential(nn.Conv2d(3, 8, 3), nn.Linear(20, 30), nn.Linear(30, 4))
    before = [p.detach().clone() for p in layers.parameters()]
    optimizer = WeightClipping(layers.parameters(), lr=0.0)
    for parameter in layers.parameters():
        parameter.grad = th.ones_like(parameter)
    optimizer.step()
    assert all(map(th.equal, layers.parameters(), before))


def test_vectors():
    """As SB3's actor-critic policies have them: log_std comes first."""
    log_std = nn.Parameter(th.zeros(2))
    layers = nn.Sequential(nn.Linear(16, 4), nn.LayerNorm(4), nn.Linear(4, 2))
    optimizer = WeightClipping([log_std, *layers.parameters()], lr=1.0)
    assert optimizer.bounds() == [float("inf"), 1 / 4, 1 / 4, 1 / 4, 1 / 4, 1 / 2, 1 / 2]
    log_std.grad = th.ones(2)
    WeightClipping([log_std], lr=3.0, base_class=th.optim.SGD).step()
    assert log_std.tolist() == [-3, -3]


def test_share():
    layer = nn.Linear(4, 2)  # bound 1/2; 8 + 2 entries
    optimizer = WeightClipping(layer.parameters(), lr=1.0, base_class=th.optim.SGD)
    with th.no_grad():
        layer.weight.copy_(th.tensor([[0.9, -0.9, 0.4, 0.0], [0.1, 0.2, -0.51, 0.49]]))
        layer.bias.zero_()
    for parameter in layer.parameters():
        parameter.grad = th.zeros_like(parameter)
    optimizer.step()
    assert optimizer.metrics() == {"weight_clipping/share": 0.3}
    assert th.equal(layer.weight, th.tensor([[0.5, -0.5, 0.4, 0.0], [0.1, 0.2, -0.5, 0.49]]))


def test_share_of_bounds_that_floating_point_numbers_miss():
    layer = nn.Linear(3, 5)
    assert step(layer, clip_ratio=0.7).metrics() == {"weight_clipping/share": 1.0}


def test_frozen_parameters_are_not_clipped():
    weight, frozen = (nn.Parameter(th.full((1, 4), 9.0), requires_grad=trained) for trained in (True, False))
    optimizer = WeightClipping([weight, frozen], lr=0.0, base_class=th.optim.SGD)
    weight.grad = th.zeros_like(weight)
    optimizer.step()
    assert weight.tolist() == [[0.5] * 4] and frozen.tolist() == [[9.0] * 4]
