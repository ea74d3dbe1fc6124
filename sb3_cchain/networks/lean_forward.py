"""The forward pass of a plain MLP policy in a rollout, without what PyTorch and SB3 do around the layers."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeGuard

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from sb3_cchain.networks.policy_networks import PlainNetworks, has_mlps, takes_vectors
from sb3_cchain.networks.policy_outputs import distribution_of


@contextmanager
def lean_forward(policy: nn.Module) -> Iterator[None]:
    """
    Inside the ``with`` block, :class:`LeanForward` is what calls of the policy call, where it may do the same.

    :param policy: The policy of an on-policy algorithm
    """
    if not _may_be_lean(policy):
        yield
        return
    lean = LeanForward(policy)
    # What `policy.compile()` sets. PyTorch calls it in place of the method below, and leaves it out of copies and pickles
    policy._compiled_call_impl = lean
    try:
        yield
    finally:
        if policy._compiled_call_impl is lean:  # not so when it was compiled meanwhile
            del policy._compiled_call_impl


def has_plain_forward(policy: nn.Module) -> bool:
    """
    :param policy: A policy
    :return: Whether its networks are plain, and its forward pass is that of SB3's actor-critic policies
    """
    return _may_be_lean(policy) and has_mlps(policy)


def _may_be_lean(policy: nn.Module) -> TypeGuard[ActorCriticPolicy]:
    """What is not replaced in a rollout."""
    return (
        takes_vectors(policy)
        and type(policy).forward is ActorCriticPolicy.forward
        and type(policy)._get_action_dist_from_latent is ActorCriticPolicy._get_action_dist_from_latent
        and policy._compiled_call_impl is None
    )


class LeanForward:
    """
    As a call of the policy, with the same operations in the same order, for as long as its networks are plain: callbacks may
    change it at each step.

    :param policy: A policy of SB3, with its forward pass
    """

    def __init__(self, policy: ActorCriticPolicy):
        self._policy = policy
        self._networks = PlainNetworks(policy)
        assert policy.action_space.shape is not None
        self._action_shape = policy.action_space.shape

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """
        :param args: What ``policy()`` takes
        :param kwargs: What ``policy()`` takes
        :return: Actions, values, and the actions' log-probabilities
        """
        if has_mlps(self._policy):
            return self._forward(*args, **kwargs)
        return self._policy._call_impl(*args, **kwargs)

    def _forward(self, obs: th.Tensor, deterministic: bool = False) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        networks = self._networks
        features = networks.actor_features(obs)
        latent = networks.latent(features)
        values = networks.values(features)
        distribution = distribution_of(self._policy, latent, networks.outputs(latent))
        actions = distribution.get_actions(deterministic=deterministic)
        log_prob = distribution.log_prob(actions)
        return actions.reshape((-1, *self._action_shape)), values, log_prob
