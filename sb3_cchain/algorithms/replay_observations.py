"""Draws observations from a replay buffer, and actions, for a batch that needs no rewards or next observations."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_cchain.churn.reducer import Observations

# How SB3's replay buffers draw transitions, and how they gather those that were drawn. HerReplayBuffer does otherwise
_DRAWS = (ReplayBuffer.sample, DictReplayBuffer.sample)
_GATHERS = (ReplayBuffer._get_samples, DictReplayBuffer._get_samples, NStepReplayBuffer._get_samples)


def sample_observations(buffer: ReplayBuffer, batch_size: int, env: VecNormalize | None) -> Observations:
    """
    Draw what ``buffer.sample(batch_size, env).observations`` would be, from the same random numbers. The rest of the
    transitions is not gathered, except from a buffer that does not draw or gather them as SB3's own do.

    :param buffer: A replay buffer
    :param batch_size: Number of observations
    :param env: Normalises them
    :return: The observations
    """
    return _sample(buffer, batch_size, env, with_actions=False)[0]


def sample_with_actions(buffer: ReplayBuffer, batch_size: int, env: VecNormalize | None) -> Observations:
    """
    As :func:`sample_observations`, with the actions.

    :param buffer: A replay buffer
    :param batch_size: Number of observations
    :param env: Normalises them
    :return: ``observations`` and ``actions``
    """
    observations, actions = _sample(buffer, batch_size, env, with_actions=True)
    return {"observations": observations, "actions": actions}


def _sample(
    buffer: ReplayBuffer, batch_size: int, env: VecNormalize | None, with_actions: bool
) -> tuple[Observations, th.Tensor | None]:
    if _is_overridden(buffer.sample, _DRAWS) or _is_overridden(buffer._get_samples, _GATHERS):
        samples = buffer.sample(batch_size, env=env)
        return samples.observations, samples.actions
    if buffer.optimize_memory_usage and buffer.full:
        # Not the transition at `pos`: its observation was overwritten by the newest next observation
        indices = (np.random.randint(1, buffer.buffer_size, size=batch_size) + buffer.pos) % buffer.buffer_size
    else:
        indices = np.random.randint(0, buffer.buffer_size if buffer.full else buffer.pos, size=batch_size)
    env_indices = np.random.randint(0, buffer.n_envs, size=batch_size)
    actions = buffer.to_torch(buffer.actions[indices, env_indices]) if with_actions else None
    if isinstance(buffer, DictReplayBuffer):
        observations = buffer._normalize_obs(
            {key: array[indices, env_indices] for key, array in buffer.observations.items()}, env
        )
        assert isinstance(observations, dict)
        return {key: buffer.to_torch(array) for key, array in observations.items()}, actions
    array = buffer._normalize_obs(buffer.observations[indices, env_indices], env)
    assert isinstance(array, np.ndarray)
    return buffer.to_torch(array), actions


def _is_overridden(method: Callable[..., Any], originals: tuple[Callable[..., Any], ...]) -> bool:
    # By a subclass, or by an attribute of the buffer
    return getattr(method, "__func__", None) not in originals
