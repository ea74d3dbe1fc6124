"""Draws observations from a replay buffer, and actions, for a batch that needs no rewards or next observations."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_cchain.algorithms.own_memory import copied, is_shared
from sb3_cchain.churn.reducer import Observations
from sb3_cchain.replaced import replaced

# How SB3's replay buffers draw transitions, and how they gather those that were drawn. HerReplayBuffer does otherwise
_DRAWS = (ReplayBuffer.sample, DictReplayBuffer.sample)
_GATHERS = (ReplayBuffer._get_samples, DictReplayBuffer._get_samples, NStepReplayBuffer._get_samples)


class _CopyingSample:
    """
    Stands in for a buffer's ``sample()``, and copies what that gives.

    :param buffer: The replay buffer
    """

    def __init__(self, buffer: ReplayBuffer):
        self.sample = buffer.sample
        self.own_sample = vars(buffer).get("sample")  # set by the user on this object

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return copied(self.sample(*args, **kwargs))


@contextmanager
def kept_minibatches(buffer: ReplayBuffer) -> Iterator[None]:
    """
    Inside the ``with`` block a minibatch stays as it is when further transitions are drawn, also from a buffer that fills the
    same memory each time.

    :param buffer: The replay buffer
    """
    if _fills_memory_again(buffer):
        with replaced(buffer, "sample", _CopyingSample(buffer)):
            yield
    else:
        yield


def kept(buffer: ReplayBuffer, minibatch: Any) -> Any:
    """
    :param buffer: A replay buffer
    :param minibatch: What was just drawn from it
    :return: The same, which stays as it is when further transitions are drawn
    """
    return copied(minibatch) if _fills_memory_again(buffer) else minibatch


@contextmanager
def aside(buffer: ReplayBuffer) -> Iterator[Any]:
    """
    Draw from the replay buffer of a model that is being trained, for other ends than training. What a buffer sets in itself
    when it is drawn from, such as the indices whose priorities follow the losses, is not set afterwards; what it changes in
    place, such as the elements of an array, is changed. Another thread may fill the buffer meanwhile.

    :param buffer: The replay buffer
    :return: What to draw from: a copy with the same transitions
    """
    before = dict(vars(buffer))
    sample = before.pop("sample", None)
    if isinstance(sample, _CopyingSample):
        sample = sample.own_sample
    if sample is None:
        result: Any = object.__new__(type(buffer))  # copy() leaves out what is not pickled, such as HerReplayBuffer's `env`
        vars(result).update(before)
        yield result
        return
    # A function that was put on this very object draws from it, and not from a copy
    try:
        yield buffer
    finally:
        for name in vars(buffer).keys() - before.keys() - {"sample"}:
            delattr(buffer, name)
        vars(buffer).update({name: value for name, value in before.items() if name not in ("pos", "full")})


def sample_observations(
    buffer: ReplayBuffer, batch_size: int, env: VecNormalize | None, with_actions: bool = False
) -> Observations:
    """
    Draw what ``buffer.sample(batch_size, env).observations`` would be, from the same random numbers, and leave the buffer as
    it is. The rest of the transitions is not gathered, except from a buffer that does not draw or gather them as SB3's own do.

    :param buffer: A replay buffer
    :param batch_size: Number of observations
    :param env: Normalises them
    :param with_actions: Whether the actions are drawn, too
    :return: The observations; with actions ``observations`` and ``actions``
    """
    if _is_overridden(buffer.sample, _DRAWS) or _is_overridden(buffer._get_samples, _GATHERS) or is_shared(buffer.to_torch):
        with aside(buffer) as drawn_from:
            samples: Any = kept(buffer, drawn_from.sample(batch_size, env=env))
        return {"observations": samples.observations, "actions": samples.actions} if with_actions else samples.observations
    with replaced(buffer, "_get_samples", lambda indices, env=None: indices):
        indices: Any = buffer.sample(batch_size)
    chosen = indices, np.random.randint(0, buffer.n_envs, size=batch_size)
    arrays: Any = buffer.observations
    drawn = {key: array[chosen] for key, array in arrays.items()} if isinstance(arrays, dict) else arrays[chosen]
    normalized: Any = buffer._normalize_obs(drawn, env)
    if isinstance(normalized, dict):
        observations: Any = {key: buffer.to_torch(array) for key, array in normalized.items()}
    else:
        observations = buffer.to_torch(normalized)
    return {"observations": observations, "actions": buffer.to_torch(buffer.actions[chosen])} if with_actions else observations


def _fills_memory_again(buffer: ReplayBuffer) -> bool:
    return is_shared(buffer.sample, buffer._get_samples, buffer.to_torch)


def _is_overridden(method: Callable[..., Any], originals: tuple[Callable[..., Any], ...]) -> bool:
    # By a subclass, or by an attribute of the buffer
    return getattr(method, "__func__", None) not in originals
