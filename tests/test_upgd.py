"""Utility-based perturbed gradient descent: gates, noise, utilities."""

import math

import pytest
import torch as th
from stable_baselines3 import SAC
from torch import nn

from sb3_cchain.methods import UPGD
from sb3_cchain.methods.fresh_policy import fresh_policy
from sb3_cchain.methods.layer_reset import reset_layers
from tests.method_models import OFF_POLICY, make_model, make_random_env


def logistic(x):
    return 1 / (1 + math.exp(-x))


def test_by_hand():
    weights, frozen = nn.Parameter(th.tensor([2.0, -1.0])), nn.Parameter(th.ones(3))
    settings = dict(beta=0.5, sigma=0.0, weight_decay=0.1, base_class=th.optim.SGD)
    optimizer = UPGD([weights, frozen], lr=0.1, **settings)
    assert optimizer.metrics() == {"upgd/greatest_utility": 0.0}
    weights.grad = th.tensor([-1.0, -1.0])
    optimizer.step()
    # u = 0.5 · (2, -1), the greatest is 1; divided by 1 - β: (2, -1)
    expected = [2 * 0.99 + 2 * (1 - logistic(2)) * 0.1, -0.99 + 2 * (1 - logistic(-1)) * 0.1]
    assert weights.tolist() == pytest.approx(expected, rel=1e-6)
    assert frozen.tolist() == [1, 1, 1]
    assert optimizer.metrics() == {"upgd/greatest_utility": 1.0}


def test_equals_the_adaptive_form_written_out():
    generator = th.Generator().manual_seed(0)
    weights = [nn.Parameter(th.randn(shape, generator=generator, dtype=th.float64)) for shape in [(3, 2), (3,)]]
    written_out = [w.detach().clone() for w in weights]
    lr, sigma, beta, decay = 0.01, 0.1, 0.9, 0.2
    optimizer = UPGD(weights, lr=lr, sigma=sigma, beta=beta, weight_decay=decay, base_kwargs=dict(eps=1e-5))
    utility, first, second = ([th.zeros_like(w) for w in weights] for _ in range(3))
    for t in range(1, 6):
        gradients = [th.randn(w.shape, generator=generator, dtype=th.float64) for w in weights]
        for w, g in zip(weights, gradients, strict=True):
            w.grad = g.clone()
        th.manual_seed(t)
        optimizer.step()
        th.manual_seed(t)
        for i, g in enumerate(gradients):
            utility[i] = beta * utility[i] - (1 - beta) * g * written_out[i]
            first[i] = 0.9 * first[i] + 0.1 * g
            second[i] = 0.999 * second[i] + 0.001 * g**2
        greatest = max(u.max() for u in utility)
        for i, w in enumerate(written_out):
            useless = 1 - th.sigmoid(utility[i] / (1 - beta**t) / greatest)
            adam = first[i] / (1 - 0.9**t) / ((second[i] / (1 - 0.999**t)).sqrt() + 1e-5)
            noise = sigma * th.randn_like(w)
            written_out[i] = w * (1 - lr * decay) - 2 * lr * useless * (adam + noise)
    assert all(th.allclose(one, other, rtol=1e-10, atol=0) for one, other in zip(weights, written_out, strict=True))


def test_without_a_positive_utility_it_is_the_base_with_noise():
    weights = nn.Parameter(th.ones(10_000))
    optimizer = UPGD([weights], lr=0.1, sigma=0.5, weight_decay=0.0, base_class=th.optim.SGD)
    weights.grad = th.ones_like(weights)
    optimizer.step()
    assert weights.mean().item() == pytest.approx(0.9, abs=0.005)
    assert weights.std().item() == pytest.approx(0.05, rel=0.05)
    weights.grad = th.zeros_like(weights)  # not a number where utilities are divided by 0
    UPGD([weights], base_class=th.optim.SGD).step()
    assert weights.isfinite().all()


def test_utilities_are_reset_with_the_moments():
    def utility(name):
        return model.policy.optimizer.state.get(model.policy.get_parameter(name), {}).get("utility")

    policy_kwargs = dict(net_arch=[8, 8], optimizer_class=UPGD)
    model = make_model("PPO", env=make_random_env(), policy_kwargs=policy_kwargs).learn(16)
    hidden, output = "mlp_extractor.policy_net.2.weight", "action_net.weight"
    kept = utility(hidden).clone()
    reset_layers(model.policy, fresh_policy(model), 1)
    assert utility(output) is None and th.equal(utility(hidden), kept)
    model.learn(16)
    assert utility(output).any()


def test_with_sac():
    policy_kwargs = dict(net_arch=[8], optimizer_class=UPGD)
    model = SAC("MlpPolicy", "Pendulum-v1", device="cpu", **{**OFF_POLICY, "policy_kwargs": policy_kwargs}).learn(20)
    for optimizer in (model.actor.optimizer, model.critic.optimizer):
        assert all(optimizer.state[p]["n_utility_updates"] == 12 for p in optimizer.parameters())
        assert all(p.isfinite().all() for p in optimizer.parameters())


@pytest.mark.parametrize("argument, value", [("sigma", -1), ("beta", 1), ("beta", -0.1), ("weight_decay", -1)])
def test_what_it_refuses(argument, value):
    with pytest.raises(ValueError, match=f"`{argument}` must be .* got {value!r}"):
        UPGD([nn.Parameter(th.ones(2))], **{argument: value})
