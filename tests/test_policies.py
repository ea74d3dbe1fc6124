"""Feature extractors, and the policies that are made for them."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import A2C, DQN, PPO
from torch import nn
from torch.nn import functional as F

from sb3_cchain import CChainDQN, CChainPPO
from sb3_cchain.networks.evaluation_mode import has_training_mode
from sb3_cchain.networks.extractors import ImpalaCNN, MinAtarCNN
from sb3_cchain.networks.impala_policy import ImpalaPolicy
from tests.envs import RandomEnv

BOX = spaces.Box(-1, 1, (4,), np.float32)
CELLS = spaces.Box(0, 1, (10, 10, 4), np.bool_)
PIXELS = spaces.Box(0, 255, (64, 64, 3), np.uint8)
# As SB3 transposes them
TRANSPOSED = spaces.Box(0, 255, (3, 64, 64), np.uint8)
SMALL = spaces.Box(0, 255, (12, 9, 3), np.uint8)


def n_parameters(module):
    return sum(parameter.numel() for parameter in module.parameters())


def test_minatar_network_by_hand():
    extractor = MinAtarCNN(CELLS)
    # 16 filters of 3×3×4 and a bias; 8×8 places of 16 features to 128 units and a bias
    assert n_parameters(extractor) == 16 * (3 * 3 * 4 + 1) + 128 * (8 * 8 * 16 + 1)
    observation = th.zeros(1, 10, 10, 4)
    observation[0, 2, 7, 3] = 1
    with th.no_grad():
        conv = extractor.cnn[0]
        expected = conv.bias[5] + conv.weight[5, 3, 2, 1]  # the cell seen by the filter whose corner is at (0, 6)
        features = extractor.cnn(observation.permute(0, 3, 1, 2))[0]
        assert th.allclose(features[5, 0, 6], expected.relu())
        assert th.allclose(features[5, 5, 0], conv.bias[5].relu())
        assert th.equal(extractor(observation), extractor.linear(features.permute(1, 2, 0).reshape(1, -1)))
        assert extractor(observation).shape == (1, 128) and extractor(observation).min() >= 0


@pytest.mark.parametrize(
    "space",
    [BOX, spaces.Box(0, 1, (2, 10, 4)), spaces.Box(0, 255, (1, 9, 2), np.uint8), spaces.MultiBinary((10, 10, 4))],
    ids=str,
)
def test_minatar_network_refuses_other_observations(space):
    with pytest.raises(ValueError, match="MinAtarCNN needs Box observations"):
        MinAtarCNN(space)


@pytest.mark.parametrize("space", [BOX, spaces.MultiBinary((10, 10, 4))], ids=str)
def test_impala_network_refuses_other_observations(space):
    with pytest.raises(ValueError, match="ImpalaCNN needs Box observations"):
        ImpalaCNN(space)


@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize(
    "space, n_flat",
    [(PIXELS, 2048), (TRANSPOSED, 2048), (SMALL, 2 * 2 * 32), (CELLS, 2 * 2 * 32)],
    ids=["pixels", "transposed", "small", "cells"],
)
def test_impala_network_by_hand(space, n_flat, layer_norm):
    """Against the same written with functions and the parameters in order."""
    extractor = ImpalaCNN(space, layer_norm=layer_norm).double()
    parameters = list(extractor.parameters())
    observations = th.rand(2, *space.shape, dtype=th.float64)

    def convolved(images):
        return F.conv2d(images, parameters.pop(0), parameters.pop(0), padding=1)

    images = observations if space == TRANSPOSED else observations.movedim(3, 1)
    for _ in range(3):
        images = F.max_pool2d(convolved(images), 3, stride=2, padding=1)
        for _ in range(2):
            images = images + convolved(convolved(images.relu()).relu())
    flat = images.movedim(1, 3).flatten(1)
    if layer_norm:
        flat = F.layer_norm(flat, flat.shape[1:], parameters.pop(0), parameters.pop(0))
    features = F.linear(flat.relu(), parameters.pop(0), parameters.pop(0))
    if layer_norm:
        features = F.layer_norm(features, features.shape[1:], parameters.pop(0), parameters.pop(0))
    assert not parameters
    assert th.allclose(extractor(observations), features.relu(), rtol=0, atol=1e-12)
    assert features.shape == (2, 256) and flat.shape[1] == n_flat


def test_impala_network_has_the_papers_initialisation():
    extractor = ImpalaCNN(PIXELS)
    blocks = [(3, 16), (16, 32), (32, 32)]
    n_conv = sum(9 * before * after + after + 4 * (9 * after * after + after) for before, after in blocks)
    assert n_parameters(extractor) == n_conv + 256 * (2048 + 1)
    assert_xavier(extractor)
    before = [parameter.clone() for parameter in extractor.parameters() if parameter.dim() > 1]
    extractor.reset_parameters()
    assert_xavier(extractor)
    after = [parameter for parameter in extractor.parameters() if parameter.dim() > 1]
    assert not any(th.equal(one, other) for one, other in zip(before, after, strict=True))
    wide = ImpalaCNN(SMALL, features_dim=8, channels=(2, 4), layer_norm=True)
    assert wide(th.rand(5, 12, 9, 3)).shape == (5, 8)
    assert wide.linear[0].normalized_shape == (3 * 3 * 4,) and wide.linear[3].normalized_shape == (8,)


def assert_xavier(extractor):
    for module in extractor.modules():
        if isinstance(module, (nn.Conv2d, nn.Linear)):
            # Glorot and Bengio (2010), Eq. 16: the variance of the uniform distribution is 2 / (fan_in + fan_out)
            receptive_field = 9 if isinstance(module, nn.Conv2d) else 1
            bound = (6 / (receptive_field * (module.weight.shape[0] + module.weight.shape[1]))) ** 0.5
            assert 0.9 * bound < module.weight.abs().max() <= bound
            assert module.weight.square().mean().item() == pytest.approx(bound**2 / 3, rel=0.25)
            assert not module.bias.any()


@pytest.mark.parametrize("share_features_extractor", [True, False])
def test_impala_policy_keeps_the_features_initialisation(share_features_extractor):
    kwargs = dict(share_features_extractor=share_features_extractor, features_extractor_kwargs=dict(layer_norm=True))
    policy = PPO(ImpalaPolicy, RandomEnv(PIXELS), n_steps=8, batch_size=4, device="cpu", seed=0, policy_kwargs=kwargs).policy
    assert (policy.pi_features_extractor is policy.vf_features_extractor) == share_features_extractor
    for extractor in (policy.pi_features_extractor, policy.vf_features_extractor):
        assert_xavier(extractor)
        assert isinstance(extractor.linear[0], nn.LayerNorm)
    # The heads stand on the features, orthogonal with gains 0.01 and 1
    assert len(list(policy.mlp_extractor.parameters())) == 0
    weight = policy.action_net.weight.detach()
    assert th.allclose(weight @ weight.T, 1e-4 * th.eye(len(weight)), atol=1e-9)
    assert policy.value_net.weight.norm().item() == pytest.approx(1)
    assert not has_training_mode(policy)


def test_impala_policy_refuses_other_extractors():
    with pytest.raises(TypeError, match=r"`features_extractor_class` must be ImpalaCNN .* got .*MinAtarCNN"):
        PPO(ImpalaPolicy, RandomEnv(SMALL), policy_kwargs=dict(features_extractor_class=MinAtarCNN))


@pytest.mark.parametrize("algorithm", [PPO, A2C, CChainPPO])
def test_impala_policy_trains_and_loads(tmp_path, algorithm):
    settings = dict(n_steps=16) if algorithm is A2C else dict(n_steps=16, batch_size=8, n_epochs=2)
    kwargs = dict(net_arch=dict(pi=[8], vf=[]), features_extractor_kwargs=dict(channels=(2, 4), layer_norm=True))
    model = algorithm(ImpalaPolicy, RandomEnv(SMALL), policy_kwargs=kwargs, seed=0, device="cpu", **settings)
    before = [parameter.clone() for parameter in model.policy.parameters()]
    model.learn(32)
    assert all(not th.equal(p, q) for p, q in zip(before, model.policy.parameters(), strict=True))
    model.save(tmp_path / "model")
    model.policy.save(tmp_path / "policy")
    loaded = algorithm.load(tmp_path / "model", env=RandomEnv(SMALL), device="cpu")
    observation = model.env.observation_space.sample()
    action, _ = model.predict(observation, deterministic=True)
    for policy in (loaded.policy, ImpalaPolicy.load(tmp_path / "policy", device="cpu")):
        for name, parameter in model.policy.named_parameters():
            assert th.equal(parameter, policy.get_parameter(name)), name
        assert np.array_equal(policy.predict(observation, deterministic=True)[0], action)
    loaded.learn(32)


DQN_SETTINGS = dict(learning_starts=20, buffer_size=200, batch_size=8, train_freq=1, learning_rate=1e-3)


@pytest.mark.parametrize("algorithm", [PPO, DQN, CChainDQN])
@pytest.mark.parametrize("space", [CELLS, spaces.Box(0, 255, (10, 10, 4), np.uint8)], ids=["bool", "uint8"])
@pytest.mark.parametrize("extractor_class", [MinAtarCNN, ImpalaCNN])
def test_networks_in_policies(algorithm, space, extractor_class):
    settings = dict(n_steps=16, batch_size=8) if algorithm is PPO else DQN_SETTINGS
    policy_kwargs = dict(features_extractor_class=extractor_class, net_arch=[])
    if extractor_class is ImpalaCNN:
        policy_kwargs["features_extractor_kwargs"] = dict(features_dim=8, channels=(2, 4))
    model = algorithm("MlpPolicy", RandomEnv(space), **settings, seed=0, device="cpu", policy_kwargs=policy_kwargs)
    model.learn(32)
    extractor = model.policy.features_extractor if algorithm is PPO else model.q_net.features_extractor
    assert extractor.cnn[0].weight.shape == (16 if extractor_class is MinAtarCNN else 2, 4, 3, 3)
    if extractor_class is MinAtarCNN:
        assert extractor.linear[0].in_features == 16 * 8 * 8
