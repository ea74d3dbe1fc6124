"""The networks of an SB3 actor-critic policy, as functions of observations."""

from collections.abc import Iterable, Sequence
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn
from torch.nn import functional as F

FORWARD_HOOKS = ("_forward_pre_hooks", "_forward_hooks")
BACKWARD_HOOKS = ("_backward_pre_hooks", "_backward_hooks")
# What a forward pass calls of a policy and its modules
_METHODS = ("forward", "extract_features", "forward_actor", "forward_critic")


class PolicyNetworks:
    """
    :param policy: An actor-critic policy that extracts features as SB3's do
    """

    def __init__(self, policy: ActorCriticPolicy):
        self.policy = policy

    def actor_features(self, observations: PyTorchObs) -> th.Tensor:
        """
        :param observations: Batch of observations
        :return: What ``latent()`` takes
        """
        return BasePolicy.extract_features(self.policy, observations, self.policy.pi_features_extractor)

    def critic_features(self, observations: PyTorchObs) -> th.Tensor:
        """
        :param observations: Batch of observations
        :return: What ``values()`` takes; the actor's features where ``policy.share_features_extractor``
        """
        return BasePolicy.extract_features(self.policy, observations, self.policy.vf_features_extractor)

    def latent(self, features: th.Tensor) -> th.Tensor:
        """
        :param features: Features of the actor
        :return: What ``outputs()`` takes
        """
        return self.policy.mlp_extractor.forward_actor(features)

    def outputs(self, latent: th.Tensor) -> th.Tensor:
        """
        :param latent: Activations of the actor's last hidden layer
        :return: Outputs of ``policy.action_net``, which the action distribution is made of
        """
        return self.policy.action_net(latent)

    def values(self, features: th.Tensor) -> th.Tensor:
        """
        :param features: Features of the critic
        :return: State values ``(batch_size, 1)``
        """
        return self.policy.value_net(self.policy.mlp_extractor.forward_critic(features))


class PlainNetworks(PolicyNetworks):
    """
    The same operations, without what ``nn.Module.__call__()`` does beside a layer, above all looking for hooks, and without
    looking up attributes of modules. In a small network, both take about as long as the layers.

    :param policy: A policy, of which ``is_plain()`` is true
    """

    def __init__(self, policy: ActorCriticPolicy):
        super().__init__(policy)
        # PyTorch's own dictionary, because its modules may be replaced in the middle of a rollout
        self._modules: dict[str, Any] = policy._modules

    def actor_features(self, observations: PyTorchObs) -> th.Tensor:
        """As of the base class."""
        assert th.is_tensor(observations)
        return observations.float().flatten(start_dim=1)

    critic_features = actor_features

    def latent(self, features: th.Tensor) -> th.Tensor:
        """As of the base class."""
        return _through(self._modules["mlp_extractor"]._modules["policy_net"]._modules.values(), features)

    def outputs(self, latent: th.Tensor) -> th.Tensor:
        """As of the base class."""
        return _through([self._modules["action_net"]], latent)

    def values(self, features: th.Tensor) -> th.Tensor:
        """As of the base class."""
        latent = _through(self._modules["mlp_extractor"]._modules["value_net"]._modules.values(), features)
        return _through([self._modules["value_net"]], latent)


def _through(layers: Iterable[nn.Module], inputs: th.Tensor) -> th.Tensor:
    """What ``nn.Sequential`` does."""
    for layer in layers:
        if type(layer) is nn.Linear:
            parameters: dict[str, Any] = layer._parameters
            inputs = F.linear(inputs, parameters["weight"], parameters["bias"])
        else:
            inputs = layer.forward(inputs)
    return inputs


def hooks_of(policy: nn.Module, kinds: Sequence[str] = (*FORWARD_HOOKS, *BACKWARD_HOOKS)) -> list[dict[int, Any]]:
    """
    :param policy: A policy
    :param kinds: Kinds of hooks
    :return: Where PyTorch keeps the hooks of each of its modules
    """
    return [getattr(module, kind) for module in policy.modules() for kind in kinds]


def is_instrumented(policy: nn.Module) -> bool:
    """
    :param policy: A policy
    :return: Whether hooks look at its modules, or a method was replaced on one of them, not in its class
    """
    # What torch.compile() returns has its own `forward` there
    modules = [module for module in policy.modules() if not hasattr(module, "_orig_mod")]
    replaced = any(name in vars(module) for module in modules for name in _METHODS)
    return replaced or any(hooks_of(policy))


def is_plain(policy: nn.Module) -> bool:
    """
    :param policy: A policy
    :return: Whether it is an actor-critic policy of SB3 that takes vectors and has MLPs for actor and critic, without hooks
        and replaced methods
    """
    return (
        isinstance(policy, ActorCriticPolicy)  # not so when compiled
        and type(policy).extract_features is ActorCriticPolicy.extract_features
        and isinstance(policy.observation_space, spaces.Box)
        and not is_image_space(policy.observation_space)
        and type(policy.features_extractor) is FlattenExtractor
        and type(getattr(policy, "mlp_extractor", None)) is MlpExtractor
        and type(policy.mlp_extractor.policy_net) is type(policy.mlp_extractor.value_net) is nn.Sequential
        and not is_instrumented(policy)
        and not nn.modules.module._has_any_global_hook()  # as those that count operations
    )


def networks_of(policy: ActorCriticPolicy) -> PolicyNetworks:
    """
    :param policy: An actor-critic policy that extracts features as SB3's do
    :return: Its networks, which are right for as long as no module is replaced and no hook is registered
    """
    return PlainNetworks(policy) if is_plain(policy) else PolicyNetworks(policy)
