"""The torch-only part: divergences, λ, the reducer, the seam."""

import copy
import gc
import math
import pickle
import random
import re
import statistics

import pytest
import torch as th
from torch import nn

from sb3_cchain.churn import (
    AdaptiveChurnCoefficient,
    ChurnCoefficient,
    ChurnReducer,
    cross_entropy,
    extra_gradient,
    make_coefficient,
    mean_squared_difference,
)
from sb3_cchain.churn.divergence import action_changes, mean_absolute_change


def test_cross_entropy_by_hand():
    old = th.tensor([[0.5, 0.5], [1.0, 0.0]])
    new = th.tensor([[0.25, 0.75], [0.5, 0.5]])
    by_hand = (-(0.5 * math.log(0.25) + 0.5 * math.log(0.75)) - math.log(0.5)) / 2
    assert cross_entropy(old, new).item() == pytest.approx(by_hand, abs=1e-6)


def test_cross_entropy_sums_sub_actions():
    old = th.tensor([[[0.5, 0.5], [1.0, 0.0]]])
    new = th.tensor([[[0.25, 0.75], [0.5, 0.5]]])
    by_hand = -(0.5 * math.log(0.25) + 0.5 * math.log(0.75)) - math.log(0.5)
    assert cross_entropy(old, new).item() == pytest.approx(by_hand, abs=1e-6)


def test_cross_entropy_of_impossible_action_is_finite():
    assert cross_entropy(th.tensor([[1.0, 0.0]]), th.tensor([[0.0, 1.0]])).item() == pytest.approx(-math.log(1e-8))


def test_mean_squared_difference_by_hand():
    old = th.tensor([[1.0, 2.0], [3.0, 4.0]])
    new = th.tensor([[1.0, 0.0], [3.0, 5.0]])
    assert mean_squared_difference(old, new).item() == pytest.approx((0 + 4 + 0 + 1) / 4)


@pytest.mark.parametrize("function", [cross_entropy, mean_squared_difference, mean_absolute_change, action_changes])
@pytest.mark.parametrize("old, new", [((2, 3), (3,)), ((2, 3), (1, 3)), ((2, 3), (2, 1)), ((2, 3), ()), ((0, 3), (2, 3))])
def test_outputs_of_other_shapes_are_refused(function, old, new):
    """PyTorch would broadcast them."""
    for shapes in ((old, new), (new, old)):
        with pytest.raises(ValueError, match=re.escape(f"same shape, got {shapes[0]} and {shapes[1]}")):
            function(*map(th.ones, shapes))


@pytest.mark.parametrize("function", [cross_entropy, mean_squared_difference, mean_absolute_change, action_changes])
@pytest.mark.parametrize("shape", [(0,), (0, 3), (2, 0), ()])
def test_empty_batches_are_refused(function, shape):
    with pytest.raises(ValueError, match=re.escape(f"not empty, got shape {shape}")):
        function(th.ones(shape), th.ones(shape))


def test_cross_entropy_needs_a_dimension_of_categories():
    with pytest.raises(ValueError, match=r"batches of 2 or more dimensions .* got shape \(3,\)"):
        cross_entropy(th.ones(3), th.ones(3))


def test_adaptive_coefficient_by_hand():
    coef = AdaptiveChurnCoefficient(target_ratio=100.0, initial=7.0, warmup=2, window=3)
    assert coef.value == 7.0
    coef.update(-0.5, 2.0)
    assert coef.value == 7.0  # still warming up
    coef.update(0.1, 4.0)
    assert coef.value == pytest.approx(100 * (0.5 + 0.1) / (2 + 4))
    coef.update(0.3, 6.0)
    coef.update(0.2, 1.0)  # the first pair leaves the window
    assert coef.value == pytest.approx(100 * (0.1 + 0.3 + 0.2) / (4 + 6 + 1))
    coef.reset()
    assert coef.value == 7.0
    coef.update(1.0, 1.0)
    coef.update(1.0, 1.0)
    assert coef.value == pytest.approx(100.0)  # nothing from before the reset


def test_adaptive_coefficient_minimum_and_vanishing_churn():
    coef = AdaptiveChurnCoefficient(target_ratio=1.0, warmup=0, minimum=5.0)
    assert coef.value == 1.0  # no loss seen yet
    coef.update(1.0, 1.0)
    assert coef.value == 5.0
    coef = AdaptiveChurnCoefficient(target_ratio=1.0, warmup=0)
    coef.update(1.0, 0.0)
    assert coef.value == pytest.approx(1e8)


def test_adaptive_coefficient_state_is_restored():
    coef = AdaptiveChurnCoefficient(target_ratio=10.0, warmup=1, window=4)
    for loss in range(1, 7):
        coef.update(loss, 2 * loss + 1)
    restored = AdaptiveChurnCoefficient(target_ratio=10.0, warmup=1, window=4)
    restored.load_state_dict(coef.state_dict())
    assert restored.value == coef.value
    for c in (coef, restored):
        c.update(3.0, 0.1)
    assert restored.value == coef.value


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda coef: pickle.loads(pickle.dumps(coef))])
def test_a_copy_of_an_adaptive_coefficient_goes_on_alone(duplicate):
    coef = AdaptiveChurnCoefficient(target_ratio=2.0, warmup=0, window=3)
    coef.update(1.0, 2.0)
    other = duplicate(coef)
    assert other.value == coef.value
    other.update(5.0, 2.0)
    assert coef.value == pytest.approx(2 * 1 / 2)
    assert other.value == pytest.approx(2 * (1 + 5) / (2 + 2))
    coef.update(5.0, 2.0)
    assert coef.value == other.value


@pytest.mark.parametrize("coef", [ChurnCoefficient(1.0), AdaptiveChurnCoefficient(1.0, warmup=0)])
@pytest.mark.parametrize("losses, name", [((math.nan, 1.0), "base_loss"), ((1.0, -math.inf), "churn_loss")])
def test_coefficient_refuses_losses_that_are_not_finite(coef, losses, name):
    coef.update(2.0, 1.0)
    before = coef.value
    with pytest.raises(ValueError, match=f"`{name}` must be finite, got .*rewards"):
        coef.update(*losses)
    assert coef.value == before
    coef.update(2.0, 1.0)
    assert coef.value == before


def test_history_stays_in_double_precision_on_the_cpu():
    """Apple's GPUs have no double precision; "meta" stands for one."""
    coef = AdaptiveChurnCoefficient(1.0, warmup=0)
    reducer = ChurnReducer(make_network(), mean_squared_difference, coef).to("meta").to(th.float16)
    coef.update(3.0, 1.0)
    assert reducer.coefficient.value == pytest.approx(3.0)
    assert {buffer.device.type for buffer in coef.buffers()} == {"cpu"}
    assert coef.base_losses.dtype == th.float64


@pytest.mark.parametrize("window", [1, 2, 7])
def test_running_means_of_losses_of_any_size(window):
    """Against means over lists; losses of 1e-12 to 1e12, whose rounding errors a careless running sum would keep."""
    coef = AdaptiveChurnCoefficient(target_ratio=2.0, warmup=0, window=window)
    generator = random.Random(0)
    base, churn = [], []
    for _ in range(500):
        base.append(10 ** generator.uniform(-12, 12))
        churn.append(10 ** generator.uniform(-12, 12))
        coef.update(-base[-1], churn[-1])
        expected = 2.0 * statistics.fmean(base[-window:]) / (statistics.fmean(churn[-window:]) + 1e-8)
        assert coef.value == pytest.approx(expected, rel=1e-9)
    coef.reset()
    coef.update(3.0, 1.0)
    assert coef.value == pytest.approx(6.0)


@pytest.mark.parametrize(
    "value, initial, adaptive", [(0.5, 0.5, False), ("0.5", 0.5, False), ("auto", 1, True), ("auto_10", 10, True)]
)
def test_churn_coef_is_read_as_ent_coef(value, initial, adaptive):
    coef = make_coefficient(value, "auto", 1e4, warmup=10, window=50, minimum=0.0)
    assert isinstance(coef, AdaptiveChurnCoefficient) == adaptive
    assert coef.value == initial
    assert not coef.is_zero
    assert make_coefficient(0, "auto", 1e4, warmup=10, window=50, minimum=0.0).is_zero


@pytest.mark.parametrize(
    "changed, message",
    [
        ({"churn_coef": -1.0}, r"`churn_coef` must be a number greater than or equal to 0, got -1.0"),
        ({"churn_coef": "auto_-3"}, r"`churn_coef` must be .* got -3.0"),
        ({"churn_coef": "auto_"}, r"`churn_coef` must be a number, \"auto\", or \"auto_\" .* got 'auto_'"),
        ({"churn_coef": "auto_ten"}, r"`churn_coef` must be a number, .* got 'auto_ten'"),
        ({"churn_coef": True}, r"`churn_coef` must be a number, .* got True"),
        ({"window": True}, r"`churn_window` must be an integer .* got True"),
        ({"churn_coef": "automatic"}, r"`churn_coef` must be a number, \"auto\""),
        ({"churn_coef": "high"}, r"`churn_coef` must be a number, \"auto\".*; got 'high'"),
        ({"churn_coef": None}, r"`churn_coef` must be a number"),
        ({"churn_coef": float("nan")}, r"`churn_coef` must be .* got nan"),
        ({"target_ratio": 0.0}, r"`target_churn_ratio` must be a number greater than 0, got 0.0"),
        ({"target_ratio": -1}, r"`target_churn_ratio` must be a number greater than 0, got -1"),
        ({"target_ratio": "large"}, r"`target_churn_ratio` must be a number or \"auto\"; got 'large'"),
        ({"target_ratio": float("inf")}, r"`target_churn_ratio` must be .* got inf"),
        ({"warmup": -1}, r"`churn_warmup` must be an integer greater than or equal to 0, got -1"),
        ({"window": 0}, r"`churn_window` must be an integer greater than or equal to 1, got 0"),
        ({"window": 2.5}, r"`churn_window` must be an integer"),
        ({"minimum": -0.1}, r"`churn_coef_min` must be a number greater than or equal to 0, got -0.1"),
        # Beyond single precision
        ({"churn_coef": 1e39}, r"`churn_coef` must be at most 3.4e\+38, .* got 1e\+39"),
        ({"churn_coef": "1e39"}, r"`churn_coef` must be at most .* got 1e\+39"),
        ({"churn_coef": "auto_1e39"}, r"`churn_coef` must be at most .* got 1e\+39"),
        ({"target_ratio": 1e45}, r"`target_churn_ratio` must be at most .* got 1e\+45"),
        ({"minimum": 1e39}, r"`churn_coef_min` must be at most .* got 1e\+39"),
    ],
)
def test_bad_coefficient_arguments(changed, message):
    arguments = dict(churn_coef="auto", target_ratio="auto", default_target_ratio=1.0, warmup=10, window=50, minimum=0.0)
    with pytest.raises(ValueError, match=message):
        make_coefficient(**{**arguments, **changed})


def test_numpy_numbers_are_numbers():
    import numpy as np

    coef = AdaptiveChurnCoefficient(np.float32(2), warmup=np.int32(0), window=np.int64(5), minimum=np.float64(1))
    assert len(coef.base_losses) == 5


def test_greatest_coefficient_is_allowed():
    assert make_coefficient(3.4e38, 3.4e38, 1.0, warmup=0, window=1, minimum=3.4e38).value == 3.4e38


def make_network(seed=0):
    th.manual_seed(seed)
    return nn.Sequential(nn.Linear(3, 16), nn.Tanh(), nn.Linear(16, 2))


def test_extra_gradient_is_added_and_removed():
    network = make_network()
    optimizer = th.optim.SGD(network.parameters(), lr=0.1)
    batch, other = th.randn(2, 8, 3)
    optimizer.zero_grad()
    (network(batch).mean() + 3 * network(other).pow(2).mean()).backward()
    written_out = [p.grad.clone() for p in network.parameters()]

    with extra_gradient(optimizer, lambda: (3 * network(other).pow(2).mean()).backward()):
        optimizer.zero_grad(set_to_none=True)
        network(batch).mean().backward()
    assert all(th.equal(p.grad, g) for p, g in zip(network.parameters(), written_out, strict=True))
    assert "zero_grad" not in vars(optimizer)

    optimizer.zero_grad()
    assert all(p.grad is None for p in network.parameters())


def test_extra_gradients_nest_and_survive_errors():
    optimizer = th.optim.SGD(make_network().parameters(), lr=0.1)
    calls = []
    with extra_gradient(optimizer, lambda: calls.append("outer")):
        with pytest.raises(RuntimeError), extra_gradient(optimizer, lambda: calls.append("inner")):
            optimizer.zero_grad()
            raise RuntimeError
        optimizer.zero_grad()
    assert calls == ["outer", "inner", "outer"]
    assert "zero_grad" not in vars(optimizer)


def test_a_warning_says_that_no_gradient_was_added():
    network = make_network()
    optimizer = th.optim.Adam(network.parameters())
    with (
        pytest.warns(UserWarning, match="without a call of the optimiser's `zero_grad"),
        extra_gradient(optimizer, lambda: None),
    ):
        network.zero_grad()
        network(th.ones(1, 3)).sum().backward()
        optimizer.step()


@pytest.mark.filterwarnings("error")
def test_no_warning_where_there_was_no_update():
    optimizer = th.optim.Adam(make_network().parameters())
    with extra_gradient(optimizer, lambda: None):
        pass
    optimizer.step()
    with pytest.raises(RuntimeError), extra_gradient(optimizer, lambda: None):
        optimizer.step()
        raise RuntimeError
    assert not optimizer._optimizer_step_post_hooks


def test_an_optimiser_without_hooks():
    optimizer = th.optim.Adam(make_network().parameters())
    del optimizer._optimizer_step_post_hooks  # as of a class that does not call PyTorch's constructor
    calls = []
    with extra_gradient(optimizer, lambda: calls.append("backward")):
        optimizer.zero_grad()
    assert calls == ["backward"]


def test_reducer_standalone_against_written_out_loss():
    """The loop of the class's docstring, against one that keeps a copy of the network."""
    import copy

    data = th.randn(50, 2, 8, 3, generator=th.Generator().manual_seed(1))
    network, plain = make_network(), make_network()
    optimizers = [th.optim.Adam(n.parameters(), lr=1e-2) for n in (network, plain)]
    reducer = ChurnReducer(network, mean_squared_difference, ChurnCoefficient(5.0))
    previous, previous_reference = None, None
    for batch, reference in data:
        optimizers[0].zero_grad()
        reducer.backward(reference)
        network(batch).pow(2).mean().backward()
        optimizers[0].step()

        loss = plain(batch).pow(2).mean()
        if previous is not None:
            loss = loss + 5.0 * (plain(previous_reference) - previous(previous_reference).detach()).pow(2).mean()
        previous, previous_reference = copy.deepcopy(plain), reference
        optimizers[1].zero_grad()
        loss.backward()
        optimizers[1].step()
    for parameter, written_out in zip(network.parameters(), plain.parameters(), strict=True):
        assert th.allclose(parameter, written_out, atol=1e-6)
    assert len(reducer.losses) == len(data) - 1  # the first update has no previous one
    assert not any(True for _ in reducer.parameters())  # the network is not part of its state


def test_no_more_is_held_after_many_updates():
    """Of tensors, whose batches may be large: the reference batch and the outputs on it."""
    reducer = ChurnReducer(make_network(), mean_squared_difference, ChurnCoefficient(1.0))
    held = []
    for n_updates in (5, 15):
        for _ in range(n_updates):
            reducer.backward(th.randn(8, 3))
        held.append(sum(type(thing) is th.Tensor for thing in gc.get_objects()))
    assert len(reducer.losses) == 19
    assert held[0] == held[1]


@pytest.mark.parametrize("divergence", [cross_entropy, mean_squared_difference])
def test_mean_churn_by_hand(divergence):
    """Batches of different sizes: each sample counts the same, each update in the losses."""
    generator = th.Generator().manual_seed(0)
    old, new = (th.rand(12, 4, generator=generator).double().softmax(dim=1) for _ in range(2))
    reducer = ChurnReducer(nn.Identity(), divergence, ChurnCoefficient(2.0))
    assert math.isnan(reducer.mean_churn())
    for part in (slice(0, 2), slice(2, 12)):
        reducer.remember(None, old[part])
        reducer.loss(new[part])
    expected = divergence(old, new) - divergence(old, old)
    assert reducer.mean_churn() == pytest.approx(expected.item(), rel=1e-9)
    reducer.end_iteration(1.0)
    assert math.isnan(reducer.mean_churn()) and reducer.losses == []


def test_reducer_refuses_an_empty_reference_batch():
    network = make_network()
    reducer = ChurnReducer(network, mean_squared_difference, ChurnCoefficient(1.0))
    with pytest.raises(ValueError, match=r"reference batch must not be empty, got outputs of shape \(0, 2\)"):
        reducer.backward(th.ones(0, 3))


@pytest.mark.parametrize(
    "arguments, message",
    [
        ((None, mean_squared_difference, ChurnCoefficient(1.0)), "`outputs` must be a function, got None"),
        ((nn.Identity(), "mse", ChurnCoefficient(1.0)), "`divergence` must be a function, got 'mse'"),
        ((nn.Identity(), mean_squared_difference, 0.1), "`coefficient` must be a ChurnCoefficient, .* got 0.1"),
    ],
)
def test_bad_arguments_of_the_reducer(arguments, message):
    with pytest.raises(TypeError, match=message):
        ChurnReducer(*arguments)


@pytest.mark.parametrize("coef, change", [(1e38, 10.0), (1e30, 1e5)])
def test_a_loss_beyond_the_precision_raises_before_the_gradient(coef, change):
    network = make_network()
    reducer = ChurnReducer(network, mean_squared_difference, ChurnCoefficient(coef))
    reducer.backward(th.ones(4, 3))
    reducer.old_outputs += change
    with pytest.raises(
        ValueError, match=r"λ times the churn loss, .* is beyond the network's precision.*not been made.*rewards"
    ):
        reducer.backward(th.ones(4, 3))
    assert all(parameter.grad is None for parameter in network.parameters())


def test_a_base_loss_that_is_not_finite_is_named():
    reducer = ChurnReducer(make_network(), mean_squared_difference, AdaptiveChurnCoefficient(1.0, warmup=0))
    for _ in range(2):
        reducer.backward(th.ones(4, 3))
    with pytest.raises(ValueError, match="`base_loss` must be finite, got inf"):
        reducer.end_iteration(math.inf)
    assert reducer.coefficient.value == 1.0 and reducer.losses == []


def test_reducer_state_is_restored():
    network = make_network()
    reducer = ChurnReducer(network, mean_squared_difference, AdaptiveChurnCoefficient(1.0))
    reducer.backward(th.ones(4, 3))
    restored = ChurnReducer(network, mean_squared_difference, AdaptiveChurnCoefficient(1.0))
    restored.load_state_dict(reducer.state_dict())
    assert th.equal(restored.reference, reducer.reference)
    assert th.equal(restored.old_outputs, reducer.old_outputs)


@pytest.mark.parametrize("poison", [float("nan"), float("inf")])
def test_non_finite_churn_raises_before_the_parameters_are_touched(poison):
    network = make_network()
    optimizer = th.optim.SGD(network.parameters(), lr=0.1)
    reducer = ChurnReducer(network, mean_squared_difference, ChurnCoefficient(1.0))
    reducer.backward(th.full((4, 3), 1.0))
    reducer.old_outputs[0] = poison
    before = [p.clone() for p in network.parameters()]
    with pytest.raises(ValueError, match=r"churn loss is (nan|inf)"):
        optimizer.zero_grad()
        reducer.backward(th.ones(4, 3))
        optimizer.step()
    assert all(th.equal(p, b) for p, b in zip(network.parameters(), before, strict=True))


def test_reducer_forgets_reference():
    network = make_network()
    reducer = ChurnReducer(network, mean_squared_difference, ChurnCoefficient(1.0))
    reducer.backward(th.ones(4, 3))
    reducer.forget_reference()
    reducer.backward(th.ones(4, 3))
    assert reducer.losses == []
