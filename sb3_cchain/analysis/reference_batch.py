"""Batches of the data that a model is being trained on."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_cchain.algorithms.replay_observations import kept_minibatches, unchanged
from sb3_cchain.networks.batch_outputs import Batch


def sample_batch(model: OnPolicyAlgorithm | OffPolicyAlgorithm, batch_size: int) -> Batch:
    """
    Observations as the networks get them. On-policy they come from the rollout, without repetition, so there are at most as
    many as in the rollout, with the action masks of MaskablePPO; call it between the end of a rollout and the start of the
    next. Off-policy they come from the replay buffer, with the actions.

    :param model: A model
    :param batch_size: How many
    :return: Tensors on the model's device
    """
    if isinstance(model, OffPolicyAlgorithm):
        assert model.replay_buffer is not None
        with unchanged(model.replay_buffer), kept_minibatches(model.replay_buffer):
            sample = model.replay_buffer.sample(batch_size, env=model._vec_normalize_env)
        return {"observations": sample.observations, "actions": sample.actions}
    buffer: Any = model.rollout_buffer
    indices = np.random.permutation(buffer.buffer_size * buffer.n_envs)[:batch_size]
    # (n_steps, n_envs, ...) before train() begins, then flat
    shapes, arrays = buffer.obs_shape, buffer.observations
    if isinstance(arrays, dict):
        observations: Any = {key: array.reshape(-1, *shapes[key])[indices] for key, array in arrays.items()}
    else:
        observations = arrays.reshape(-1, *shapes)[indices]
    batch: Batch = {"observations": observations}
    if hasattr(buffer, "action_masks"):
        batch["action_masks"] = buffer.action_masks.reshape(-1, buffer.mask_dims)[indices]
    return map_batch(partial(th.as_tensor, device=model.device), batch)


def map_batch(function: Callable[[Any], Any], batch: Batch) -> Batch:
    """
    :param function: What to apply to each tensor or array
    :param batch: A batch, of which the observations may be a dict
    :return: The same with the results in their places
    """
    return {name: map_batch(function, value) if isinstance(value, dict) else function(value) for name, value in batch.items()}
