"""The networks of an SB3 actor-critic policy, as functions of observations."""

from collections.abc import Iterable
from typing import Any, TypeGuard

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
_METHODS = ("forward", "extract_features", "_get_action_dist_from_latent", "forward_actor", "forward_critic")
_EXTRACTORS = ("features_extractor", "pi_features_extractor", "vf_features_extractor")


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
        return self._features(observations, "pi_features_extractor")

    def critic_features(self, observations: PyTorchObs) -> th.Tensor:
        """
        :param observations: Batch of observations
        :return: What ``values()`` takes; the actor's features where ``policy.share_features_extractor``
        """
        return self._features(observations, "vf_features_extractor")

    def _features(self, observations: PyTorchObs, own: str) -> th.Tensor:
        # As `policy.extract_features()`: one that was put in place of the shared extractor is under this name alone
        name = "features_extractor" if self.policy.share_features_extractor else own
        return BasePolicy.extract_features(self.policy, observations, getattr(self.policy, name))

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
    The same operations, without what ``nn.Module.__call__()`` does beside a layer, and without looking up attributes of
    modules. In a small network, both take about as long as the layers.

    :param policy: A policy, of which ``takes_vectors()`` is true, and ``has_mlps()`` whenever it is used
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
        own = vars(layer)
        if own["_forward_hooks"] or own["_forward_pre_hooks"]:
            inputs = layer(inputs)
        elif type(layer) is nn.Linear and "forward" not in own and _has_parameters(own["_parameters"]):
            inputs = F.linear(inputs, own["_parameters"]["weight"], own["_parameters"]["bias"])
        else:
            inputs = layer.forward(inputs)
    return inputs


def _has_parameters(parameters: dict[str, Any]) -> bool:
    """Not so where a weight is a buffer or any other tensor."""
    return "weight" in parameters and "bias" in parameters


def is_instrumented(policy: nn.Module) -> bool:
    """
    :param policy: A policy
    :return: Whether hooks look at its modules, or a method was replaced on one of them, not in its class
    """
    return any(
        any(getattr(module, kind) for kind in (*FORWARD_HOOKS, *BACKWARD_HOOKS))
        # What torch.compile() returns has its own `forward` there
        or (not hasattr(module, "_orig_mod") and not vars(module).keys().isdisjoint(_METHODS))
        for module in policy.modules()
    )


def is_plain(policy: nn.Module) -> bool:
    """
    :param policy: A policy
    :return: Whether it is an actor-critic policy of SB3 that takes vectors and has MLPs for actor and critic, without hooks
        and replaced methods
    """
    return takes_vectors(policy) and has_mlps(policy) and not is_instrumented(policy)


def takes_vectors(policy: nn.Module) -> TypeGuard[ActorCriticPolicy]:
    """
    :param policy: A policy
    :return: Whether it is an actor-critic policy that extracts features as SB3's do, from vectors
    """
    return (
        isinstance(policy, ActorCriticPolicy)  # not so when compiled
        and type(policy).extract_features is ActorCriticPolicy.extract_features
        and isinstance(policy.observation_space, spaces.Box)
        and not is_image_space(policy.observation_space)
    )


def has_mlps(policy: nn.Module) -> bool:
    """
    Takes a few microseconds, because it is asked at each step.

    :param policy: A policy, of which ``takes_vectors()`` is true
    :return: Whether :class:`PlainNetworks` does at the moment what its modules do: they are SB3's MLPs, without own features
        extractors, and no hook looks at what is not called, nor was a method of it replaced
    """
    modules: dict[str, Any] = vars(policy)["_modules"]
    mlp_extractor: Any = modules.get("mlp_extractor")
    return (
        _is_bare(mlp_extractor, MlpExtractor)
        and _is_bare(mlp_extractor._modules["policy_net"], nn.Sequential)
        and _is_bare(mlp_extractor._modules["value_net"], nn.Sequential)
        and all(map(_only_flattens, {modules.get(name) for name in _EXTRACTORS}))
        and _is_bare(policy, type(policy))
        and not nn.modules.module._has_any_global_hook()  # as those that count operations
    )


def _is_bare(module: Any, kind: type[nn.Module]) -> bool:
    """Whether it is of this very class, and does nothing else than its class says."""
    if type(module) is not kind:
        return False
    own = vars(module)
    return not own["_forward_hooks"] and not own["_forward_pre_hooks"] and own.keys().isdisjoint(_METHODS)


def _only_flattens(extractor: Any) -> bool:
    return _is_bare(extractor, FlattenExtractor) and _is_bare(extractor._modules["flatten"], nn.Flatten)


def networks_of(policy: ActorCriticPolicy) -> PolicyNetworks:
    """
    :param policy: An actor-critic policy that extracts features as SB3's do
    :return: Its networks, which are right for as long as no module is replaced and no hook is registered
    """
    return PlainNetworks(policy) if is_plain(policy) else PolicyNetworks(policy)
