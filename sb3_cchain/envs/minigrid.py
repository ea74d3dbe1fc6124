"""Continual MiniGrid: a chain of tasks in grid worlds."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import FlattenObservation
from numpy.typing import NDArray

from sb3_cchain.envs.continual_env import ContinualEnv
from sb3_cchain.validation import check_choice, check_list


class ContinualMiniGrid(ContinualEnv[NDArray[np.uint8], np.int64]):
    """
    A chain of tasks of MiniGrid (Chevalier-Boisvert et al., NeurIPS 2023, https://arxiv.org/abs/2306.13831). An episode ends
    after MiniGrid's own number of steps.

    The default sequence is a choice of this package, not of a publication: unlock a door, fetch the key and go through the
    door, find the way through a wall.

    :param tasks: Ids of MiniGrid's environments; one may come again. Read back as the attribute ``task_names``
    :param steps_per_task: Environment steps per task, one number for all or one per task
    :param observations: What the agent sees of the 7 × 7 cells before it. ``"one_hot"``: object, colour and state of each cell
        one-hot, in one vector of 980 numbers, for MLP policies. ``"image"``: their numbers, ``(7, 7, 3)``, for a feature
        extractor of one's own. The mission, a sentence, is left out
    :param kwargs: ``n_envs``, ``first_task``, ``cycles``, ``render_mode``: see :class:`~sb3_cchain.ContinualEnv`
    :raises TypeError: When ``tasks`` is a string or not a list
    :raises ValueError: Naming the argument that is out of its range
    :raises ImportError: When MiniGrid is not installed
    """

    def __init__(
        self,
        tasks: Sequence[str] = ("MiniGrid-Unlock-v0", "MiniGrid-DoorKey-5x5-v0", "MiniGrid-SimpleCrossingS9N1-v0"),
        *,
        steps_per_task: int | Sequence[int] = 250_000,
        observations: str = "one_hot",
        **kwargs: Any,
    ):
        self.task_names = check_list("tasks", tasks, of="ids of MiniGrid's environments")
        check_choice("observations", observations, ("one_hot", "image"))
        self.observations = observations
        makers = [partial(_make_task, name, observations) for name in self.task_names]
        super().__init__(makers, steps_per_task, **kwargs)

    @property
    def task_sequence(self) -> list[str]:
        """The id of each task."""
        return self.task_names * self.cycles


def _make_task(env_id: str, observations: str, **kwargs: Any) -> gym.Env:
    try:
        # Importing it registers its environments
        from minigrid.minigrid_env import MiniGridEnv
        from minigrid.wrappers import ImgObsWrapper, OneHotPartialObsWrapper
    except ImportError as error:
        raise ImportError('MiniGrid is not installed: pip install "sb3-cchain[minigrid]"') from error
    # The checker around the continual environment suffices
    try:
        env = gym.make(env_id, disable_env_checker=True, **kwargs)
    except gym.error.UnregisteredEnv as error:
        raise ValueError(f"Unknown environment {env_id!r} in `tasks`: {error}") from error
    if not isinstance(env.unwrapped, MiniGridEnv):
        raise ValueError(f"`tasks` must be ids of MiniGrid's environments, got {env_id!r}")
    if observations == "image":
        return ImgObsWrapper(env)
    return FlattenObservation(ImgObsWrapper(OneHotPartialObsWrapper(env)))
