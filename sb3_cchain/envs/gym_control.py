"""Continual Gym Control: one environment whose observations are shifted by another constant in each task."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import ArrayLike, NDArray

from sb3_cchain.envs.continual_env import ContinualEnv
from sb3_cchain.validation import check_array, check_number


class ObservationOffset(gym.ObservationWrapper, RecordConstructorArgs):
    """
    Adds a constant to each observation.

    The observation space becomes unbounded, so that it is the same for all offsets.

    :param env: Environment with ``Box`` observations
    :param offset: What to add, of the observations' shape
    :raises TypeError: When the observations are not a ``Box`` of floating-point numbers
    :raises ValueError: When the offset is not an array of finite numbers, or its shape is not the observations'
    """

    def __init__(self, env: gym.Env, offset: ArrayLike):
        # As a list, so that the environment's spec can be written as JSON
        RecordConstructorArgs.__init__(self, offset=np.asarray(offset).tolist())
        gym.ObservationWrapper.__init__(self, env)
        space = env.observation_space
        if not isinstance(space, spaces.Box):
            raise TypeError(f"An observation offset needs Box observations, got {space}")
        if not np.issubdtype(space.dtype, np.floating):
            # The offset would be rounded, and the sum would overflow
            raise TypeError(f"An observation offset needs Box observations of floating-point numbers, got {space}")
        self.offset = check_array("offset", offset, space.shape, "the observations' shape", space.dtype)
        self.observation_space = spaces.Box(-np.inf, np.inf, space.shape, space.dtype)

    def observation(self, observation: NDArray[Any]) -> NDArray[Any]:
        """
        :param observation: Of the wrapped environment
        :return: The observation plus the offset
        """
        return observation + self.offset


class ContinualGymControl(ContinualEnv):
    """
    Continual Gym Control (Section 5.1 and Appendix A.1 of the C-CHAIN paper, after TRAC): a task is the same environment
    with a fixed offset added to every observation, drawn once per task from N(0, σ²) for each dimension. The first task's
    offset is zero, as in the released code.

    The environment's own limit of episode steps is lifted. ``gymnasium.make("Continual/...")`` sets a limit of 400 steps, as
    in the released code; ``max_episode_steps`` sets another.

    :param env_id: The environment, with ``Box`` observations
    :param n_tasks: Length of the sequence
    :param steps_per_task: Environment steps per task, one number for all or one per task
    :param offset_std: σ
    :param offset_seed: Seed of the offsets. They do not depend on ``reset(seed=...)``
    :param offsets: The offsets themselves, ``(n_tasks, *observation_shape)``; read back as the attribute ``offsets``
    :param kwargs: ``n_envs``, ``first_task``, ``cycles``, ``blend_steps``, ``render_mode``: see
        :class:`~sb3_cchain.ContinualEnv`. ``n_tasks`` and ``offsets`` are of one cycle. With ``blend_steps``, the offset goes
        from that of the task before to the task's own in a straight line
    :raises ValueError: Naming the argument that is out of its range
    :raises ImportError: When the package that the environment needs is not installed
    """

    def __init__(
        self,
        env_id: str,
        *,
        n_tasks: int = 10,
        steps_per_task: int | Sequence[int] = 160_000,
        offset_std: float = 2.0,
        offset_seed: int = 0,
        offsets: ArrayLike | None = None,
        **kwargs: Any,
    ):
        check_number("n_tasks", n_tasks, 1, integer=True)
        check_number("offset_std", offset_std, 0)
        check_number("offset_seed", offset_seed, 0, integer=True)
        self.env_id = env_id
        shape = (n_tasks, *_observation_shape(env_id))
        if offsets is None:
            self.offsets = np.random.default_rng(offset_seed).normal(0.0, offset_std, shape).astype(np.float32)
            self.offsets[0] = 0.0
        else:
            words = "the shape (n_tasks, *observation_shape) ="
            self.offsets = check_array("offsets", offsets, shape, words, np.float32)
        tasks = [partial(_make_task, env_id, offset) for offset in self.offsets]
        super().__init__(tasks, steps_per_task, **kwargs)

    @property
    def task_sequence(self) -> list[tuple[str, list[float]]]:
        """The environment and the offset of each task."""
        return [(self.env_id, offset.tolist()) for offset in self.offsets] * self.cycles

    def blend(self, weight: float) -> None:
        """
        :param weight: 0 for the offset of the task before, 1 for that of the present task
        """
        before, own = (self.offsets[task % len(self.offsets)] for task in (self.task_id - 1, self.task_id))
        self.task.offset[...] = (1 - weight) * before + weight * own  # type: ignore[attr-defined]


def _observation_shape(env_id: str) -> tuple[int, ...]:
    try:
        env = ContinualEnv([env_id], 1)
    except ImportError as error:
        if "Box2D" in str(error):
            raise ImportError(f'{error}. It comes with: pip install "sb3-cchain[box2d]"') from error
        raise
    env.close()
    if not isinstance(env.observation_space, spaces.Box):
        raise ValueError(f"`env_id` must be an environment with Box observations; {env_id!r} has {env.observation_space}")
    return env.observation_space.shape


def _make_task(env_id: str, offset: NDArray[Any], **kwargs: Any) -> gym.Env:
    # The checker around the continual environment suffices
    return ObservationOffset(gym.make(env_id, max_episode_steps=-1, disable_env_checker=True, **kwargs), offset)
