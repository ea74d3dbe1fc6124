"""The outputs of an SB3 actor-critic policy, by kind of action distribution."""

from collections.abc import Sequence
from typing import Any

import torch as th
from stable_baselines3.common.distributions import (
    BernoulliDistribution,
    CategoricalDistribution,
    DiagGaussianDistribution,
    Distribution,
    MultiCategoricalDistribution,
    StateDependentNoiseDistribution,
)
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn
from torch.distributions import Bernoulli, Categorical
from torch.nn import functional as F

from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.networks.policy_networks import PolicyNetworks


def policy_outputs(policy: ActorCriticPolicy, observations: PyTorchObs) -> th.Tensor:
    """
    What the policy's action distribution is made of.

    :param policy: An actor-critic policy
    :param observations: Batch of observations
    :return: Probabilities ``(batch_size, n_actions)`` for ``Discrete``, ``(batch_size, n_sub_actions, max_n)`` for
        ``MultiDiscrete`` (shorter sub-actions padded with 0) and ``(batch_size, n, 2)`` for ``MultiBinary`` actions;
        means ``(batch_size, action_dim)`` for ``Box`` (before squashing, with gSDE)
    """
    if has_own_distribution(uncompiled(policy)):
        return distribution_outputs(policy.get_distribution(observations))
    # The same without the distribution, whose construction costs as much as the network
    return actor_outputs(PolicyNetworks(policy), observations)


def actor_outputs(networks: PolicyNetworks, observations: PyTorchObs) -> th.Tensor:
    """
    :param networks: Those of a policy that makes its distribution as SB3's do
    :param observations: Batch of observations
    :return: As of :func:`policy_outputs`, without making the distribution
    """
    outputs = networks.outputs(networks.latent(networks.actor_features(observations)))
    return of_action_net(networks.policy, outputs)


def of_action_net(policy: ActorCriticPolicy, outputs: th.Tensor) -> th.Tensor:
    """
    :param policy: An actor-critic policy that makes its distribution as SB3's do
    :param outputs: Outputs of its ``action_net``
    :return: As of :func:`policy_outputs`
    """
    distribution = policy.action_dist
    if isinstance(distribution, CategoricalDistribution):
        return outputs.softmax(dim=1)
    if isinstance(distribution, MultiCategoricalDistribution):
        return _stack_padded([logits.softmax(dim=1) for logits in outputs.split(tuple(distribution.action_dims), dim=1)])
    if isinstance(distribution, BernoulliDistribution):
        return th.stack([(-outputs).sigmoid(), outputs.sigmoid()], dim=-1)
    return outputs


def distribution_of(policy: ActorCriticPolicy, latent: th.Tensor, outputs: th.Tensor) -> Distribution:
    """
    As ``policy._get_action_dist_from_latent()``, which computes the outputs, too.

    :param policy: An actor-critic policy that makes its distribution as SB3's do
    :param latent: Inputs of its ``action_net``
    :param outputs: Outputs of it
    :return: The action distribution
    """
    if isinstance(policy.action_dist, StateDependentNoiseDistribution):
        return policy.action_dist.proba_distribution(outputs, policy.log_std, latent)
    if isinstance(policy.action_dist, DiagGaussianDistribution):
        return policy.action_dist.proba_distribution(outputs, policy.log_std)
    return policy.action_dist.proba_distribution(outputs)


def has_own_distribution(policy: nn.Module) -> bool:
    """
    :param policy: An actor-critic policy
    :return: Whether it makes its action distribution otherwise than SB3's, by its class or by a method replaced on it, or has
        one that may make something else of the same outputs
    """
    return not is_sb3s(getattr(policy, "action_dist", None)) or any(
        getattr(getattr(policy, name), "__func__", None) is not getattr(ActorCriticPolicy, name)
        for name in ("get_distribution", "_get_action_dist_from_latent")
    )


def is_sb3s(distribution: Any) -> bool:
    """
    :param distribution: An action distribution
    :return: Whether its class is SB3's or a lean one, and no method was replaced on it
    """
    if not type(distribution).__module__.startswith(("stable_baselines3.", "sb3_cchain.")):
        return False
    return not any(map(callable, vars(distribution).values()))


def distribution_outputs(distribution: Distribution) -> th.Tensor:
    """
    :param distribution: An action distribution of SB3, or a maskable one of sb3-contrib
    :return: As of :func:`policy_outputs`
    """
    # A maskable one has several under this name, SB3's under the other
    inner: Any = getattr(distribution, "distributions", None) or distribution.distribution
    if isinstance(inner, list):
        return _stack_padded([categorical.probs for categorical in inner])
    if isinstance(inner, Bernoulli):
        return th.stack([1 - inner.probs, inner.probs], dim=-1)
    return inner.probs if isinstance(inner, Categorical) else inner.mean


def _stack_padded(sub_actions: Sequence[th.Tensor]) -> th.Tensor:
    width = max(probs.shape[1] for probs in sub_actions)
    return th.stack([F.pad(probs, (0, width - probs.shape[1])) for probs in sub_actions], dim=1)
