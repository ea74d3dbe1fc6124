"""Draws observations from a replay buffer, and actions, for a batch that needs no rewards or next observations."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_cchain.algorithms.own_memory import fills_memory_again
from sb3_cchain.churn.reducer import Observations
from sb3_cchain.replaced import replaced

# How SB3's replay buffers draw transitions, and how they gather those that were drawn. HerReplayBuffer does otherwise
_DRAWS = (ReplayBuffer.sample, DictReplayBuffer.sample)
_GATHERS = (ReplayBuffer._get_samples, DictReplayBuffer._get_samples, NStepReplayBuffer._get_samples)


@contextmanager
def kept_minibatches(buffer: ReplayBuffer) -> Iterator[None]:
    """
    Inside the ``with`` block a minibatch stays as it is when further transitions are drawn, also from a buffer that fills the
    same memory each time.

    :param buffer: The replay buffer
    """
    if not fills_memory_again(buffer, "sample", "_get_samples", "to_torch"):
        yield
        return
    sample = buffer.sample
    with replaced(buffer, "sample", lambda *args, **kwargs: deepcopy(sample(*args, **kwargs))):
        yield


@contextmanager
def unchanged(buffer: ReplayBuffer) -> Iterator[None]:
    """
    Draw from the replay buffer of a model that is being trained, for other ends than training. What a buffer sets in itself
    when it is drawn from, such as the indices whose priorities follow the losses, is put back afterwards. What it changes in
    place, such as the elements of an array, stays changed, and so do ``pos`` and ``full``: another thread may add transitions.

    :param buffer: The replay buffer
    """
    before = dict(vars(buffer))
    try:
        yield
    finally:
        for name in vars(buffer).keys() - before.keys():
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
    if (
        _is_overridden(buffer, "sample", _DRAWS)
        or _is_overridden(buffer, "_get_samples", _GATHERS)
        or fills_memory_again(buffer, "to_torch")
    ):
        with unchanged(buffer):
            samples: Any = buffer.sample(batch_size, env=env)
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


def _is_overridden(buffer: ReplayBuffer, name: str, originals: tuple[Callable[..., Any], ...]) -> bool:
    # By a subclass, or by an attribute of the buffer
    return getattr(getattr(buffer, name, None), "__func__", None) not in originals
