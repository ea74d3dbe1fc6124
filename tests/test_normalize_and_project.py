"""Normalize-and-project keeps the norms of the hidden weights."""

import pytest
import torch as th
from torch import nn

from sb3_cchain.methods import NormalizeAndProject
from sb3_cchain.networks import LayerNormDQNPolicy, LayerNormPolicy
from tests.method_models import make_model, make_random_env


def test_by_hand():
    hidden, bias, output = nn.Parameter(th.tensor([[3.0, 4.0]])), nn.Parameter(th.ones(1)), nn.Parameter(th.ones(1, 1))
    optimizer = NormalizeAndProject([hidden, bias, output], lr=1.0, n_output_layers=1, base_class=th.optim.SGD)
    assert optimizer.metrics() == {"normalize_and_project/norm": 1.0}
    hidden.grad, bias.grad, output.grad = th.tensor([[-3.0, -4.0]]), -th.ones(1), -th.ones(1, 1)
    optimizer.step()
    # (6, 8), of norm 10, back to 5; the others as they are
    assert hidden.flatten().tolist() == pytest.approx([3, 4])
    assert (bias.item(), output.item()) == (2, 2)
    assert optimizer.metrics() == {"normalize_and_project/norm": 2.0}
    hidden.grad = th.tensor([[3.0, -1.0]])
    optimizer.step()
    assert hidden.flatten().tolist() == pytest.approx([0, 5])


def test_every_so_many_updates():
    weight = nn.Parameter(th.tensor([[2.0]]))
    optimizer = NormalizeAndProject([weight], lr=1.0, n_output_layers=0, interval=3, base_class=th.optim.SGD)
    seen = []
    for _ in range(6):
        weight.grad = th.tensor([[-1.0]])
        optimizer.step()
        seen.append(weight.item())
    assert seen == [3, 4, 2, 3, 4, 2]


def test_zeros_stay():
    weight = nn.Parameter(th.zeros(2, 2))
    optimizer = NormalizeAndProject([weight], lr=1.0, n_output_layers=0, base_class=th.optim.SGD)
    weight.grad = th.zeros(2, 2)
    optimizer.step()
    assert weight.flatten().tolist() == [0, 0, 0, 0] and optimizer.metrics() == {"normalize_and_project/norm": 1.0}


@pytest.mark.parametrize("name", ["PPO", "DQN", "CChainPPO", "CChainDQN"])
def test_the_initial_norms_hold_also_after_loading(tmp_path, name):
    policy, n_output_layers = (LayerNormDQNPolicy, 1) if "DQN" in name else (LayerNormPolicy, 2)
    policy_kwargs = dict(
        net_arch=[8, 8], optimizer_class=NormalizeAndProject, optimizer_kwargs=dict(n_output_layers=n_output_layers)
    )
    model = make_model(name, env=make_random_env(), policy=policy, policy_kwargs=policy_kwargs, learning_rate=0.01)

    def weights(model):
        return [p for p in model.policy.optimizer.parameters() if p.dim() > 1]

    initial = [p.detach().clone() for p in weights(model)]
    model.learn(32).save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", env=make_random_env(), device="cpu").learn(32)
    for each in (model, loaded):
        for index, (weight, first) in enumerate(zip(weights(each), initial, strict=True)):
            is_output = index >= len(initial) - n_output_layers
            assert not th.equal(weight, first)
            assert (weight.norm().item() == pytest.approx(first.norm().item(), rel=1e-5)) != is_output


def test_what_it_refuses():
    parameters = [nn.Parameter(th.ones(2, 2)) for _ in range(3)]
    for arguments in (dict(n_output_layers=-1), dict(n_output_layers=0, interval=0), dict(n_output_layers=0, interval=1.5)):
        with pytest.raises(ValueError, match=r"`(n_output_layers|interval)` must be an integer"):
            NormalizeAndProject(parameters, **arguments)
    for n_output_layers in (3, 4, 5):
        with pytest.raises(
            ValueError, match=f"`n_output_layers` must leave a weight matrix to project, got {n_output_layers}"
        ):
            NormalizeAndProject(parameters, n_output_layers=n_output_layers)


def test_convolutions_are_projected():
    convolution, output = nn.Parameter(th.full((1, 1, 1, 1), 2.0)), nn.Parameter(th.ones(1, 1))
    optimizer = NormalizeAndProject([convolution, output], lr=1.0, n_output_layers=1, base_class=th.optim.SGD)
    convolution.grad = -th.ones_like(convolution)
    optimizer.step()
    assert convolution.item() == 2.0
