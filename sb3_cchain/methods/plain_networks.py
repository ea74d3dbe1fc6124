"""The models whose layers and units methods know how to renew."""

from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_cchain.networks.algorithm_kinds import is_recurrent
from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.networks.injection_policies import Injectable


def check_plain_networks(name: str, model: BaseAlgorithm) -> None:
    """
    :param name: Name of the method
    :param model: The model that it is given to
    :raises TypeError: For an algorithm that is neither on-policy nor DQN, recurrent networks, and policies that plasticity is
        injected into
    """
    if not isinstance(model, (OnPolicyAlgorithm, DQN)):
        raise TypeError(f"{name} is for on-policy algorithms and DQN, got {type(model).__name__}")
    if is_recurrent(model):
        raise TypeError(f"{name} does not know recurrent networks, got {type(model).__name__}")
    policy = uncompiled(model.policy)
    if any(isinstance(module, Injectable) for module in policy.modules()):
        raise TypeError(f"{name} does not know heads for plasticity injection, got {type(policy).__name__}")
