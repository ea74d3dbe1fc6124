"""Optimisers that act on weight matrices leave alone what they are to leave alone."""

import pytest
from gymnasium import spaces
from sb3_contrib import QRDQN, TQC, TRPO, CrossQ, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO, SAC, TD3
from torch import nn

from sb3_cchain.methods import Muon, NormalizeAndProject, OptimizerMetrics, Parseval, SpectralRegularization, WeightClipping
from sb3_cchain.methods.output_layers import check_output_layers
from sb3_cchain.networks import InjectionDQNPolicy, InjectionPolicy
from tests.envs import RandomEnv


def with_matrices(optimizer_class, algorithm, policy="MlpPolicy", n_output_layers=2, **settings):
    """A model of any algorithm with an optimiser that leaves output layers alone."""
    policy_kwargs = dict(net_arch=[8, 8], optimizer_class=optimizer_class)
    if n_output_layers is not None:
        policy_kwargs["optimizer_kwargs"] = dict(n_output_layers=n_output_layers)
    is_discrete = algorithm in (DQN, QRDQN, MaskablePPO)
    env = RandomEnv(action_space=None if is_discrete else spaces.Box(-1, 1, (3,)))
    return algorithm(policy, env, policy_kwargs=policy_kwargs, device="cpu", **settings)


FITTING = [
    (PPO, "MlpPolicy", 2),
    (A2C, "MlpPolicy", 2),
    (TRPO, "MlpPolicy", 2),
    (MaskablePPO, "MlpPolicy", 2),
    (DQN, "MlpPolicy", 1),
    (QRDQN, "MlpPolicy", 1),
    # Each head has an old, a new and a copied output layer
    (PPO, InjectionPolicy, 6),
    (DQN, InjectionDQNPolicy, 3),
    # Regularises the output layers as well, because it was told so
    (RecurrentPPO, "MlpLstmPolicy", 0),
]


@pytest.mark.parametrize("optimizer_class", [Parseval, NormalizeAndProject, Muon])
@pytest.mark.parametrize("algorithm, policy, n_output_layers", FITTING)
def test_output_layers_are_left_alone(optimizer_class, algorithm, policy, n_output_layers):
    check_output_layers(with_matrices(optimizer_class, algorithm, policy, n_output_layers))


@pytest.mark.parametrize(
    "algorithm, policy, n_output_layers, touched",
    [
        (PPO, "MlpPolicy", 1, "action_net.weight"),
        (RecurrentPPO, "MlpLstmPolicy", 2, "action_net.weight, value_net.weight"),
        (
            PPO,
            InjectionPolicy,
            2,
            "action_net.old.weight, action_net.new.weight, action_net.copy.weight, value_net.old.weight",
        ),
        (DQN, InjectionDQNPolicy, 1, "q_net.q_net.1.old.weight, q_net.q_net.1.new.weight"),
        (SAC, "MlpPolicy", 2, "critic.qf0.4.weight"),
        (TQC, "MlpPolicy", 2, "critic.qf0.4.weight"),
        (CrossQ, "MlpPolicy", 2, "critic.qf0.7.weight"),
        (TD3, "MlpPolicy", 1, "critic.qf0.4.weight"),
    ],
)
@pytest.mark.parametrize("optimizer_class", [Parseval, NormalizeAndProject])
def test_a_number_of_output_layers_that_does_not_fit_is_refused(optimizer_class, algorithm, policy, n_output_layers, touched):
    model = with_matrices(optimizer_class, algorithm, policy, n_output_layers)
    name = optimizer_class.__name__
    with pytest.raises(
        ValueError, match=rf"{name} leaves the last .* acts on output layers of {algorithm.__name__}: {touched}\. "
    ):
        model.learn(10, callback=OptimizerMetrics())
    assert model.num_timesteps == 0


@pytest.mark.parametrize("head", [nn.Sequential(), nn.MultiheadAttention(8, 2)])
def test_heads_that_are_not_known_are_passed_over(head):
    model = with_matrices(Parseval, PPO)
    model.policy.action_net = head
    check_output_layers(model)


def test_muon_leaves_matrices_of_one_row_alone_anyway():
    check_output_layers(with_matrices(Muon, SAC))
    with pytest.raises(ValueError, match=r"critic\.qf0\.4\.weight"):
        check_output_layers(with_matrices(Muon, TQC))


@pytest.mark.parametrize("optimizer_class", [Parseval, NormalizeAndProject, Muon, WeightClipping, SpectralRegularization])
@pytest.mark.parametrize("algorithm", [PPO, SAC])
def test_the_log_std_of_gsde_is_no_weight(optimizer_class, algorithm):
    n_output_layers = None if optimizer_class in (WeightClipping, SpectralRegularization) else 0
    check_output_layers(with_matrices(optimizer_class, algorithm, n_output_layers=n_output_layers))
    model = with_matrices(optimizer_class, algorithm, n_output_layers=n_output_layers, use_sde=True)
    with pytest.raises(ValueError, match=f"{optimizer_class.__name__} takes the `log_std` of gSDE"):
        check_output_layers(model)
