"""The outputs of any Stable-Baselines3 model, and how far they moved."""

from dataclasses import dataclass
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_cchain.analysis.metrics.churn import kl_divergence
from sb3_cchain.churn.divergence import action_changes, mean_absolute_change, mean_squared_difference
from sb3_cchain.networks.batch_outputs import Batch, PolicyKind, policy_kind
from sb3_cchain.networks.evaluation_mode import evaluation_mode


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
    kind = known_kind(model)
    with th.no_grad(), evaluation_mode(model.policy):
        return _outputs_of_kind(kind, model.policy, batch)


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


def known_kind(model: BaseAlgorithm) -> PolicyKind:
    """
    :param model: A model
    :return: The kind of its policy
    :raises TypeError: For an algorithm that is not known here
    """
    kind = policy_kind(model.policy)
    if kind is None:
        raise TypeError(f"The outputs of {type(model).__name__} with {type(model.policy).__name__} are not known")
    return kind


def _outputs_of_kind(kind: PolicyKind, policy: Any, batch: Batch) -> ModelOutputs:
    actions = None if kind.actions is None else kind.actions(policy, batch)
    values = None if kind.values is None else kind.mean_values(policy, batch)
    if actions is None:
        assert values is not None
        return ModelOutputs(values=values, greedy_actions=values.argmax(dim=1))
    if isinstance(policy.action_space, spaces.Box):
        return ModelOutputs(action_means=actions, values=values)
    if values is None:  # ARS, whose actor gives the actions themselves
        return ModelOutputs(greedy_actions=actions)
    return ModelOutputs(probabilities=actions, values=values, greedy_actions=actions.argmax(dim=-1))
