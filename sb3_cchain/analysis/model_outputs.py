"""The outputs of any Stable-Baselines3 model, and how far they moved."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from sb3_cchain.analysis.metrics.churn import kl_divergence
from sb3_cchain.analysis.reference_batch import Batch
from sb3_cchain.churn.divergence import action_changes, mean_absolute_change, mean_squared_difference
from sb3_cchain.networks.policy_inputs import empty_memory, n_observations
from sb3_cchain.networks.policy_outputs import distribution_outputs, policy_outputs, policy_values


@dataclass(frozen=True)
class ModelOutputs:
    """
    Outputs of a model on a batch, without gradient; None for those that its algorithm does not have.

    :param probabilities: Of a categorical policy's actions, ``(batch_size, n_actions)``; with several sub-actions
        ``(batch_size, n_sub_actions, max_n)``, the shorter ones padded with 0
    :param action_means: Of a continuous policy, ``(batch_size, action_dim)``: the mean of the Gaussian before any squashing
        (PPO, A2C, TRPO), or the deterministic action as the actor gives it, between -1 and 1 (SAC, TQC, CrossQ, TD3, DDPG) and
        before clipping (ARS)
    :param values: State values ``(batch_size, 1)`` (PPO, A2C, TRPO); action values ``(batch_size, n_actions)`` (DQN, QRDQN);
        each critic's values of the batch's actions ``(batch_size, n_critics)`` (SAC, TQC, CrossQ, TD3, DDPG). Where a network
        predicts quantiles (QRDQN, TQC), their mean.
    :param greedy_actions: The most probable or most valuable action, ``(batch_size,)`` or ``(batch_size, n_sub_actions)``
    """

    probabilities: th.Tensor | None = None
    action_means: th.Tensor | None = None
    values: th.Tensor | None = None
    greedy_actions: th.Tensor | None = None


def model_outputs(model: BaseAlgorithm, batch: Batch) -> ModelOutputs:
    """
    :param model: A model of any algorithm of Stable-Baselines3 or sb3-contrib
    :param batch: ``observations``, as the networks get them; of off-policy algorithms the ``actions`` too, as in their replay
        buffer; of MaskablePPO the ``action_masks``, if they should apply. Recurrent networks take each observation as an
        episode's first.
    :return: Its outputs, in evaluation mode
    :raises TypeError: For an algorithm that is not known here
    """
    outputs = find_outputs(model)
    with th.no_grad(), evaluation_mode(model.policy):
        return outputs(model.policy, batch)


def churn(old: ModelOutputs, new: ModelOutputs) -> dict[str, float]:
    r"""
    The churn :math:`C_f(x, \theta, \Delta_\theta)` of Tang et al. (ICML 2025), https://arxiv.org/abs/2506.00592, averaged over
    a batch, for each kind of output that the algorithm has:

    - ``policy_churn``: of a categorical policy :func:`~sb3_cchain.analysis.metrics.churn.kl_divergence`; of a continuous one
      the mean squared difference of the action means, over batch and action dimensions
    - ``value_churn``: :func:`~sb3_cchain.churn.divergence.mean_absolute_change` of the values
    - ``greedy_action_changes``: :func:`~sb3_cchain.churn.divergence.action_changes` of the greedy actions

    :param old: Outputs before
    :param new: Outputs after, on the same batch
    :return: By name
    """
    churns = {}
    if old.probabilities is not None and new.probabilities is not None:
        churns["policy_churn"] = kl_divergence(old.probabilities, new.probabilities)
    if old.action_means is not None and new.action_means is not None:
        churns["policy_churn"] = mean_squared_difference(old.action_means, new.action_means).item()
    if old.values is not None and new.values is not None:
        churns["value_churn"] = mean_absolute_change(old.values, new.values)
    if old.greedy_actions is not None and new.greedy_actions is not None:
        churns["greedy_action_changes"] = action_changes(old.greedy_actions, new.greedy_actions)
    return churns


def find_outputs(model: BaseAlgorithm) -> Callable[[Any, Batch], ModelOutputs]:
    """
    :param model: A model
    :return: Maps its policy and a batch to the outputs
    :raises TypeError: For an algorithm that is not known here
    """
    for attributes, outputs in _KINDS.items():
        if all(hasattr(model.policy, attribute) for attribute in attributes):
            return outputs
    raise TypeError(f"The outputs of {type(model).__name__} with {type(model.policy).__name__} are not known")


def _actor_critic_outputs(policy: Any, batch: Batch) -> ModelOutputs:
    observations = batch["observations"]
    if "action_masks" in batch:
        actions = distribution_outputs(policy.get_distribution(observations, batch["action_masks"]))
    else:
        actions = policy_outputs(policy, observations)
    return _with_actions(policy, actions, policy_values(policy, observations))


def _recurrent_actor_critic_outputs(policy: Any, batch: Batch) -> ModelOutputs:
    observations = batch["observations"]
    episode_starts = th.zeros(n_observations(observations), device=policy.device)
    at_the_start = empty_memory(policy, observations), episode_starts
    distribution, _ = policy.get_distribution(observations, *at_the_start)
    return _with_actions(policy, distribution_outputs(distribution), policy.predict_values(observations, *at_the_start))


def _with_actions(policy: Any, actions: th.Tensor, values: th.Tensor) -> ModelOutputs:
    if isinstance(policy.action_space, spaces.Box):
        return ModelOutputs(action_means=actions, values=values)
    return ModelOutputs(probabilities=actions, values=values, greedy_actions=actions.argmax(dim=-1))


def _q_network_outputs(policy: Any, batch: Batch) -> ModelOutputs:
    return _with_greedy_actions(policy.q_net(batch["observations"]))


def _quantile_network_outputs(policy: Any, batch: Batch) -> ModelOutputs:
    return _with_greedy_actions(policy.quantile_net(batch["observations"]).mean(dim=1))


def _with_greedy_actions(q_values: th.Tensor) -> ModelOutputs:
    return ModelOutputs(values=q_values, greedy_actions=q_values.argmax(dim=1))


def _actor_and_critics_outputs(policy: Any, batch: Batch) -> ModelOutputs:
    observations = batch["observations"]
    values = policy.critic(observations, batch["actions"])
    # A tuple of (batch_size, 1), or with quantiles (batch_size, n_critics, n_quantiles)
    values = th.cat(values, dim=1) if isinstance(values, tuple) else values.mean(dim=2)
    return ModelOutputs(action_means=policy._predict(observations, deterministic=True), values=values)


def _actor_outputs(policy: Any, batch: Batch) -> ModelOutputs:
    actions = policy._predict(batch["observations"])
    if isinstance(policy.action_space, spaces.Box):
        return ModelOutputs(action_means=actions)
    return ModelOutputs(greedy_actions=actions)


# By attributes of the policy, because sb3-contrib need not be installed. The first match counts.
_KINDS: dict[tuple[str, ...], Callable[[Any, Batch], ModelOutputs]] = {
    ("lstm_actor",): _recurrent_actor_critic_outputs,
    ("predict_values",): _actor_critic_outputs,
    ("q_net",): _q_network_outputs,
    ("quantile_net",): _quantile_network_outputs,
    ("actor", "critic"): _actor_and_critics_outputs,
    ("action_net",): _actor_outputs,  # ARS
}


@contextmanager
def evaluation_mode(network: nn.Module) -> Iterator[None]:
    """
    Running BatchNorm statistics and no dropout inside the ``with`` block.

    :param network: A network; each of its modules gets its mode back afterwards
    """
    modes = [(module, module.training) for module in network.modules()]
    network.eval()
    try:
        yield
    finally:
        for module, training in modes:
            module.training = training
