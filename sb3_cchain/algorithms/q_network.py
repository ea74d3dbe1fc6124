"""Churn reduction of a Q-network: the forward passes that it shares with DQN's update, and what is logged."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch as th
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_cchain.algorithms.churn_log import log_churn
from sb3_cchain.churn.divergence import action_changes, mean_absolute_change
from sb3_cchain.churn.reducer import Observations
from sb3_cchain.networks.policy_inputs import joined, n_observations


class QValues(NamedTuple):
    """The online network's action values that an update of C-CHAIN DQN needs, ``(batch_size, n_actions)`` each."""

    # Of the minibatch's observations
    current: th.Tensor
    # Of its next observations, without gradient; None without Double Q-learning
    next: th.Tensor | None
    # Of the reference batch that the next update's churn loss is computed on, without gradient
    reference: th.Tensor
    # Of the reference batch of the update before; None in the first update
    previous_reference: th.Tensor | None


def joint_pass(
    q_net: Callable[[Observations], th.Tensor],
    replay_data: ReplayBufferSamples,
    reference: Observations,
    previous_reference: Observations | None,
    double_q: bool,
) -> QValues:
    """
    Compute all action values in the two forward passes of Double DQN: the reference batch goes through the network together
    with the next observations (no gradient), the reference batch of the update before together with the observations.
    Without Double Q-learning the reference batch needs a pass of its own, because DQN's next observations go through the
    target network only.

    Right only where the outputs of one sample do not depend on the other samples, nor on training or evaluation mode.

    :param q_net: The online network
    :param replay_data: The minibatch
    :param reference: The reference batch that was drawn for the next update
    :param previous_reference: The reference batch that was drawn in the update before
    :param double_q: Whether the next observations' values are needed
    :return: The action values
    """
    next_values = None
    with th.no_grad():
        if double_q:
            next_values, reference_values = _both(q_net, replay_data.next_observations, reference)
        else:
            reference_values = q_net(reference)
    if previous_reference is None:
        return QValues(q_net(replay_data.observations), next_values, reference_values, None)
    values, previous_values = _both(q_net, replay_data.observations, previous_reference)
    return QValues(values, next_values, reference_values, previous_values)


def _both(
    q_net: Callable[[Observations], th.Tensor], minibatch: Observations, reference: Observations
) -> tuple[th.Tensor, th.Tensor]:
    """One pass for two batches."""
    values, reference_values = q_net(joined(minibatch, reference)).split(
        [n_observations(minibatch), n_observations(reference)]
    )
    return values, reference_values


def log_q_churn(logger: Logger, coef: float, churn_loss: float, td_loss: float, old: th.Tensor, new: th.Tensor) -> None:
    """
    Log the churn of one update. The logger averages over the updates between two logs, and holds no tensor.

    - ``churn/loss``: the churn loss L_churn, the mean squared change of all action values
    - ``churn/coef``: the λ it was multiplied by
    - ``churn/relative_loss``: λ·L_churn / L, where L is the TD loss. The mean of these ratios is greater than the ratio of the
      means, which an adaptive λ holds at β
    - ``churn/value_churn``: mean absolute change of the action values by an update
    - ``churn/greedy_action_changes``: share of the states whose greedy action an update changed

    :param logger: The model's logger
    :param coef: λ
    :param churn_loss: L_churn
    :param td_loss: L
    :param old: Action values of the reference batch before an update, ``(batch_size, n_actions)``
    :param new: Action values of the same batch after it
    """
    log_churn(logger.record_mean, "churn", coef, churn_loss, td_loss)
    logger.record_mean("churn/value_churn", mean_absolute_change(old, new))
    logger.record_mean("churn/greedy_action_changes", action_changes(old.argmax(dim=1), new.argmax(dim=1)))


def finite_td_loss(loss: th.Tensor, replay_data: ReplayBufferSamples) -> float:
    """
    :param loss: The mean loss of the TD errors
    :param replay_data: The minibatch that it was computed on
    :return: Its value
    :raises ValueError: When it is NaN or infinite, naming what made it so
    """
    value = loss.item()
    if math.isfinite(value):
        return value
    raise ValueError(f"The TD loss is {value}: {_cause(replay_data)} The parameters have not been updated.")


def _cause(replay_data: ReplayBufferSamples) -> str:
    for name, data in (
        ("rewards", replay_data.rewards),
        ("observations", replay_data.observations),
        ("next observations", replay_data.next_observations),
    ):
        for tensor in data.values() if isinstance(data, dict) else [data]:
            wrong = tensor[~tensor.isfinite()]
            if len(wrong):
                return (
                    f"the {name} of the minibatch hold {wrong[0].item()}. Fix the environment, or clip what it returns; "
                    "the replay buffer holds the faulty transition."
                )
    return (
        "the network's action values are too large or NaN, while the observations and rewards of the minibatch are finite "
        f"(the largest reward is {replay_data.rewards.abs().max().item():g} in absolute value). Scale the rewards, lower the "
        "learning rate or set `max_grad_norm`."
    )
