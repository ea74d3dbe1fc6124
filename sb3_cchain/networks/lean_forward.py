"""The forward pass of a plain MLP policy in a rollout, without what PyTorch and SB3 do around the layers."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor
from torch import nn

from sb3_cchain.networks.policy_outputs import distribution_of, has_own_distribution
from sb3_cchain.replaced import replaced


@contextmanager
def lean_forward(policy: nn.Module) -> Iterator[None]:
    """
    Inside the ``with`` block, :class:`LeanForward` stands in for ``policy.forward`` where it does the same.

    :param policy: The policy of an on-policy algorithm
    """
    if is_plain(policy):
        assert isinstance(policy, ActorCriticPolicy)
        with replaced(policy, "forward", LeanForward(policy)):
            yield
    else:
        yield


def is_plain(policy: nn.Module) -> bool:
    """
    :param policy: A policy
    :return: Whether it is an actor-critic policy of SB3 that takes vectors and has separate MLPs for actor and critic, and
        nothing about its forward pass was changed
    """
    return (
        isinstance(policy, ActorCriticPolicy)  # not so when compiled
        and type(policy).forward is ActorCriticPolicy.forward
        and "forward" not in vars(policy)
        and type(policy).extract_features is ActorCriticPolicy.extract_features
        and not has_own_distribution(type(policy))
        and isinstance(policy.observation_space, spaces.Box)
        and not is_image_space(policy.observation_space)
        and type(policy.features_extractor) is FlattenExtractor
        and type(policy.mlp_extractor) is MlpExtractor
    )


class LeanForward:
    """
    As ``ActorCriticPolicy.forward()``, with the same operations in the same order. The layers are called by their
    ``forward()``: in a small network, what ``nn.Module.__call__()`` does beside it takes about as long as the layers.

    :param policy: A policy, of which ``is_plain()`` is true
    """

    def __init__(self, policy: ActorCriticPolicy):
        self.policy = policy
        self._actor = [*_layers(policy.mlp_extractor.policy_net)]
        self._critic = [*_layers(policy.mlp_extractor.value_net), policy.value_net.forward]
        self._action_net = policy.action_net.forward
        assert policy.action_space.shape is not None
        self._action_shape = policy.action_space.shape
        # `__call__()` serves them
        self._hooks = [hooks for module in policy.modules() for hooks in (module._forward_pre_hooks, module._forward_hooks)]

    def __call__(self, obs: th.Tensor, deterministic: bool = False) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """
        :param obs: Observations, ``(n_envs, ...)``
        :param deterministic: Whether the actions are the most probable ones
        :return: Actions, values, and the actions' log-probabilities
        """
        if any(self._hooks):
            return ActorCriticPolicy.forward(self.policy, obs, deterministic)
        latent_pi = values = obs.float().flatten(start_dim=1)
        for layer in self._actor:
            latent_pi = layer(latent_pi)
        for layer in self._critic:
            values = layer(values)
        distribution = distribution_of(self.policy, latent_pi, self._action_net(latent_pi))
        actions = distribution.get_actions(deterministic=deterministic)
        log_prob = distribution.log_prob(actions)
        return actions.reshape((-1, *self._action_shape)), values, log_prob


def _layers(network: nn.Sequential) -> list[Callable[[th.Tensor], th.Tensor]]:
    return [layer.forward for layer in network]
