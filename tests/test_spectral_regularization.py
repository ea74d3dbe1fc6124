"""Spectral regularisation holds the greatest singular value near 1."""

import pytest
import torch as th
from stable_baselines3 import SAC
from torch import nn

from sb3_cchain.methods import SpectralRegularization
from tests.method_models import OFF_POLICY, make_model, make_random_env


def test_by_hand():
    weight, bias = nn.Parameter(th.diag(th.tensor([2.0, 0.1]))), nn.Parameter(th.ones(2))
    convolution = nn.Parameter(th.tensor([[[[0.0]], [[3.0]]]]))  # one filter: the row (0, 3)
    optimizer = SpectralRegularization([convolution, weight, bias], coef=0.5)
    optimizer.zero_grad()
    # 2 k (σ² - 1) σ, halved: of 2 12, of 3 48
    assert weight.grad.flatten().tolist() == pytest.approx([12, 0, 0, 0], abs=1e-5)
    assert convolution.grad.flatten().tolist() == pytest.approx([0, 48])
    assert bias.grad is None
    assert optimizer.metrics() == {"spectral_regularization/loss": pytest.approx(0.5 * (3**2 + 8**2))}


@pytest.mark.parametrize("power", [1, 2, 3])
def test_the_gradient_is_autograds(power):
    th.manual_seed(0)
    weights = [nn.Parameter(th.randn(shape, dtype=th.float64)) for shape in [(5, 3), (4, 5), (1, 4)]]
    optimizer = SpectralRegularization(weights, coef=0.1, power=power)
    for _ in range(300):  # until the power iteration has found the vectors
        optimizer.zero_grad()
    loss = 0.1 * sum((th.linalg.matrix_norm(w, 2) ** power - 1) ** 2 for w in weights)
    for weight, expected in zip(weights, th.autograd.grad(loss, weights), strict=True):
        assert th.allclose(weight.grad, expected, rtol=1e-6)


def test_it_draws_the_singular_values_to_1():
    th.manual_seed(0)
    weights = [nn.Parameter(th.randn(4, 3)), nn.Parameter(0.1 * th.randn(2, 6))]
    optimizer = SpectralRegularization(weights, lr=0.01, coef=1.0)
    for _ in range(1500):
        optimizer.zero_grad()
        optimizer.step()
    assert [th.linalg.matrix_norm(w, 2).item() for w in weights] == pytest.approx([1, 1], abs=0.05)


@pytest.mark.parametrize("name", ["PPO", "DQN", "CChainPPO", "CChainDQN"])
def test_the_vectors_are_saved(tmp_path, name):
    policy_kwargs = dict(net_arch=[8, 8], optimizer_class=SpectralRegularization)
    model = make_model(name, env=make_random_env(), policy_kwargs=policy_kwargs).learn(32)
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", env=make_random_env(), device="cpu")
    vectors, loaded_vectors = (each.policy.optimizer.own_state["vectors"] for each in (model, loaded))
    assert len(vectors) == (3 if "DQN" in name else 6) and all(map(th.equal, vectors, loaded_vectors))


def test_with_sac():
    policy_kwargs = dict(net_arch=[8], optimizer_class=SpectralRegularization)
    model = SAC("MlpPolicy", "Pendulum-v1", device="cpu", **{**OFF_POLICY, "policy_kwargs": policy_kwargs}).learn(20)
    assert model.actor.optimizer.penalty() > 0 and model.critic.optimizer.penalty() > 0


@pytest.mark.parametrize("argument, value", [("coef", -1), ("power", 0), ("power", 1.5)])
def test_what_it_refuses(argument, value):
    with pytest.raises(ValueError, match=f"`{argument}` must be .* got {value!r}"):
        SpectralRegularization([nn.Parameter(th.ones(2, 2))], **{argument: value})
