"""Tasks whose observations and actions differ in number: one space for all of them."""

from collections.abc import Sequence
from functools import partial
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from sb3_cchain.envs.continual_env import ContinualEnv
from sb3_cchain.envs.reset import reset_env
from sb3_cchain.validation import check_choice, check_list, check_number


class CommonSpaces(gym.Wrapper, RecordConstructorArgs):
    """
    Makes an environment's observations longer and its actions more numerous, so that it agrees in its spaces with others.

    - Observations are flattened (:func:`gymnasium.spaces.flatten`: one-hot if they are ``Discrete``) and padded with zeros.
    - ``Discrete`` actions: those beyond the environment's own do what ``extra_actions`` says. :meth:`action_masks` tells them
      apart, for sb3-contrib's ``MaskablePPO``, which then never takes them.
    - ``Box`` actions: numbers from -1 to 1, scaled to the environment's bounds; those beyond its own do nothing.

    :param env: The environment
    :param observation_size: Numbers in an observation after padding
    :param n_actions: Actions (``Discrete``), or numbers in an action (``Box``), that the agent chooses from
    :param extra_actions: What a ``Discrete`` action beyond the environment's own does: ``"first"`` what its first action does,
        ``"wrap"`` what the one does that has its number, counted round and round
    :raises TypeError: When observations cannot be flattened to a vector, or actions are neither ``Discrete`` nor a bounded
        one-dimensional ``Box``
    :raises ValueError: When the environment has more observations or actions than that
    """

    def __init__(self, env: gym.Env, observation_size: int, n_actions: int, extra_actions: str = "first"):
        RecordConstructorArgs.__init__(
            self, observation_size=observation_size, n_actions=n_actions, extra_actions=extra_actions
        )
        gym.Wrapper.__init__(self, env)
        check_choice("extra_actions", extra_actions, ("first", "wrap"))
        self.extra_actions = extra_actions
        own_observations, own_actions = observation_size_of(env), n_actions_of(env)
        for name, given, own in (
            ("observation_size", observation_size, own_observations),
            ("n_actions", n_actions, own_actions),
        ):
            check_number(name, given, 1, integer=True)
            if given < own:
                raise ValueError(f"`{name}` must be at least {own}, what {env} has, got {given!r}")
        self._size, self._n_own = int(observation_size), own_actions
        self._inner_observations, self._inner_actions = env.observation_space, env.action_space
        self.observation_space = spaces.Box(-np.inf, np.inf, (self._size,), np.float32)
        self.action_space = (
            spaces.Discrete(int(n_actions))
            if isinstance(env.action_space, spaces.Discrete)
            else spaces.Box(-1, 1, (int(n_actions),), np.float32)
        )

    def action_masks(self) -> NDArray[np.bool_]:
        """
        :return: Which ``Discrete`` actions are the environment's own, ``(n_actions,)``
        :raises TypeError: When actions are not ``Discrete``
        """
        if not isinstance(self.action_space, spaces.Discrete):
            raise TypeError(f"Only Discrete actions can be masked, got {self.action_space}")
        return np.arange(self.action_space.n) < self._n_own

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """
        :param seed: Passed on
        :param options: Passed on
        :return: Observation and info
        """
        observation, info = reset_env(self.env, seed, options)
        return self._padded(observation), info

    def step(self, action: Any) -> tuple[NDArray[np.float32], SupportsFloat, bool, bool, dict[str, Any]]:
        """
        :param action: The action
        :return: Observation, reward, terminated, truncated, info
        """
        observation, reward, terminated, truncated, info = self.env.step(self._own_action(action))
        return self._padded(observation), reward, terminated, truncated, info

    def _padded(self, observation: Any) -> NDArray[np.float32]:
        padded = np.zeros(self._size, dtype=np.float32)
        flat: Any = spaces.flatten(self._inner_observations, observation)
        padded[: len(flat)] = flat
        return padded

    def _own_action(self, action: Any) -> Any:
        space = self._inner_actions
        if isinstance(space, spaces.Discrete):
            if action >= self._n_own:
                action = action % self._n_own if self.extra_actions == "wrap" else 0
            return space.start + action
        assert isinstance(space, spaces.Box)
        share = (np.asarray(action[: self._n_own]) + 1) / 2
        return np.clip(space.low + share * (space.high - space.low), space.low, space.high).astype(space.dtype)


class ContinualSequence(ContinualEnv[NDArray[np.float32], Any]):
    """
    A chain of any environments, whose spaces may differ: observations are padded to the longest, actions to the most numerous,
    by :class:`~sb3_cchain.envs.CommonSpaces`.

    :param env_ids: The environments, all with ``Discrete`` or all with ``Box`` actions; one may come again
    :param steps_per_task: Environment steps per task, one number for all or one per task
    :param observation_size: Numbers in an observation after padding; None for as many as the longest has
    :param n_actions: Actions to choose from; None for as many as the environment with the most has
    :param extra_actions: See :class:`~sb3_cchain.envs.CommonSpaces`
    :param kwargs: ``n_envs``, ``first_task``, ``cycles``, ``render_mode``: see :class:`~sb3_cchain.ContinualEnv`
    :raises TypeError: When ``env_ids`` is a string or not a list, or an environment's spaces cannot be padded
    :raises ValueError: Naming the argument that is out of its range, or the environments that do not fit together
    :raises ImportError: When the package that an environment needs is not installed
    """

    def __init__(
        self,
        env_ids: Sequence[str] = ("CartPole-v1", "Acrobot-v1", "MountainCar-v0"),
        *,
        steps_per_task: int | Sequence[int] = 100_000,
        observation_size: int | None = None,
        n_actions: int | None = None,
        extra_actions: str = "first",
        **kwargs: Any,
    ):
        self.env_ids = check_list("env_ids", env_ids, of="environment ids")
        if observation_size is None or n_actions is None:
            sizes = [_sizes(env_id) for env_id in self.env_ids]
            if observation_size is None:
                observation_size = max((size for size, _ in sizes), default=1)
            if n_actions is None:
                n_actions = max((number for _, number in sizes), default=1)
        makers = [partial(_make_task, env_id, observation_size, n_actions, extra_actions) for env_id in self.env_ids]
        super().__init__(makers, steps_per_task, **kwargs)

    @property
    def task_sequence(self) -> list[str]:
        """The environment of each task."""
        return self.env_ids * self.cycles

    def action_masks(self) -> NDArray[np.bool_]:
        """
        :return: See :meth:`~sb3_cchain.envs.CommonSpaces.action_masks`, of the present task
        """
        return self.task.get_wrapper_attr("action_masks")()


def observation_size_of(env: gym.Env) -> int:
    """
    :param env: An environment
    :return: Numbers in an observation when it is flattened
    :raises TypeError: When it cannot be
    """
    space = env.observation_space
    if not space.is_np_flattenable:
        raise TypeError(f"Padding needs observations that can be flattened to a vector, {env} has {space}")
    return spaces.flatdim(space)


def n_actions_of(env: gym.Env) -> int:
    """
    :param env: An environment
    :return: The number of its actions (``Discrete``) or of the numbers in them (``Box``)
    :raises TypeError: When they are of another kind, or not bounded
    """
    space = env.action_space
    if isinstance(space, spaces.Discrete):
        return int(space.n)
    if isinstance(space, spaces.Box) and len(space.shape) == 1 and space.is_bounded():
        return space.shape[0]
    raise TypeError(f"Padding needs actions that are Discrete or a bounded one-dimensional Box, {env} has {space}")


def _sizes(env_id: str) -> tuple[int, int]:
    env = ContinualEnv([env_id], 1)  # for its errors
    env.close()
    return observation_size_of(env.task), n_actions_of(env.task)


def _make_task(env_id: str, observation_size: int, n_actions: int, extra_actions: str, **kwargs: Any) -> gym.Env:
    # The checker around the continual environment suffices
    return CommonSpaces(gym.make(env_id, disable_env_checker=True, **kwargs), observation_size, n_actions, extra_actions)
