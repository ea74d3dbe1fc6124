"""Reference batches of on-policy algorithms: samples of rollouts, outside the minibatch whose update they measure."""

from collections.abc import Iterator, Sequence
from copy import deepcopy
from typing import Any, Protocol

from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_cchain.algorithms.epochs import draw_epoch
from sb3_cchain.algorithms.own_memory import fills_memory_again

# Where reference batches are taken from, by the name in `churn_reference`
REFERENCES = ("independent", "next")


class RolloutReferences(Protocol):
    """Stands in for ``rollout_buffer.get``, and has a reference batch for each minibatch of an epoch."""

    def get(self, batch_size: int | None = None, *args: Any, **kwargs: Any) -> Iterator[Any]:
        """
        :param batch_size: Minibatch size
        :param args: Further arguments of the buffer's own method
        :param kwargs: Further keyword arguments of the buffer's own method
        :return: The minibatches of one epoch
        """
        ...

    def reference(self, needs: Sequence[str] = (), of_policy: bool = True) -> Any:
        """
        :param needs: What the reference batch must hold beside the observations
        :param of_policy: Whether it is for the policy, or for the value function
        :return: The reference batch of the minibatch that is being trained on; None where there is no other data. It consists
            of the observations if nothing else is needed, otherwise it is a dict.
        """


class ReferenceBatches:
    """
    Draws a reference batch for each minibatch of an epoch of PPO, or of the value function of TRPO.

    The minibatches of an epoch are a random partition of the rollout. Whatever lies outside a minibatch is therefore a random
    sample that shares nothing with it (the paper's B_ref ∩ B_train = ∅). ``"independent"`` takes samples half an epoch away,
    ``"next"`` those that come next: the next minibatch or, at the end of an epoch, the first one. In a rollout of a single
    minibatch, which has no other data, the minibatch is its own reference batch.

    :param buffer: The rollout buffer
    :param kind: ``"independent"`` or ``"next"``
    :param size: Size of a reference batch in minibatches; what the rollout has outside the minibatch where that is less
    """

    # The reference batch of the minibatch that is being trained on, and whether that is the first of its epoch. None where no
    # minibatch is being trained on
    current: PyTorchObs | None = None
    starts_epoch: bool = False
    # How many samples the minibatch shares with the reference batch of the minibatch before: the first ones of both
    n_shared: int

    def __init__(self, buffer: RolloutBuffer, kind: str = "independent", size: float = 1.0):
        self._buffer = buffer
        self._get = buffer.get
        self._kind = kind
        self._size = size

    def get(self, batch_size: int | None = None, *args: Any, **kwargs: Any) -> Iterator[Any]:
        """
        :param batch_size: Minibatch size
        :param args: Further arguments of the buffer's own method
        :param kwargs: Further keyword arguments of the buffer's own method
        :return: The minibatches of one epoch
        """
        self.current = None
        if batch_size is None:  # TRPO's policy, which no optimiser changes
            yield from self._get(None, *args, **kwargs)
            return
        epoch, size_before = draw_epoch(self._buffer, self._get, batch_size, *args, **kwargs), 0
        for position, (start, size) in enumerate(self._places(epoch.sizes)):
            # With "next", the reference batch of the minibatch before begins with this minibatch
            self.n_shared = min(size_before, epoch.sizes[position]) if self._kind == "next" else 0
            self.current = epoch.observations(start, size)
            self.starts_epoch = position == 0
            yield epoch.minibatch(position)
            size_before = size

    def _places(self, sizes: Sequence[int]) -> Iterator[tuple[int, int]]:
        """For each minibatch where in the epoch its reference batch begins, and its size."""
        n_samples, half_an_epoch, end = sum(sizes), (len(sizes) + 1) // 2 * sizes[0], 0
        for minibatch_size in sizes:
            end += minibatch_size
            n_outside = n_samples - minibatch_size
            size = min(max(round(self._size * sizes[0]), 1), n_outside or n_samples)
            away = max(min(half_an_epoch - minibatch_size, n_outside - size), 0) if self._kind == "independent" else 0
            yield (end + away) % n_samples, size

    def reference(self, needs: Sequence[str] = (), of_policy: bool = True) -> PyTorchObs | None:
        """As of :class:`RolloutReferences`."""
        assert not needs
        return self.current


class ReferenceMinibatches:
    """
    Takes another minibatch of the epoch as reference batch, half an epoch away, from any rollout buffer: with action masks, or
    of sequences for recurrent networks, which cannot be cut. In a rollout of a single minibatch, which has no other data, the
    minibatch is its own reference batch.

    :param buffer: The rollout buffer
    """

    def __init__(self, buffer: RolloutBuffer):
        self._get = buffer.get
        self._fills_memory_again = fills_memory_again(buffer, "get", "_get_samples", "to_torch")
        self._sample: Any = None

    def get(self, batch_size: int | None = None, *args: Any, **kwargs: Any) -> Iterator[Any]:
        """
        :param batch_size: Minibatch size
        :param args: Further arguments of the buffer's own method
        :param kwargs: Further keyword arguments of the buffer's own method
        :return: The minibatches of one epoch
        """
        minibatches = [deepcopy(each) if self._fills_memory_again else each for each in self._get(batch_size, *args, **kwargs)]
        for position, minibatch in enumerate(minibatches):
            self._sample = minibatches[(position + (len(minibatches) + 1) // 2) % len(minibatches)]
            yield minibatch

    def reference(self, needs: Sequence[str] = (), of_policy: bool = True) -> Any:
        """As of :class:`RolloutReferences`."""
        sample = self._sample
        if sample is None:
            return None
        if not needs:
            return sample.observations
        batch = {name: getattr(sample, name) for name in ("observations", *needs)}
        if "lstm_states" in needs:
            hidden, cell = sample.lstm_states.pi if of_policy else sample.lstm_states.vf
            batch["lstm_states"] = {"hidden": hidden, "cell": cell}
        return batch


class PreviousRollout:
    """
    Takes the rollout before as reference batch, for A2C, which trains on each rollout as a whole and once.

    :param buffer: The rollout buffer
    :param previous: Observations of the rollout before, if it is known
    """

    def __init__(self, buffer: RolloutBuffer, previous: PyTorchObs | None):
        self._get = buffer.get
        self._fills_memory_again = fills_memory_again(buffer, "get", "_get_samples", "to_torch")
        self._previous = previous
        # Observations of the rollout that is being trained on
        self.current: PyTorchObs | None = None

    def get(self, batch_size: int | None = None, *args: Any, **kwargs: Any) -> Iterator[Any]:
        """
        :param batch_size: Minibatch size
        :param args: Further arguments of the buffer's own method
        :param kwargs: Further keyword arguments of the buffer's own method
        :return: The minibatch
        """
        for minibatch in self._get(batch_size, *args, **kwargs):
            self.current = deepcopy(minibatch.observations) if self._fills_memory_again else minibatch.observations
            yield minibatch

    def reference(self, needs: Sequence[str] = (), of_policy: bool = True) -> PyTorchObs | None:
        """As of :class:`RolloutReferences`."""
        assert not needs
        return self._previous
