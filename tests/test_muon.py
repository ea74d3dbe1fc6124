"""Muon updates the hidden weight matrices, Adam all else."""

import pytest
import torch as th
from stable_baselines3 import A2C, DQN, PPO, SAC
from torch import nn

from sb3_cchain.methods import L2Init, Muon
from sb3_cchain.methods.adam_rel import reset_step_count
from sb3_cchain.networks import MinAtarCNN
from tests.envs import RandomEnv
from tests.method_models import OFF_POLICY, ON_POLICY, make_model, make_random_env

ADAM = dict(base_kwargs=dict(eps=1e-5))


def test_by_hand():
    matrix, bias, output = nn.Parameter(th.zeros(2, 8)), nn.Parameter(th.zeros(2)), nn.Parameter(th.zeros(3, 2))
    optimizer = Muon([matrix, bias, output], lr=0.1, n_output_layers=1)
    generator = th.Generator().manual_seed(0)
    for parameter in (matrix, bias, output):
        parameter.grad = th.randn(parameter.shape, generator=generator)
    optimizer.step()
    # 0.2 · η · √8 · U Vᵀ. Newton-Schulz leaves the singular values between 0.5 and 1.5, nearly
    u, _, v = th.linalg.svd(matrix.grad, full_matrices=False)
    singular_values = (u.T @ matrix @ v.T).diagonal() / (-0.2 * 0.1 * 8**0.5)
    assert ((singular_values > 0.5) & (singular_values < 1.5)).all()
    assert (u.T @ matrix @ v.T - (u.T @ matrix @ v.T).diagonal().diag()).abs().max() < 1e-3
    # Adam's first step
    assert bias.tolist() == pytest.approx((-0.1 * bias.grad.sign()).tolist(), rel=1e-5)
    assert th.allclose(output, -0.1 * output.grad.sign(), rtol=1e-5)
    assert optimizer.metrics() == {"muon/share": 16 / (16 + 2 + 6)}


def test_parts_are_as_on_their_own():
    """Muon of torch on the matrices, Adam on the others, with SB3's changes of the learning rate."""
    pairs = [[nn.Parameter(th.ones(shape)) for shape in [(3, 4), (3,), (2, 3)]] for _ in range(2)]
    together = Muon(pairs[0], lr=0.1, n_output_layers=1, lr_factor=0.5, weight_decay=0.3, nesterov=False, **ADAM)
    settings = dict(momentum=0.95, weight_decay=0.3, nesterov=False, adjust_lr_fn="match_rms_adamw")
    muon, adam = th.optim.Muon(pairs[1][:1], lr=0.05, **settings), th.optim.Adam(pairs[1][1:], lr=0.1, eps=1e-5)
    generator = th.Generator().manual_seed(0)
    for lr in (0.1, 0.02, 0.003):
        for one, other in zip(*pairs, strict=True):
            one.grad = th.randn(one.shape, generator=generator)
            other.grad = one.grad.clone()
        for optimizer, factor in ((together, 1), (adam, 1), (muon, 0.5)):
            optimizer.param_groups[0]["lr"] = lr * factor
            optimizer.step()
    assert all(map(th.equal, *pairs))
    assert together.param_groups[0]["lr"] == 0.003


def names_of_matrices(policy, optimizer):
    ids = {id(matrix) for matrix in optimizer.matrices()}
    return [name.removesuffix(".weight") for name, p in policy.named_parameters() if id(p) in ids]


ACTOR_CRITIC = [f"mlp_extractor.{net}.{index}" for net in ("policy_net", "value_net") for index in (0, 2)]


@pytest.mark.parametrize(
    "algorithm, env, n_output_layers, expected",
    [
        (PPO, "CartPole-v1", 2, ACTOR_CRITIC),
        (A2C, "Pendulum-v1", 2, ACTOR_CRITIC),  # log_std is a vector
        (DQN, "CartPole-v1", 1, ["q_net.q_net.0", "q_net.q_net.2"]),
    ],
)
def test_what_muon_gets(algorithm, env, n_output_layers, expected):
    policy_kwargs = dict(net_arch=[8, 8], optimizer_class=Muon, optimizer_kwargs=dict(n_output_layers=n_output_layers))
    model = algorithm("MlpPolicy", env, policy_kwargs=policy_kwargs, device="cpu")
    assert names_of_matrices(model.policy, model.policy.optimizer) == expected


def test_what_muon_gets_of_sac_and_trains():
    policy_kwargs = dict(net_arch=[8, 8], optimizer_class=Muon, optimizer_kwargs=dict(n_output_layers=2))
    model = SAC("MlpPolicy", "Pendulum-v1", device="cpu", **{**OFF_POLICY, "policy_kwargs": policy_kwargs})
    actor, critic = model.policy.actor, model.policy.critic
    assert names_of_matrices(actor, actor.optimizer) == ["latent_pi.0", "latent_pi.2"]
    assert names_of_matrices(critic, critic.optimizer) == ["qf0.0", "qf0.2", "qf1.0"]
    before = [p.clone() for p in [*actor.parameters(), *critic.parameters()]]
    model.learn(20)
    assert all(not th.equal(p, q) for p, q in zip(before, [*actor.parameters(), *critic.parameters()], strict=True))


def test_convolutions_are_adams():
    from gymnasium import spaces

    env = RandomEnv(spaces.Box(0, 1, (5, 5, 2)))
    policy_kwargs = dict(features_extractor_class=MinAtarCNN, net_arch=[], optimizer_class=Muon)
    policy_kwargs["optimizer_kwargs"] = dict(n_output_layers=2)
    model = PPO("CnnPolicy", env, device="cpu", **{**ON_POLICY, "policy_kwargs": policy_kwargs})
    assert names_of_matrices(model.policy, model.policy.optimizer) == ["features_extractor.linear.0"]
    model.learn(16)


@pytest.mark.parametrize("name", ["PPO", "DQN", "CChainPPO", "CChainDQN"])
def test_inside_another_wrapper_saved_and_loaded(tmp_path, name):
    inside = dict(base_class=Muon, base_kwargs=dict(n_output_layers=1 if "DQN" in name else 2, **ADAM))
    policy_kwargs = dict(net_arch=[8, 8], optimizer_class=L2Init, optimizer_kwargs=dict(coef=0.1, **inside))
    model = make_model(name, env=make_random_env(), policy_kwargs=policy_kwargs, learning_rate=lambda left: 0.01 * left)
    model.learn(32).save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", env=make_random_env(), device="cpu")
    states = [each.policy.optimizer.state_dict()["state"] for each in (model, loaded)]
    weight = model.policy.optimizer.base.matrices()[0]
    assert model.policy.optimizer.state[weight].keys() == {"momentum_buffer", "step"}
    for key, state in states[0].items():
        assert all(th.equal(value, states[1][key][each]) for each, value in state.items() if th.is_tensor(value))


def test_adam_rel_restarts_the_count():
    matrix, bias = nn.Parameter(th.ones(2, 2)), nn.Parameter(th.ones(2))
    optimizer = Muon([matrix, bias], n_output_layers=0)
    for parameter in (matrix, bias):
        parameter.grad = th.ones_like(parameter)
    optimizer.step()
    assert [int(optimizer.state[p]["step"]) for p in (matrix, bias)] == [1, 1]
    assert reset_step_count(optimizer)
    assert [int(optimizer.state[p]["step"]) for p in (matrix, bias)] == [0, 0]


@pytest.mark.parametrize(
    "argument, value",
    [
        ("n_output_layers", 1.5),
        ("lr_factor", -1),
        ("momentum", 1.5),
        ("momentum", 1),
        ("nesterov", "yes"),
        ("weight_decay", -0.1),
    ],
)
def test_what_it_refuses(argument, value):
    with pytest.raises((ValueError, TypeError), match=f"`{argument}` must be .* got {value!r}"):
        Muon([nn.Parameter(th.ones(2, 2))], **{"n_output_layers": 0, argument: value})


def test_there_must_be_a_matrix():
    for parameters, n_output_layers in (([th.ones(2, 2)], 1), ([th.ones(1, 2), th.ones(2)], 0)):
        with pytest.raises(
            ValueError, match=f"`n_output_layers` must leave a matrix of several rows to Muon, got {n_output_layers}"
        ):
            Muon(list(map(nn.Parameter, parameters)), n_output_layers=n_output_layers)
