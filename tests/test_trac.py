"""TRAC against the authors' package, and its parts by hand."""

import os

import pytest
import torch as th
import trac_optimizer.trac
from torch import nn
from trac_optimizer import start_trac
from trac_optimizer.trac import erfi as erfi_of_package

from sb3_cchain.methods import TRAC
from sb3_cchain.methods.trac import erfi

N_STEPS = 100
BASES = [(th.optim.Adam, dict(eps=1e-5)), (th.optim.SGD, dict(momentum=0.9))]


def make_parameters():
    th.manual_seed(0)
    network = nn.Sequential(nn.Linear(4, 8), nn.Tanh(), nn.Linear(8, 2))
    return network, [*network.parameters(), nn.Parameter(th.ones(2))]  # the last one without a gradient


def backward(network, parameters, x, shift, max_grad_norm):
    (network(x) - x[:, :2] - shift).square().mean().backward()
    if max_grad_norm is not None:
        nn.utils.clip_grad_norm_(parameters, max_grad_norm)


@pytest.fixture
def double_precision():
    """The package keeps its statistics in the default precision."""
    th.set_default_dtype(th.float64)
    yield
    th.set_default_dtype(th.float32)


@pytest.mark.parametrize("max_grad_norm, new_lr, s_init", [(None, None, 1e-2), (0.5, 1e-3, 1e-8), (0.05, None, 1e-2)])
@pytest.mark.parametrize("base, kwargs", BASES)
def test_each_update_equals_the_packages(tmp_path, double_precision, max_grad_norm, new_lr, base, kwargs, s_init):
    """
    From the same parameters and statistics at each step: TRAC is chaotic (S grows by orders of magnitude or falls to 0 within
    a few updates), so that a rounding error in one run is another path later on.
    """
    network, parameters = make_parameters()
    its_network, its_parameters = make_parameters()
    optimizer = TRAC(parameters, lr=1e-2, s_init=s_init, base_class=base, base_kwargs=kwargs)
    package = start_trac(str(tmp_path / "log"), base, s_prev=s_init)(its_parameters, lr=1e-2, **kwargs)
    scales = []
    for step, x in enumerate(th.randn(N_STEPS, 32, 4)):
        if step == N_STEPS // 2 and new_lr is not None:
            optimizer.param_groups[0]["lr"] = package.param_groups[0]["lr"] = new_lr
        if step > 0:
            state = package.state["_trac"]
            statistics = dict(
                scale=state["s"].sum().item(), sigma=state["sigma"].tolist(), variance=state["variance"].tolist()
            )
            optimizer.own_state.update(statistics)
            with th.no_grad():
                for p, q in zip(parameters, its_parameters, strict=True):
                    p.copy_(q)
        for each, its, its_own in ((optimizer, network, parameters), (package, its_network, its_parameters)):
            each.zero_grad()
            backward(its, its_own, x, shift=float(step > N_STEPS // 2), max_grad_norm=max_grad_norm)
            each.step()
        for p, q in zip(parameters, its_parameters, strict=True):
            assert (p - q).abs().max() < 1e-6
        scales.append(package.state["_trac"]["s"].sum().item())
        assert optimizer.metrics()["trac/scale"] == pytest.approx(max(scales[-1], 0.0), rel=1e-6)
    assert max(scales) > 1e3 * abs(scales[0]) or max(scales) > 0.3
    start = make_parameters()[1]
    assert max((p - q).abs().max() for p, q in zip(parameters, start, strict=True)) > 0.1 or max(scales) < 1e-3


@pytest.mark.parametrize("max_grad_norm, new_lr", [(None, None), (0.4, 3e-3)])
@pytest.mark.parametrize("base, kwargs", BASES)
def test_100_updates_equal_the_packages(tmp_path, monkeypatch, double_precision, max_grad_norm, new_lr, base, kwargs):
    """Left to itself, with erfi's coefficients in double precision, too, which the package computes when it is imported."""
    monkeypatch.setattr(trac_optimizer.trac, "erf_torch", trac_optimizer.trac.ERF_1994(128))
    generator = th.Generator().manual_seed(0)
    x, y = th.randn(64, 8, generator=generator, dtype=th.float64), th.randn(64, 2, generator=generator, dtype=th.float64)
    ends = []
    for make in (
        lambda params: TRAC(params, lr=1e-2, s_init=1e-4, base_class=base, base_kwargs=kwargs),
        lambda params: start_trac(str(tmp_path / "log"), base, s_prev=1e-4)(params, lr=1e-2, **kwargs),
    ):
        # Linear regression: less chaotic than a network
        weight = nn.Parameter(th.zeros(8, 2, dtype=th.float64))
        optimizer = make([weight])
        for step in range(N_STEPS):
            if step == N_STEPS // 2 and new_lr is not None:
                optimizer.param_groups[0]["lr"] = new_lr
            optimizer.zero_grad()
            (x @ weight - y).square().mean().backward()
            if max_grad_norm is not None:
                nn.utils.clip_grad_norm_([weight], max_grad_norm)
            optimizer.step()
        ends.append(weight.detach())
    assert (ends[0] - ends[1]).abs().max() < 1e-6
    assert ends[1].abs().max() > 0.1


def test_first_two_updates_by_hand():
    parameter = nn.Parameter(th.tensor([1.0, -2.0], dtype=th.float64))
    optimizer = TRAC([parameter], lr=0.5, betas=[0.9], s_init=0.1, eps=1e-8, base_class=th.optim.SGD)
    # No way was gone yet: h = 0, v = 0, σ = 0.9e-8, σ / ε = 0.9
    parameter.grad = th.tensor([4.0, 2.0], dtype=th.float64)
    optimizer.step()
    unit = erfi(th.tensor([0.5**0.5]).numpy())[0]
    scale = 0.1 * erfi(th.tensor([0.9], dtype=th.float64).numpy())[0] / unit
    start = th.tensor([1.0, -2.0], dtype=th.float64)
    assert th.allclose(parameter, start + th.tensor([-2.0, -1.0]) * scale, rtol=1e-6)
    # d = (-2, -1), g = (1, 0): h = -2, v = 4, σ = 2, σ / √(2v) = 1/√2, whose erfi the scale is measured by
    parameter.grad = th.tensor([1.0, 0.0], dtype=th.float64)
    optimizer.step()
    assert optimizer.metrics()["trac/scale"] == pytest.approx(0.1, rel=1e-6)
    assert th.allclose(parameter, start + 0.1 * th.tensor([-2.5, -1.0], dtype=th.float64), rtol=1e-6)
    # Against the way gone: h = -20 · -2.5 = 50, σ < 0, and all goes back to the start
    parameter.grad = th.tensor([-20.0, 0.0], dtype=th.float64)
    optimizer.step()
    assert optimizer.metrics()["trac/scale"] == 0
    assert th.equal(parameter, start)


def test_erfi():
    x = th.tensor([1e-9, 1e-3, 0.5, 2**-0.5, 1.0, 3.0, 6.0, -0.3, -5.0])
    assert erfi(x.double().numpy()) == pytest.approx(erfi_of_package(x).double().numpy(), rel=2e-6)
    # erfi(1) = 1.650425758797...
    assert erfi(th.tensor([1.0]).numpy())[0] == pytest.approx(1.650425758797, rel=0.011)
    assert erfi(th.tensor([0.0, 40.0, -40.0]).numpy()).tolist() == [0.0, float("inf"), -float("inf")]


def test_writes_no_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    network, parameters = make_parameters()
    optimizer = TRAC(parameters, lr=1e-2)
    for _ in range(3):
        backward(network, parameters, th.ones(2, 4), 0.0, None)
        optimizer.step()
    assert os.listdir(tmp_path) == []


def test_refuses_gradients_that_are_not_finite():
    parameter = nn.Parameter(th.ones(2))
    optimizer = TRAC([parameter], lr=1e-2)
    parameter.grad = th.ones(2)
    optimizer.step()
    before = parameter.detach().clone()
    parameter.grad = th.tensor([float("nan"), 0.0])
    with pytest.raises(ValueError, match="TRAC needs finite gradients"):
        optimizer.step()
    assert th.equal(parameter, before)
    assert th.is_grad_enabled()
