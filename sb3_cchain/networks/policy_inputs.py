"""What the networks of a policy take in: a batch of observations and, when they are recurrent, a memory."""

from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs


def n_observations(observations: PyTorchObs) -> int:
    """
    :param observations: Batch of observations, of a ``Dict`` space a dict of tensors
    :return: How many there are
    """
    return len(next(iter(observations.values())) if isinstance(observations, dict) else observations)


def joined(*batches: PyTorchObs) -> PyTorchObs:
    """
    :param batches: Batches of observations
    :return: One batch of all of them
    """
    first = batches[0]
    if isinstance(first, dict):
        return {key: th.cat([batch[key] for batch in batches]) for key in first}  # type: ignore[index]
    return th.cat(batches)  # type: ignore[arg-type]


def rows(observations: PyTorchObs, chosen: slice) -> PyTorchObs:
    """
    :param observations: Batch of observations
    :param chosen: Which of them
    :return: These, as a view
    """
    if isinstance(observations, dict):
        return {key: tensor[chosen] for key, tensor in observations.items()}
    return observations[chosen]


def episode_start(policy: Any, observations: PyTorchObs) -> tuple[tuple[th.Tensor, th.Tensor], th.Tensor]:
    """
    :param policy: A recurrent policy of sb3-contrib
    :param observations: Batch of observations, each the first of an episode
    :return: What the policy takes beside them: the hidden state and the cell state of its LSTM, and that an episode starts
    """
    n_layers, _, size = policy.lstm_hidden_state_shape
    n_episodes = n_observations(observations)
    zeros = th.zeros(n_layers, n_episodes, size, device=policy.device)
    return (zeros, zeros), th.ones(n_episodes, device=policy.device)
