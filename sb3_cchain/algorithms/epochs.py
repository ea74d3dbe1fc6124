"""The minibatches of an epoch, and any samples of it that lie side by side."""

from collections.abc import Callable, Iterator
from copy import deepcopy
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_cchain.algorithms.own_memory import fills_memory_again
from sb3_cchain.networks.policy_inputs import joined, n_observations, rows
from sb3_cchain.replaced import replaced

# Rollouts in SB3's buffers whose observations take at most this many bytes are gathered once per epoch, which holds them
# twice. Larger ones are gathered minibatch by minibatch
HELD_AT_MOST = 2**24


def draw_epoch(
    buffer: RolloutBuffer, get: Callable[..., Iterator[Any]], batch_size: int, *args: Any, **kwargs: Any
) -> "HeldEpoch | GatheredEpoch":
    """
    :param buffer: A rollout buffer
    :param get: Its own method ``get()``
    :param batch_size: Minibatch size
    :param args: Further arguments of ``get()``
    :param kwargs: Further keyword arguments of ``get()``
    :return: The minibatches that it gives
    """
    if not _is_sb3s(buffer, get):
        minibatches = [deepcopy(minibatch) for minibatch in get(batch_size, *args, **kwargs)]
        return HeldEpoch(minibatches, joined(*(minibatch.observations for minibatch in minibatches)))
    with replaced(buffer, "_get_samples", lambda indices, env=None: indices):
        epoch = GatheredEpoch(buffer, list(get(batch_size, *args, **kwargs)))
    return epoch.held() if _n_bytes(buffer.observations) <= HELD_AT_MOST else epoch


def _is_sb3s(buffer: RolloutBuffer, get: Callable[..., Iterator[Any]]) -> bool:
    """Whether the buffer draws and gathers minibatches as SB3's do."""
    gathers = getattr(getattr(buffer, "_get_samples", None), "__func__", None)
    return (
        getattr(get, "__func__", None) in (RolloutBuffer.get, DictRolloutBuffer.get)
        and gathers in (RolloutBuffer._get_samples, DictRolloutBuffer._get_samples)
        and not fills_memory_again(buffer, "to_torch")
    )


def _n_bytes(observations: Any) -> int:
    return sum(array.nbytes for array in (observations.values() if isinstance(observations, dict) else [observations]))


class HeldEpoch:
    """
    Holds all samples.

    :param minibatches: The minibatches
    :param observations: The observations of all of them, one after the other
    """

    def __init__(self, minibatches: list[Any], observations: PyTorchObs):
        self.sizes = [n_observations(minibatch.observations) for minibatch in minibatches]
        self._minibatches = minibatches
        self._observations = observations

    def minibatch(self, position: int) -> Any:
        """
        :param position: Number of a minibatch
        :return: The minibatch
        """
        return self._minibatches[position]

    def observations(self, start: int, size: int) -> PyTorchObs:
        """
        :param start: Position in the epoch
        :param size: Number of samples from there; the epoch's first follow its last
        :return: Their observations
        """
        beyond = max(start + size - n_observations(self._observations), 0)
        samples = rows(self._observations, slice(start, start + size - beyond))
        return joined(samples, rows(self._observations, slice(beyond))) if beyond else samples


class GatheredEpoch:
    """
    Gathers samples when their turn comes, so that images are not held twice.

    :param buffer: A rollout buffer of SB3
    :param indices: Of each minibatch, where its samples are in the buffer
    """

    def __init__(self, buffer: RolloutBuffer, indices: list[Any]):
        self.sizes = [len(minibatch) for minibatch in indices]
        self._buffer = buffer
        self._indices = indices
        self._epoch = np.concatenate(indices)

    def minibatch(self, position: int) -> Any:
        """
        :param position: Number of a minibatch
        :return: The minibatch
        """
        return self._buffer._get_samples(self._indices[position])

    def observations(self, start: int, size: int) -> PyTorchObs:
        """
        :param start: Position in the epoch
        :param size: Number of samples from there; the epoch's first follow its last
        :return: Their observations
        """
        return self._buffer._get_samples(self._epoch.take(range(start, start + size), mode="wrap")).observations

    def held(self) -> HeldEpoch:
        """
        :return: The same epoch, gathered at once, which takes less time
        """
        everything = self._buffer._get_samples(self._epoch)
        ends = np.cumsum(self.sizes).tolist()
        parts = [slice(end - size, end) for end, size in zip(ends, self.sizes, strict=True)]
        minibatches = [type(everything)(*(rows(each, part) for each in everything)) for part in parts]  # type: ignore[arg-type]
        return HeldEpoch(minibatches, everything.observations)
