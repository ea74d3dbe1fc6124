"""Reference batches for PPO: samples of the same rollout, outside the minibatch whose update they measure."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_cchain.networks.policy_inputs import rows
from sb3_cchain.replaced import replaced

# Where reference batches are taken from, by the name in `churn_reference`
REFERENCES = ("independent", "next")

# Rollouts whose observations take at most this many bytes are gathered once per epoch, instead of once per minibatch; that is
# another copy of the rollout
GATHERED_AT_ONCE = 2**24


class ReferenceBatches:
    """
    Stands in for ``rollout_buffer.get`` and draws a reference batch for each minibatch of an epoch.

    The minibatches of an epoch are a random partition of the rollout. Whatever lies outside a minibatch is therefore a random
    sample that shares nothing with it (the paper's B_ref ∩ B_train = ∅). ``"independent"`` takes samples half an epoch away,
    ``"next"`` those that come next: the next minibatch or, at the end of an epoch, the first one. In a rollout of a single
    minibatch, which has no other data, the minibatch is its own reference batch.

    :param buffer: The rollout buffer
    :param kind: ``"independent"`` or ``"next"``
    :param size: Size of a reference batch in minibatches; what the rollout has outside the minibatch where that is less
    """

    # The reference batch of the minibatch that is being trained on, and whether that is the first of its epoch
    current: PyTorchObs
    starts_epoch: bool
    # How many samples, the first ones, the minibatch and the reference batch of the one before have in common
    n_shared: int

    def __init__(self, buffer: RolloutBuffer, kind: str = "independent", size: float = 1.0):
        self._buffer = buffer
        self._get = buffer.get
        self._kind = kind
        self._size = size

    def get(self, batch_size: int | None = None) -> Iterator[Any]:
        """
        :param batch_size: Minibatch size
        :return: The minibatches of one epoch
        """
        minibatches = self._minibatch_indices(batch_size)
        epoch = np.concatenate(minibatches)
        samples = self._samples_at(epoch)
        full_size = len(minibatches[0])
        half_an_epoch = (len(minibatches) + 1) // 2 * full_size
        end = n_in_next = 0
        for position, indices in enumerate(minibatches):
            end += len(indices)
            n_outside = len(epoch) - len(indices)
            size = min(max(round(self._size * full_size), 1), n_outside or len(epoch))
            self.n_shared, n_in_next = n_in_next, 0
            start = end
            if self._kind == "independent":
                start += max(min(half_an_epoch - len(indices), n_outside - size), 0)
            elif position + 1 < len(minibatches):
                n_in_next = min(size, len(minibatches[position + 1]))
            self.current = samples(start % len(epoch), size).observations
            self.starts_epoch = position == 0
            yield samples(end - len(indices), len(indices))

    def _minibatch_indices(self, batch_size: int | None) -> list[np.ndarray]:
        minibatches: list[Any]
        with replaced(self._buffer, "_get_samples", lambda indices, env=None: indices):
            minibatches = list(self._get(batch_size))
        if not all(isinstance(indices, np.ndarray) for indices in minibatches):
            raise TypeError(
                f"{type(self._buffer).__name__}.get() must gather its minibatches by `_get_samples(indices)`, as "
                "SB3's rollout buffers do"
            )
        return minibatches

    def _samples_at(self, epoch: np.ndarray) -> Callable[[int, int], Any]:
        """
        :param epoch: Indices of all samples in the order of the epoch
        :return: What gives so many samples from a position in it on; the first follow the last
        """
        gather = self._buffer._get_samples

        def from_buffer(start: int, size: int) -> Any:
            return gather(epoch.take(range(start, start + size), mode="wrap"))

        if self._n_bytes() > GATHERED_AT_ONCE:
            return from_buffer
        # Gathering all at once takes less time
        everything = from_buffer(0, len(epoch))

        def from_epoch(start: int, size: int) -> Any:
            if start + size > len(epoch):
                return from_buffer(start, size)
            return type(everything)(*(rows(part, slice(start, start + size)) for part in everything))

        return from_epoch

    def _n_bytes(self) -> int:
        observations = self._buffer.observations
        return sum(array.nbytes for array in (observations.values() if isinstance(observations, dict) else [observations]))
