"""Weights become the nearest isometry."""

import numpy as np
import pytest
import torch as th
from gymnasium.spaces import Box
from stable_baselines3 import SAC, TD3
from torch import nn

from sb3_cchain.methods import FIRE
from sb3_cchain.methods.fire import nearest_isometry, trained_weights
from tests.envs import RandomEnv
from tests.method_models import make_env, make_model, make_random_env, parameters


@pytest.mark.parametrize("shape", [(6, 3), (3, 6), (4, 4)])
def test_it_is_the_polar_factor(shape):
    """U Vᵀ of W = U S Vᵀ, times √(outputs / inputs)."""
    th.manual_seed(0)
    weight = th.randn(shape, dtype=th.float64)
    u, _, v = th.linalg.svd(weight, full_matrices=False)
    expected = (u @ v) * (shape[0] / shape[1]) ** 0.5
    assert th.allclose(nearest_isometry(weight, n_iterations=40), expected)


def test_iterations_by_hand():
    """Singular values 3 and 4, of norm 5: 0.6 and 0.8; x becomes 1.5 x - 0.5 x³."""
    found = nearest_isometry(th.diag(th.tensor([3.0, 4.0])), n_iterations=1)
    assert th.allclose(found, th.diag(th.tensor([0.792, 0.944])))
    once_more = [1.5 * x - 0.5 * x**3 for x in (0.792, 0.944)]
    assert th.allclose(nearest_isometry(th.diag(th.tensor([3.0, 4.0])), n_iterations=2), th.diag(th.tensor(once_more)))
    assert th.equal(nearest_isometry(th.zeros(2, 3)), th.zeros(2, 3))


def test_each_position_of_a_kernel_is_a_matrix():
    weight = th.randn(4, 2, 3, 3)
    found = nearest_isometry(weight)
    assert found.shape == weight.shape
    assert th.allclose(found[:, :, 1, 2], nearest_isometry(weight[:, :, 1, 2].contiguous()) / 9, atol=1e-6)


@pytest.mark.parametrize("reset_moments", [False, True])
@pytest.mark.parametrize("name", ["PPO", "DQN", "CChainPPO", "CChainDQN"])
def test_of_a_model(name, reset_moments):
    model = make_model(name, env=make_random_env(), policy_kwargs=dict(net_arch=[8, 4]))
    model.learn(48)
    before, optimizer = parameters(model), model.policy.optimizer
    names = trained_weights(model.policy)
    assert len(names) == (3 if "DQN" in name else 6)
    callback = FIRE(interval=10**9, reset_moments=reset_moments)
    callback.init_callback(model)
    callback._act()
    for key, parameter in model.policy.named_parameters():
        online = key.replace("q_net_target.", "q_net.", 1)
        expected = nearest_isometry(before[online]) if online in names else before[key]
        assert th.equal(parameter, expected), key
        if key == online:
            assert (parameter in optimizer.state) == (not reset_moments or key not in names)


@pytest.mark.parametrize("algorithm", [SAC, TD3])
def test_of_several_optimisers_and_targets(algorithm):
    env = RandomEnv(action_space=Box(-1, 1, (2,)))
    model = algorithm("MlpPolicy", env, learning_starts=4, buffer_size=50, policy_kwargs=dict(net_arch=[8]), device="cpu")
    callback = FIRE(interval=10)
    model.learn(12, callback=callback)
    assert callback.n_resets == 1
    callback._act()
    for name in trained_weights(model.policy):
        network, _, rest = name.partition(".")
        singular = th.linalg.svdvals(model.policy.get_parameter(name).detach())
        assert (
            singular.max()
            < (model.policy.get_parameter(name).shape[0] / model.policy.get_parameter(name).shape[1]) ** 0.5 + 1e-3
        )
        target = f"{network}_target.{rest}"
        if target in dict(model.policy.named_parameters()):
            assert th.equal(model.policy.get_parameter(target), model.policy.get_parameter(name))
    for network in (model.actor, model.critic):
        assert network.optimizer.state and not any(p.dim() > 1 for p in network.optimizer.state)


@pytest.mark.parametrize("algorithm", [SAC, TD3])
def test_targets_of_a_shared_extractor(algorithm):
    env = RandomEnv(observation_space=Box(0, 255, (36, 36, 1), np.uint8), action_space=Box(-1, 1, (2,)))
    policy_kwargs = dict(net_arch=[8], share_features_extractor=True)
    model = algorithm("CnnPolicy", env, buffer_size=10, policy_kwargs=policy_kwargs, device="cpu")
    callback = FIRE(interval=10)
    callback.init_callback(model)
    callback._act()
    assert all(map(th.equal, model.critic.parameters(), model.critic_target.parameters()))


def test_at_each_switch():
    callback = FIRE()
    make_model("PPO", env=make_env()).learn(96, callback=callback)
    assert callback.n_resets == 2
    with pytest.raises(TypeError, match="the training environment is not one"):
        make_model("PPO", env=RandomEnv()).learn(10, callback=FIRE())


def test_layer_norms_and_biases_stay():
    network = nn.Sequential(nn.Linear(2, 3), nn.LayerNorm(3), nn.Linear(3, 1))
    assert trained_weights(network) == ["0.weight", "2.weight"]
    network[0].weight.requires_grad_(False)
    assert trained_weights(network) == ["2.weight"]


def test_fire_does_convolutions():
    network = nn.Sequential(nn.Conv2d(1, 2, 3), nn.Conv1d(1, 2, 3), nn.Linear(2, 2))

    assert trained_weights(network) == ["0.weight", "1.weight", "2.weight"]
