"""The residual networks of SimBa in the policies of PPO, DQN and SAC."""

import pytest
import torch as th
from stable_baselines3 import PPO, SAC

from sb3_cchain import CChainSAC
from sb3_cchain.networks import SimBaDQNPolicy, SimBaPolicy, SimBaSACPolicy
from sb3_cchain.networks.simba import SimBaTrunk
from tests.method_models import OFF_POLICY, make_model, make_random_env

BLOCK = ["LayerNorm", "Linear", "ReLU", "Linear"]


def kinds(trunk):
    return [type(each).__name__ for each in trunk.modules() if not list(each.children())]


def test_by_hand():
    trunk = SimBaTrunk(1, [2])
    first, block, _ = trunk
    _, wide, _, narrow = block.residual
    assert (wide.weight.shape, narrow.weight.shape) == ((8, 2), (2, 8))
    with th.no_grad():
        first.weight.copy_(th.tensor([[3.0], [1.0]]))
        for layer in (wide, narrow):
            layer.weight.zero_()
        wide.weight[0, 0] = 2.0
        narrow.weight[1, 0] = 5.0
    # (3, 1), normalised (1, -1); one unit of 2 adds 10 to the second: (3, 11), normalised (-1, 1)
    assert block(first(th.ones(1, 1))).tolist()[0] == pytest.approx([3, 11], abs=1e-3)
    assert trunk(th.ones(1, 1)).tolist()[0] == pytest.approx([-1, 1], abs=1e-3)


def test_initialisation():
    trunk = SimBaTrunk(64, [256, 256])
    assert th.allclose(trunk[0].weight.T @ trunk[0].weight, th.eye(64), atol=1e-5)
    for _, wide, _, narrow in (trunk[1].residual, trunk[2].residual):
        assert wide.weight.std().item() == pytest.approx((2 / 256) ** 0.5, rel=0.05)
        assert narrow.weight.std().item() == pytest.approx((2 / 1024) ** 0.5, rel=0.05)
    assert all(not p.any() for name, p in trunk.named_parameters() if "bias" in name)


@pytest.mark.parametrize("net_arch, pi, vf", [(dict(pi=[8], vf=[6, 6]), [8], [6, 6]), ([4, 4], [4, 4], [4, 4])])
def test_of_ppo(net_arch, pi, vf):
    policy = make_model("PPO", make_random_env(), SimBaPolicy, policy_kwargs=dict(net_arch=net_arch)).policy
    for trunk, widths in ((policy.mlp_extractor.policy_net, pi), (policy.mlp_extractor.value_net, vf)):
        assert kinds(trunk) == ["Linear", *BLOCK * len(widths), "LayerNorm"]
        assert trunk[0].out_features == widths[0]
        # SB3's `ortho_init` would give it a gain of √2
        assert th.linalg.matrix_norm(trunk[0].weight, 2).item() == pytest.approx(1, rel=1e-5)
    assert policy.action_net.in_features == pi[0] and policy.value_net.in_features == vf[0]


def test_defaults():
    policy = PPO(SimBaPolicy, make_random_env(), device="cpu").policy
    assert policy.mlp_extractor.latent_dim_pi == 128 and len(policy.mlp_extractor.policy_net) == 3
    assert policy.mlp_extractor.latent_dim_vf == 512 and len(policy.mlp_extractor.value_net) == 4


@pytest.mark.parametrize("name", ["DQN", "CChainDQN"])
def test_of_dqn(name):
    model = make_model(name, make_random_env(), SimBaDQNPolicy, policy_kwargs=dict(net_arch=[8, 8]))
    for network in (model.q_net, model.q_net_target):
        trunk, output = network.q_net
        assert kinds(trunk) == ["Linear", *BLOCK, *BLOCK, "LayerNorm"] and output.out_features == 3
    model.learn(32)
    state = model.q_net_target.state_dict()
    assert any(not th.equal(value, state[key]) for key, value in model.q_net.state_dict().items())


@pytest.mark.parametrize("algorithm", [SAC, CChainSAC])
@pytest.mark.parametrize("net_arch", [dict(pi=[8], qf=[6, 6]), [8, 8]])
def test_of_sac(tmp_path, algorithm, net_arch):
    settings = {**OFF_POLICY, "policy_kwargs": dict(net_arch=net_arch)}
    model = algorithm(SimBaSACPolicy, "Pendulum-v1", device="cpu", seed=0, **settings)
    pi, qf = (net_arch["pi"], net_arch["qf"]) if isinstance(net_arch, dict) else (net_arch, net_arch)
    assert kinds(model.actor.latent_pi) == ["Linear", *BLOCK * len(pi), "LayerNorm"]
    for critic in (model.critic, model.critic_target):
        for index, network in enumerate(critic.q_networks):
            assert network is getattr(critic, f"qf{index}")
            assert kinds(network) == ["Linear", *BLOCK * len(qf), "LayerNorm", "Linear"]
            assert network[0][0].in_features == 3 + 1
    held = {id(p) for o in (model.actor.optimizer, model.critic.optimizer) for p in o.param_groups[0]["params"]}
    assert held == {id(p) for module in (model.actor, model.critic) for p in module.parameters()}
    assert all(map(th.equal, model.critic.parameters(), model.critic_target.parameters()))
    trained = [*model.actor.parameters(), *model.critic.parameters()]
    before = [p.clone() for p in trained]
    model.learn(24).save(tmp_path / "model")
    assert all(not th.equal(p, q) for p, q in zip(before, trained, strict=True))
    loaded = algorithm.load(tmp_path / "model", device="cpu").policy.state_dict()
    assert all(th.equal(value, loaded[key]) for key, value in model.policy.state_dict().items())


@pytest.mark.parametrize(
    "name, policy, net_arch",
    [
        ("PPO", SimBaPolicy, dict(pi=[], vf=[8])),
        ("PPO", SimBaPolicy, dict(pi=[8])),
        ("PPO", SimBaPolicy, [8, 6]),
        ("DQN", SimBaDQNPolicy, [8, 6]),
    ],
)
def test_what_it_refuses(name, policy, net_arch):
    with pytest.raises(ValueError, match="`net_arch` must give each network one width or more, all the same"):
        make_model(name, make_random_env(), policy, policy_kwargs=dict(net_arch=net_arch))


def test_widths_of_simba_are_the_papers():
    model = SAC(SimBaSACPolicy, "Pendulum-v1", buffer_size=10, device="cpu")
    assert model.actor.latent_pi[0].out_features == 128
    assert [network[0][0].out_features for network in model.critic.q_networks] == [512, 512]
