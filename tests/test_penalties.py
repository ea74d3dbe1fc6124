"""Penalties left behind by zero_grad equal penalties written into the loss."""

import pytest
import torch as th
from gymnasium.spaces import Box, Discrete
from stable_baselines3 import PPO
from stable_baselines3.common.utils import set_random_seed
from torch import nn

from sb3_cchain.methods import L2Init, Parseval
from sb3_cchain.networks import LayerNormPolicy
from tests.envs import RandomEnv
from tests.sb3_source import rewritten

COEF = 0.3


LOSS = "loss = policy_loss + self.ent_coef * entropy_loss + self.vf_coef * value_loss"


class WrittenOutPPO(PPO):
    """SB3's, with a penalty in its loss."""

    train = rewritten(PPO.train, (LOSS, f"{LOSS} + self.penalty()"))

    def penalty(self):
        return COEF * PENALTIES[self.kind][1](list(self.policy.parameters()), self.initial)


def parseval(parameters, initial):
    *weights, _, _ = [p for p in parameters if p.dim() == 2]  # action_net and value_net come last
    return sum(((w @ w.T - 2 * th.eye(len(w))) ** 2).sum() for w in weights)


PENALTIES = {
    "l2_init": (
        (L2Init, {}),
        lambda parameters, initial: sum(((p - q) ** 2).sum() for p, q in zip(parameters, initial, strict=True)),
    ),
    "l2": ((L2Init, dict(towards="zero")), lambda parameters, initial: sum((p**2).sum() for p in parameters)),
    "mean": (
        (L2Init, dict(reduction="mean")),
        lambda parameters, initial: (
            (nn.utils.parameters_to_vector(parameters) - nn.utils.parameters_to_vector(initial)) ** 2
        ).mean(),
    ),
    "parseval": ((Parseval, dict(n_output_layers=2)), parseval),
}


@pytest.mark.parametrize("kind", ["l2_init", "l2"])  # autograd rounds the others differently
@pytest.mark.parametrize("env_id, max_grad_norm", [("CartPole-v1", 0.5), ("CartPole-v1", 0.05), ("Pendulum-v1", 0.05)])
def test_equals_sb3_source_with_the_penalty_in_its_loss(kind, env_id, max_grad_norm):
    settings = dict(
        n_steps=64, batch_size=16, n_epochs=3, learning_rate=3e-3, max_grad_norm=max_grad_norm, seed=0, device="cpu"
    )
    (cls, arguments), _ = PENALTIES[kind]
    written_out = WrittenOutPPO("MlpPolicy", env_id, policy_kwargs=dict(net_arch=[8]), **settings)
    written_out.kind = kind
    written_out.initial = [p.detach().clone() for p in written_out.policy.parameters()]
    optimizer_kwargs = dict(coef=COEF, base_kwargs=dict(eps=1e-5), **arguments)
    policy_kwargs = dict(net_arch=[8], optimizer_class=cls, optimizer_kwargs=optimizer_kwargs)
    model = PPO("MlpPolicy", env_id, policy_kwargs=policy_kwargs, **settings)
    plain = PPO("MlpPolicy", env_id, policy_kwargs=dict(net_arch=[8]), **settings)
    for each in (written_out, model, plain):
        set_random_seed(0)
        each.env.seed(0)
        each.learn(3 * 64)
    parameters, expected, without = (
        nn.utils.parameters_to_vector(each.policy.parameters()) for each in (model, written_out, plain)
    )
    assert th.equal(parameters, expected)
    assert (parameters - without).abs().max() > 1e-4


@pytest.mark.parametrize("kind", PENALTIES)
def test_gradients_are_autograds(kind):
    (cls, arguments), penalty = PENALTIES[kind]
    generator = th.Generator().manual_seed(0)
    shapes = [(2,), (5, 3), (5,), (4, 5), (4,), (2, 4), (1, 4)]
    parameters = [nn.Parameter(th.randn(shape, generator=generator, dtype=th.float64)) for shape in shapes]
    optimizer = cls(parameters, coef=COEF, **arguments)
    optimizer.zero_grad()
    initial = [p.detach().clone() for p in parameters]
    with th.no_grad():
        for parameter in parameters:
            parameter.add_(th.randn(parameter.shape, generator=generator, dtype=th.float64))
    optimizer.zero_grad()
    loss = COEF * penalty(parameters, initial)
    for parameter, expected in zip(parameters, th.autograd.grad(loss, parameters, allow_unused=True), strict=True):
        if expected is None:
            assert parameter.grad is None
        else:
            assert th.allclose(parameter.grad, expected, rtol=1e-12, atol=0)
    assert optimizer.metrics()[f"{cls.name}/loss"] == pytest.approx(loss.item(), rel=1e-12)


def test_l2_init_without_normalisations_by_hand():
    """log_std, a layer of 1 unit with a LayerNorm, and an output layer, all of one entry, which moves by 2."""
    shapes = [(1,), (1, 1), (1,), (1,), (1,), (1, 1), (1,)]
    for reduction, loss in (("sum", 0.5 * 5 * 4), ("mean", 0.5 * 4)):
        parameters = [th.nn.Parameter(th.zeros(shape)) for shape in shapes]
        optimizer = L2Init(parameters, lr=1.0, coef=0.5, reduction=reduction, exclude_norms=True)
        optimizer.reference()
        with th.no_grad():
            for parameter in parameters:
                parameter += 2
        assert optimizer.metrics() == {"l2_init/loss": loss, "l2_init/distance": pytest.approx(20**0.5)}
        optimizer.zero_grad()
        gradient = 2 * 0.5 * 2 / (5 if reduction == "mean" else 1)
        found = [None if p.grad is None else p.grad.item() for p in parameters]
        assert found == [pytest.approx(gradient)] * 3 + [None, None] + [pytest.approx(gradient)] * 2


def test_l2_init_leaves_out_the_norms_of_a_policy():
    for policy, action_space in ((LayerNormPolicy, Discrete(2)), (LayerNormPolicy, Box(-1, 1, (2,)))):
        kwargs = dict(optimizer_class=L2Init, optimizer_kwargs=dict(exclude_norms=True), net_arch=[8, 8])
        model = PPO(policy, RandomEnv(action_space=action_space), policy_kwargs=kwargs, device="cpu")
        norms = {id(p) for m in model.policy.modules() if isinstance(m, nn.LayerNorm) for p in m.parameters()}
        optimizer = model.policy.optimizer
        assert len(norms) == 8
        assert {id(p) for p in optimizer.parameters()} - {id(p) for p in optimizer._penalised()} == norms


def test_l2_init_by_hand():
    parameter = nn.Parameter(th.tensor([1.0, 2.0]))
    frozen = nn.Parameter(th.tensor([5.0]), requires_grad=False)
    optimizer = L2Init([parameter, frozen], lr=0.1, coef=0.5, base_class=th.optim.SGD)
    optimizer.zero_grad()
    assert parameter.grad.tolist() == [0, 0]
    with th.no_grad():
        parameter.add_(th.tensor([3.0, 4.0]))
    optimizer.zero_grad()
    assert parameter.grad.tolist() == [3, 4]  # 2 · 0.5 · (θ - θ₀)
    assert frozen.grad is None
    assert optimizer.metrics() == {"l2_init/loss": 12.5, "l2_init/distance": 5.0}
    optimizer.step()
    assert parameter.tolist() == pytest.approx([4 - 0.3, 6 - 0.4])


@pytest.mark.parametrize("reduction, gradient, loss", [("sum", [3, 4, 0], 12.5), ("mean", [1, 4 / 3, 0], 12.5 / 3)])
def test_plain_l2_by_hand(reduction, gradient, loss):
    parameters = [nn.Parameter(th.tensor([3.0, 4.0])), nn.Parameter(th.zeros(1))]
    optimizer = L2Init(parameters, coef=0.5, towards="zero", reduction=reduction)
    optimizer.zero_grad()
    assert [*parameters[0].grad.tolist(), parameters[1].grad.item()] == pytest.approx(gradient)
    assert optimizer.metrics() == {"l2_init/loss": pytest.approx(loss), "l2_init/distance": 5.0}


def test_initial_parameters_are_those_of_the_first_update():
    """Some policies initialise their weights after they made the optimiser, and SB3 loads and moves them later still."""
    parameter = nn.Parameter(th.zeros(2))
    optimizer = L2Init([parameter], coef=1.0)
    with th.no_grad():
        parameter.fill_(1.0)
    optimizer.zero_grad()
    assert optimizer.reference()[0].tolist() == [1, 1]


def test_parseval_by_hand():
    hidden, output = nn.Parameter(th.tensor([[1.0, 1.0], [0.0, 2.0]])), nn.Parameter(th.ones(1, 2))
    convolution = nn.Parameter(th.tensor([[[[3.0]], [[0.0]]]]))  # one filter: the row (3, 0)
    bias = nn.Parameter(th.ones(2))
    optimizer = Parseval([convolution, hidden, bias, output], n_output_layers=1, coef=0.5)
    optimizer.zero_grad()
    # W Wᵀ - 2 I = [[0, 2], [2, 2]], of squared norm 12, with gradient 4 (W Wᵀ - 2 I) W; the convolution's: 9 - 2
    assert optimizer.metrics() == {"parseval/loss": 0.5 * (12 + 49)}
    assert hidden.grad.tolist() == [[0, 8], [4, 12]]
    assert convolution.grad.flatten().tolist() == [0.5 * 4 * 7 * 3, 0]
    assert bias.grad is None and output.grad is None


def test_orthogonal_initialisation_has_no_parseval_loss():
    weight = nn.Parameter(nn.init.orthogonal_(th.empty(6, 6), gain=2**0.5))
    assert Parseval([weight], n_output_layers=0).metrics()["parseval/loss"] < 1e-10


def test_parseval_of_another_scale():
    weight = nn.Parameter(nn.init.orthogonal_(th.empty(6, 6), gain=3.0))
    assert Parseval([weight], n_output_layers=0, scale=9.0).metrics()["parseval/loss"] < 1e-8


def test_penalties_add_up():
    weight = nn.Parameter(th.tensor([[2.0]]))
    inside = dict(base_class=Parseval, base_kwargs=dict(coef=1.0, n_output_layers=0))
    L2Init([weight], coef=0.5, towards="zero", **inside).zero_grad()
    assert weight.grad.item() == 2 * 0.5 * 2 + 4 * (4 - 2) * 2
