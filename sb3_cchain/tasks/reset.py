"""Begins new episodes in the training environment."""

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm


def reset_training_env(model: BaseAlgorithm) -> None:
    """
    Reset the training environment between two rollouts, and let the model know, as ``learn()`` does before the first one.

    :param model: A model that is being trained
    """
    assert model.env is not None
    model._last_obs = model.env.reset()  # type: ignore[assignment]
    model._last_episode_starts = np.ones(model.env.num_envs, dtype=bool)
    normalize = model.get_vec_normalize_env()
    if normalize is not None:
        model._last_original_obs = normalize.get_original_obs()
