"""One forward pass of the actor for the minibatch that PPO evaluates and for further observations."""

from typing import NamedTuple

import torch as th
from stable_baselines3.common.distributions import (
    DiagGaussianDistribution,
    Distribution,
    StateDependentNoiseDistribution,
)
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_cchain.networks.policy_inputs import joined, n_observations, n_values
from sb3_cchain.networks.policy_outputs import has_own_distribution, has_training_mode

# Two batches go through the network as one while they have at most so many numbers together. As one, large batches of images
# take longer than one after the other
JOINED_AT_MOST = 2**18


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
        distribution as SB3's do, and the outputs of one sample depend neither on the others nor on training or evaluation mode
    """
    return (
        getattr(policy.evaluate_actions, "__func__", None) is ActorCriticPolicy.evaluate_actions
        and type(policy).extract_features is ActorCriticPolicy.extract_features
        and not has_own_distribution(type(policy))
        and not has_training_mode(policy)
    )


def evaluate_jointly(
    policy: ActorCriticPolicy, observations: PyTorchObs, actions: th.Tensor, further: PyTorchObs | None = None
) -> Evaluation:
    """
    :param policy: An actor-critic policy, of which ``can_evaluate_jointly()`` is true
    :param observations: Observations of the minibatch
    :param actions: Its actions
    :param further: Observations that go through the actor only; None, or an empty batch, for none
    :return: The evaluation of the minibatch, and the actor's outputs on both
    """
    n = n_observations(observations)
    batches = [observations] if further is None or n_observations(further) == 0 else [observations, further]
    if sum(map(n_values, batches)) <= JOINED_AT_MOST:
        batches = [joined(*batches)]
    features = [BasePolicy.extract_features(policy, batch, policy.pi_features_extractor) for batch in batches]
    if policy.share_features_extractor:
        critic_features = features[0][:n]
    else:
        critic_features = BasePolicy.extract_features(policy, observations, policy.vf_features_extractor)
    latents = [policy.mlp_extractor.forward_actor(each) for each in features]
    outputs = th.cat([policy.action_net(latent) for latent in latents])
    distribution = _distribution(policy, latents[0][:n], outputs[:n])
    values = policy.value_net(policy.mlp_extractor.forward_critic(critic_features))
    return Evaluation(values, distribution.log_prob(actions), distribution.entropy(), outputs)


def _distribution(policy: ActorCriticPolicy, latent: th.Tensor, outputs: th.Tensor) -> Distribution:
    """As ``policy._get_action_dist_from_latent()``, which computes the outputs, too."""
    if isinstance(policy.action_dist, StateDependentNoiseDistribution):
        return policy.action_dist.proba_distribution(outputs, policy.log_std, latent)
    if isinstance(policy.action_dist, DiagGaussianDistribution):
        return policy.action_dist.proba_distribution(outputs, policy.log_std)
    return policy.action_dist.proba_distribution(outputs)
