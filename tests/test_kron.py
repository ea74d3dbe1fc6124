"""Kron of pytorch-optimizer as an optimiser of this package."""

import pytest
import torch as th
from torch import nn

from sb3_cchain.methods import Kron, L2Init
from tests.method_models import go_on, make_model, make_random_env

pytorch_optimizer = pytest.importorskip("pytorch_optimizer")


def test_the_first_update_by_hand():
    """With momentum debiased and preconditioners that stay at 1, it is that of the gradient."""
    parameter = nn.Parameter(th.zeros(2, 2))
    optimizer = Kron([parameter], lr=0.1, update_probability=0)
    parameter.grad = th.tensor([[0.5, -0.25], [0.0, 1.0]])
    optimizer.step()
    assert th.allclose(parameter, -0.1 * parameter.grad)
    parameter.grad = th.zeros(2, 2)
    optimizer.step()  # the running mean (0.9 · 0.1 g) / (1 - 0.9²) = 0.4737 g
    assert th.allclose(parameter, -0.1 * 1.473684 * th.tensor([[0.5, -0.25], [0.0, 1.0]]), atol=1e-6)


def test_it_learns_to_precondition():
    """A quadratic with curvatures 1 and 1e4, which plain gradient descent cannot bring to 0 in 300 steps."""
    th.manual_seed(0)
    curvature = th.tensor([[1.0, 1e4], [1.0, 1e4]])
    parameter = nn.Parameter(th.ones(2, 2))
    optimizer = Kron([parameter], lr=0.02)
    for _ in range(300):
        optimizer.zero_grad()
        (curvature * parameter.square()).sum().backward()
        optimizer.step()
    assert parameter.abs().max() < 0.1


@pytest.mark.parametrize("wrapped", [False, True])
@pytest.mark.parametrize("name", ["PPO", "DQN", "CChainPPO", "CChainDQN"])
def test_saved_and_loaded_goes_on_as_if_never_stopped(tmp_path, name, wrapped):
    inside = dict(coef=0.1, base_class=Kron, base_kwargs=dict(momentum=0.8)) if wrapped else dict(momentum=0.8)
    policy_kwargs = dict(net_arch=[8, 8], optimizer_class=L2Init if wrapped else Kron, optimizer_kwargs=inside)
    model = make_model(name, env=make_random_env(), policy_kwargs=policy_kwargs)
    model.learn(32).save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", env=make_random_env(), device="cpu")
    if "DQN" in name:
        model.save_replay_buffer(tmp_path / "buffer")
        loaded.load_replay_buffer(tmp_path / "buffer")
    before = [p.clone() for p in model.policy.parameters()]
    for each in (model, loaded):
        go_on(each, None)
    for one, other in zip(model.policy.parameters(), loaded.policy.parameters(), strict=True):
        assert th.equal(one, other)
    assert any(not th.equal(old, p) for old, p in zip(before, model.policy.parameters(), strict=True))


@pytest.mark.parametrize(
    "argument, value",
    [("momentum", 1.5), ("momentum", 1), ("weight_decay", -1), ("update_probability", 2), ("max_size_triangular", 0)],
)
def test_what_it_refuses(argument, value):
    with pytest.raises(ValueError, match=f"`{argument}` must be .* got {value!r}"):
        Kron([nn.Parameter(th.ones(2, 2))], **{argument: value})


def test_it_refuses_the_state_of_adam():
    parameters = [nn.Parameter(th.ones(2, 2))]
    for optimizer in (Kron(parameters), L2Init(parameters, base_class=Kron)):
        before = optimizer.state_dict()
        with pytest.raises(ValueError, match=r"`state_dict` must be that of Kron, got one without precondition_init_scale"):
            optimizer.load_state_dict(th.optim.Adam(parameters).state_dict())
        assert optimizer.state_dict() == before


@pytest.mark.parametrize("missing", ["pytorch_optimizer", "opt_einsum"])
def test_it_says_what_to_install(monkeypatch, missing):
    if missing == "opt_einsum":
        monkeypatch.setattr(th.backends.opt_einsum, "is_available", lambda: False)
    else:
        monkeypatch.setitem(__import__("sys").modules, missing, None)
    with pytest.raises(ImportError, match=r'pip install "sb3-cchain\[psgd\]"'):
        Kron([nn.Parameter(th.ones(2, 2))])


def test_arguments_reach_kron():
    group = Kron([nn.Parameter(th.ones(2, 2))], momentum=0.8, weight_decay=0.3, max_size_triangular=7).param_groups[0]
    assert (group["momentum"], group["weight_decay"], group["max_size_triangular"]) == (0.8, 0.3, 7)
