"""LayerNorm, CReLU and deep Fourier features in SB3's MLP policies, LayerNorm in the MinAtar network."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.torch_layers import CombinedExtractor
from torch import nn

from sb3_cchain import CChainDQN, CChainPPO
from sb3_cchain.networks import (
    CReLU,
    CReLUDQNPolicy,
    CReLUPolicy,
    FourierDQNPolicy,
    FourierFeatures,
    FourierPolicy,
    LayerNormDQNPolicy,
    LayerNormPolicy,
)
from sb3_cchain.networks.evaluation_mode import has_training_mode
from sb3_cchain.networks.extractors import MinAtarCNN
from tests.envs import RandomEnv
from tests.method_models import OFF_POLICY, ON_POLICY

BOX = spaces.Box(-1, 1, (2,), np.float32)
DICT = spaces.Dict({"a": spaces.Box(-1, 1, (2,), np.float32), "b": spaces.Discrete(3)})


def make(algorithm, policy, observation_space=None, action_space=None, **policy_kwargs):
    settings = OFF_POLICY if issubclass(algorithm, DQN) else ON_POLICY
    env = RandomEnv(observation_space, action_space)
    return algorithm(policy, env, seed=0, device="cpu", **{**settings, "policy_kwargs": policy_kwargs})


def kinds(network):
    return [(type(module).__name__, *(tuple(p.shape) for p in module.parameters())) for module in network]


def test_crelu_by_hand():
    assert CReLU()(th.tensor([[1.0, -2.0, 0.0]])).tolist() == [[1.0, 0.0, 0.0, 0.0, 2.0, 0.0]]
    assert CReLU()(th.zeros(2, 3, 4, 4)).shape == (2, 6, 4, 4)


def test_fourier_features_by_hand():
    features = FourierFeatures()(th.tensor([[0.0, th.pi / 6, -th.pi / 2]]))
    assert features.flatten().tolist() == pytest.approx([0, 0.5, -1, 1, 0.75**0.5, 0], abs=1e-6)
    assert FourierFeatures()(th.zeros(2, 3, 4, 4)).shape == (2, 6, 4, 4)


@pytest.mark.parametrize(
    "net_arch, pi, vf", [(None, [64, 64], [64, 64]), ([5, 6], [5, 6], [5, 6]), (dict(pi=[5], vf=[6, 7]), [5], [6, 7])]
)
def test_layers_of_actor_and_critic(net_arch, pi, vf):
    model = make(PPO, LayerNormPolicy, net_arch=net_arch, activation_fn=nn.ReLU)
    extractor = model.policy.mlp_extractor
    for network, widths in [(extractor.policy_net, pi), (extractor.value_net, vf)]:
        expected, n_inputs = [], 4
        for width in widths:
            expected += [("Linear", (width, n_inputs), (width,)), ("LayerNorm", (width,), (width,)), ("ReLU",)]
            n_inputs = width
        assert kinds(network) == expected
    assert extractor.latent_dim_pi == pi[-1] == model.policy.action_net.in_features
    assert extractor.latent_dim_vf == vf[-1] == model.policy.value_net.in_features
    # SB3's initialisation, of gain √2
    weight = extractor.policy_net[0].weight
    assert th.allclose(weight.T @ weight, 2 * th.eye(4), atol=1e-5)


def test_layer_norm_by_hand():
    """As the linear map's outputs normalised over the units, before the activation."""
    policy = make(PPO, LayerNormPolicy, net_arch=[6]).policy
    inputs = th.randn(3, 4)
    outputs = policy.mlp_extractor.policy_net[0](inputs)
    deviations = outputs - outputs.mean(dim=1, keepdim=True)
    expected = (deviations / (deviations.square().mean(dim=1, keepdim=True) + 1e-5).sqrt()).tanh()
    assert th.allclose(policy.mlp_extractor.forward_actor(inputs), expected, atol=1e-6)


def test_layers_of_a_q_network():
    policy = make(DQN, LayerNormDQNPolicy, net_arch=[5, 6]).policy
    assert (
        kinds(policy.q_net.q_net)
        == kinds(policy.q_net_target.q_net)
        == [
            ("Linear", (5, 4), (5,)),
            ("LayerNorm", (5,), (5,)),
            ("ReLU",),
            ("Linear", (6, 5), (6,)),
            ("LayerNorm", (6,), (6,)),
            ("ReLU",),
            ("Linear", (3, 6), (3,)),
        ]
    )
    assert len(policy.optimizer.param_groups[0]["params"]) == 10
    default = make(DQN, LayerNormDQNPolicy).policy
    assert [m.out_features for m in default.q_net.q_net if isinstance(m, nn.Linear)] == [64, 64, 3]


@pytest.mark.parametrize(
    "policy, dqn_policy, activation",
    [(CReLUPolicy, CReLUDQNPolicy, "CReLU"), (FourierPolicy, FourierDQNPolicy, "FourierFeatures")],
)
def test_doubles_the_width(policy, dqn_policy, activation):
    policy = make(PPO, policy, net_arch=dict(pi=[5, 6], vf=[])).policy
    expected = [("Linear", (5, 4), (5,)), (activation,), ("Linear", (6, 10), (6,)), (activation,)]
    assert kinds(policy.mlp_extractor.policy_net) == expected
    assert policy.action_net.in_features == 12 and policy.value_net.in_features == 4
    q_net = make(DQN, dqn_policy, net_arch=[5]).policy.q_net.q_net
    assert kinds(q_net) == [("Linear", (5, 4), (5,)), (activation,), ("Linear", (3, 10), (3,))]


def test_both_together():
    policy = make(PPO, LayerNormPolicy, net_arch=[5], activation_fn=CReLU).policy
    assert [kind for kind, *_ in kinds(policy.mlp_extractor.policy_net)] == ["Linear", "LayerNorm", "CReLU"]
    assert policy.action_net.in_features == 10


@pytest.mark.parametrize("algorithm", [PPO, CChainPPO])
@pytest.mark.parametrize("policy", [LayerNormPolicy, CReLUPolicy, FourierPolicy])
@pytest.mark.parametrize(
    "observation_space, action_space, policy_kwargs",
    [
        (None, None, {}),
        (None, BOX, dict(share_features_extractor=False)),
        (DICT, None, dict(features_extractor_class=CombinedExtractor)),
    ],
)
def test_on_policy_training_and_loading(tmp_path, algorithm, policy, observation_space, action_space, policy_kwargs):
    check_training(tmp_path, make(algorithm, policy, observation_space, action_space, net_arch=[8], **policy_kwargs))


@pytest.mark.parametrize("algorithm", [DQN, CChainDQN])
@pytest.mark.parametrize("policy", [LayerNormDQNPolicy, CReLUDQNPolicy, FourierDQNPolicy])
def test_off_policy_training_and_loading(tmp_path, algorithm, policy):
    check_training(tmp_path, make(algorithm, policy, net_arch=[8]))


def check_training(tmp_path, model):
    before = {name: p.clone() for name, p in model.policy.named_parameters()}
    model.learn(48).save(tmp_path / "model")
    model.policy.save(tmp_path / "policy")
    changed = [name for name, p in model.policy.named_parameters() if not th.equal(p, before[name])]
    assert len(changed) == sum("target" not in name for name in before)
    loaded = type(model).load(tmp_path / "model", env=model.env, device="cpu")
    policy = type(model.policy).load(tmp_path / "policy", device="cpu")
    for other in (loaded.policy, policy):
        assert all(th.equal(p, q) for p, q in zip(model.policy.parameters(), other.parameters(), strict=True))
    loaded.learn(16, reset_num_timesteps=False)
    # C-CHAIN needs no mode switches for them
    assert not has_training_mode(model.policy)


def test_minatar_network():
    space = spaces.Box(0, 1, (10, 10, 4), np.bool_)
    th.manual_seed(0)
    network = MinAtarCNN(space, layer_norm=True)
    assert kinds(network.cnn) == [("Conv2d", (16, 4, 3, 3), (16,))]
    norm = ("LayerNorm", (1024,), (1024,))
    assert kinds(network.linear) == [
        norm,
        ("ReLU",),
        ("Linear", (128, 1024), (128,)),
        ("LayerNorm", (128,), (128,)),
        ("ReLU",),
    ]
    inputs = th.rand(3, 10, 10, 4)
    features = network.cnn(inputs.permute(0, 3, 1, 2)).permute(0, 2, 3, 1).flatten(start_dim=1)
    hidden = nn.functional.layer_norm(features, (1024,)).relu()
    expected = nn.functional.layer_norm(network.linear[2](hidden), (128,)).relu()
    assert th.allclose(network(inputs), expected, atol=1e-5)


def test_minatar_network_without_is_as_it_was():
    space = spaces.Box(0, 1, (10, 10, 4), np.bool_)
    names = ["cnn.0.weight", "cnn.0.bias", "linear.0.weight", "linear.0.bias"]
    assert list(MinAtarCNN(space).state_dict()) == names
    policy = make(CChainDQN, "CnnPolicy", spaces.Box(0, 1, (10, 10, 4), np.float32), features_extractor_class=MinAtarCNN,
                  features_extractor_kwargs=dict(layer_norm=True), net_arch=[]).learn(24).policy  # fmt: skip
    assert len([m for m in policy.q_net.modules() if isinstance(m, nn.LayerNorm)]) == 2
