"""The networks of an SB3 actor-critic policy, as functions of observations."""

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

FORWARD_HOOKS = ("_forward_pre_hooks", "_forward_hooks")
BACKWARD_HOOKS = ("_backward_pre_hooks", "_backward_hooks")
# What a forward pass calls of a policy and its modules
_METHODS = ("forward", "extract_features", "_get_action_dist_from_latent", "forward_actor", "forward_critic")


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
