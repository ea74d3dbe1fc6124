"""Continual DeepMind Control: a chain of tasks of one robot."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from sb3_cchain.envs.continual_env import ContinualEnv
from sb3_cchain.validation import check_list


class FlatDMControl(gym.Wrapper, RecordConstructorArgs):
    """
    Makes an environment of dm_control, as Shimmy wraps it, suitable for Stable-Baselines3.

    - Observations are flattened, in the order of :class:`gymnasium.wrappers.FlattenObservation`: their parts by name. They
      are ``float32``, which halves the memory of buffers; the networks would not use the precision of ``float64``.
    - Actions are clipped to dm_control's bounds. The action space keeps the bounds, as ``float32``. (The action space of
      Gymnasium's ``ClipAction`` has no bounds, which Stable-Baselines3 refuses.)

    :param env: The environment
    :raises TypeError: When its observations are not a ``Dict`` or its actions not a ``Box``
    """

    def __init__(self, env: gym.Env):
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        observations, actions = env.observation_space, env.action_space
        if not isinstance(observations, spaces.Dict) or not isinstance(actions, spaces.Box):
            raise TypeError(f"Flattening needs Dict observations and Box actions, got {observations} and {actions}")
        self._names = list(observations)
        self._low, self._high = actions.low, actions.high
        shape = (spaces.flatdim(observations),)
        self.observation_space = spaces.Box(-np.inf, np.inf, shape, np.float32)
        # Rounded to float32 a bound may lie outside of dm_control's own (0.8 of the quadruped does): clipping corrects that
        self.action_space = spaces.Box(self._low.astype(np.float32), self._high.astype(np.float32), dtype=np.float32)
        # Shimmy's `render_fps` is the length of a step in milliseconds, that of the environment made last
        fps = round(1 / env.unwrapped.dt)  # type: ignore[attr-defined]
        self.metadata = {**env.metadata, "render_modes": ["human", "rgb_array"], "render_fps": fps}

    def _flatten(self, observation: dict[str, NDArray[Any]]) -> NDArray[np.float32]:
        # A few times faster than `spaces.flatten` and a cast
        parts = [observation[name].reshape(-1) for name in self._names]
        return np.concatenate(parts, dtype=np.float32, casting="same_kind")

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """
        :param seed: From 0 to 2³² - 1
        :param options: Passed on
        :return: Observation and info
        """
        observation, info = self.env.reset(seed=seed, options=options)
        return self._flatten(observation), info

    def step(self, action: NDArray[np.floating[Any]]) -> tuple[NDArray[np.float32], SupportsFloat, bool, bool, dict[str, Any]]:
        """
        :param action: The action; values out of bounds are clipped
        :return: Observation, reward, terminated, truncated, info
        """
        clipped = np.clip(action, self._low, self._high)
        observation, reward, terminated, truncated, info = self.env.step(clipped)
        return self._flatten(observation), float(reward), terminated, truncated, info


class ContinualDMControl(ContinualEnv[NDArray[np.float32], NDArray[np.floating[Any]]]):
    """
    Continual DeepMind Control (Section 5 of the C-CHAIN paper): a task is another goal of the same robot.

    Observations are flattened, actions clipped to their bounds, and an episode is truncated after dm_control's 1000 steps.
    The paper also normalises observations and rewards, with statistics that restart at each task:
    :class:`~sb3_cchain.envs.TaskVecNormalize`.

    :param domain: The robot: a domain of dm_control's suite
    :param tasks: Tasks of the domain in order; one may come again. Read back as the attribute ``task_names``
    :param steps_per_task: Environment steps per task, one number for all or one per task
    :param kwargs: ``n_envs``, ``first_task``, ``cycles``, ``render_mode``: see :class:`~sb3_cchain.ContinualEnv`
    :raises TypeError: When ``tasks`` is a string or not a list
    :raises ValueError: Naming the argument that is out of its range
    :raises ImportError: When dm_control or Shimmy is not installed
    """

    def __init__(
        self,
        domain: str = "walker",
        tasks: Sequence[str] = ("stand", "walk", "run"),
        *,
        steps_per_task: int | Sequence[int] = 1_000_000,
        **kwargs: Any,
    ):
        self.domain, self.task_names = domain, _check_task_names(domain, tasks)
        makers = [partial(_make_task, domain, name) for name in self.task_names]
        super().__init__(makers, steps_per_task, **kwargs)

    @property
    def task_sequence(self) -> list[tuple[str, str]]:
        """The domain and the name of each task."""
        return [(self.domain, name) for name in self.task_names] * self.cycles


def _known_tasks() -> Mapping[str, Sequence[str]]:
    with suppress(ImportError):
        # PyTorch for CUDA imports Triton at the first update. After dm_control that can be a segmentation fault: to render it
        # loads Mesa, which brings an LLVM of another version. The other way round nothing happens
        import triton  # noqa: F401
    try:
        # Shimmy registers the environments when it is imported, those of dm_control only where that is installed
        import dm_control.suite
        import shimmy  # noqa: F401
    except ModuleNotFoundError as error:
        raise ImportError(
            f'dm_control or what it needs is not installed ({error}): pip install "sb3-cchain[dmc]". '
            "It has no wheels for Python 3.13 and later."
        ) from error
    return dm_control.suite.TASKS_BY_DOMAIN


def _check_task_names(domain: str, tasks: Sequence[str]) -> list[str]:
    tasks = check_list("tasks", tasks, of="tasks")
    known = _known_tasks()
    if domain not in list(known):
        raise ValueError(f"Unknown `domain` {domain!r}; it must be one of {', '.join(known)}")
    for task in tasks:
        if task not in known[domain]:
            raise ValueError(f"Unknown task {task!r} in `tasks`; those of {domain!r} are {', '.join(known[domain])}")
    return tasks


def _make_task(domain: str, task: str, **kwargs: Any) -> gym.Env:
    # By its specification, so that Gymnasium's checker, which would warn of the spaces that FlatDMControl replaces, can be off
    spec = gym.spec(f"dm_control/{domain}-{task}-v0")
    return FlatDMControl(gym.make(spec, disable_env_checker=True, **kwargs))
