"""The forward pass of a plain MLP policy in a rollout, without what PyTorch and SB3 do around the layers."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from sb3_cchain.networks.policy_networks import FORWARD_HOOKS, PlainNetworks, hooks_of, is_plain
from sb3_cchain.networks.policy_outputs import distribution_of, has_own_distribution
from sb3_cchain.replaced import replaced


@contextmanager
def lean_forward(policy: nn.Module) -> Iterator[None]:
    """
    Inside the ``with`` block, :class:`LeanForward` stands in for ``policy.forward`` where it does the same.

    :param policy: The policy of an on-policy algorithm
    """
    if has_plain_forward(policy):
        assert isinstance(policy, ActorCriticPolicy)
        with replaced(policy, "forward", LeanForward(policy)):
            yield
    else:
        yield


def has_plain_forward(policy: nn.Module) -> bool:
    """
    :param policy: A policy
    :return: Whether its networks are plain, and its forward pass is that of SB3's actor-critic policies
    """
    return is_plain(policy) and type(policy).forward is ActorCriticPolicy.forward and not has_own_distribution(policy)


class LeanForward:
    """
    As ``ActorCriticPolicy.forward()``, with the same operations in the same order.

    :param policy: A policy, of which ``has_plain_forward()`` is true
    """

    def __init__(self, policy: ActorCriticPolicy):
        self._policy = policy
        self._networks = PlainNetworks(policy)
        assert policy.action_space.shape is not None
        self._action_shape = policy.action_space.shape
        # They may be registered in the middle of a rollout. There is no backward pass in it
        self._hooks = hooks_of(policy, FORWARD_HOOKS)

    def __call__(self, obs: th.Tensor, deterministic: bool = False) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """
        :param obs: Observations, ``(n_envs, ...)``
        :param deterministic: Whether the actions are the most probable ones
        :return: Actions, values, and the actions' log-probabilities
        """
        if any(self._hooks):
            return ActorCriticPolicy.forward(self._policy, obs, deterministic)
        networks = self._networks
        features = networks.actor_features(obs)
        latent = networks.latent(features)
        values = networks.values(features)
        distribution = distribution_of(self._policy, latent, networks.outputs(latent))
        actions = distribution.get_actions(deterministic=deterministic)
        log_prob = distribution.log_prob(actions)
        return actions.reshape((-1, *self._action_shape)), values, log_prob
