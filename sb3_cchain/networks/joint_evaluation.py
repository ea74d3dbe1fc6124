"""One forward pass of the actor for the minibatch that PPO evaluates and for further observations."""

from typing import NamedTuple

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_cchain.networks.evaluation_mode import has_training_mode
from sb3_cchain.networks.layers import CONVOLUTIONS
from sb3_cchain.networks.policy_inputs import joined, n_observations
from sb3_cchain.networks.policy_networks import PolicyNetworks, is_instrumented
from sb3_cchain.networks.policy_outputs import distribution_of, has_own_distribution


class Evaluation(NamedTuple):
    """What ``policy.evaluate_actions()`` returns of a minibatch, and the outputs of the actor that it is made of."""

    values: th.Tensor
    log_prob: th.Tensor
    entropy: th.Tensor | None
    # Outputs of `policy.action_net`: of the minibatch, then of the further observations
    outputs: th.Tensor


def can_evaluate_jointly(policy: ActorCriticPolicy) -> bool:
    """
    :param policy: An actor-critic policy
    :return: Whether :func:`evaluate_jointly` does what its ``evaluate_actions()`` does: it evaluates actions and makes its
        distribution as SB3's do, no hook looks at its batches, no method of a module was replaced, and the outputs of one
        sample depend neither on the others nor on training or evaluation mode
    """
    return (
        getattr(policy.evaluate_actions, "__func__", None) is ActorCriticPolicy.evaluate_actions
        and type(policy).extract_features is ActorCriticPolicy.extract_features
        and not has_own_distribution(policy)
        and not has_training_mode(policy)
        and not is_instrumented(policy)
    )


def has_convolutions(policy: ActorCriticPolicy) -> bool:
    """
    :param policy: An actor-critic policy
    :return: Whether it has convolutions, which take longer for two batches as one than for one after the other
    """
    return any(isinstance(module, CONVOLUTIONS) for module in policy.modules())


def evaluate_jointly(
    networks: PolicyNetworks, observations: PyTorchObs, actions: th.Tensor, further: PyTorchObs | None = None
) -> Evaluation:
    """
    :param networks: Those of a policy, of which ``can_evaluate_jointly()`` is true
    :param observations: Observations of the minibatch
    :param actions: Its actions
    :param further: Observations that go through the actor only; None, or an empty batch, for none
    :return: The evaluation of the minibatch, and the actor's outputs on both
    """
    policy = networks.policy
    together = observations
    if further is not None and n_observations(further) > 0:
        together = joined(observations, further)

    def own(tensor: th.Tensor) -> th.Tensor:
        # Of the minibatch. A slice that is everything would cost a copy in the backward pass
        return tensor if together is observations else tensor[: n_observations(observations)]

    features = networks.actor_features(together)
    latent = networks.latent(features)
    outputs = networks.outputs(latent)
    distribution = distribution_of(policy, own(latent), own(outputs))
    shared = policy.share_features_extractor
    values = networks.values(own(features) if shared else networks.critic_features(observations))
    return Evaluation(values, distribution.log_prob(actions), distribution.entropy(), outputs)
