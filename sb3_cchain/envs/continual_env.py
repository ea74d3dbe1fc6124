"""A sequence of tasks as one Gymnasium environment."""

from collections.abc import Callable, Sequence
from typing import Any, SupportsFloat

import gymnasium as gym
from gymnasium.core import ActType, ObsType, RenderFrame

from sb3_cchain.envs.reset import reset_env
from sb3_cchain.tasks.clock import TaskClock
from sb3_cchain.validation import check_list, check_number

Task = str | Callable[..., gym.Env]


class ContinualEnv(gym.Env[ObsType, ActType]):
    """
    Tasks that arrive one after the other; the agent is not told.

    A task lasts for ``steps_per_task`` environment steps. The step that ends it truncates the episode, and the next
    ``reset()`` begins the next task. The last task does not end.

    The agent sees neither the task nor the switch. For logging, ``info["task_id"]`` is the task that the step was made in,
    ``info["task_reward"]`` its reward and ``info["episode_return"]`` the return of the episode so far, before any wrapper
    touched the rewards.

    With several environments side by side steps are counted over all of them, so that they switch together:
    :class:`~sb3_cchain.TaskSync` tells them their number (the algorithms with churn reduction add it by themselves); without
    it, pass ``n_envs``.

    :param tasks: Environment ids, or callables that make an environment; they must agree in their spaces. A callable is
        given ``render_mode=...`` if and only if one is asked for.
    :param steps_per_task: Environment steps per task, one number for all or one per task
    :param n_envs: How many environments step together with this one, itself included
    :param first_task: The task to begin with; those before it are left out
    :param cycles: How often the sequence comes, one time after the other. Each visit is a task with a number of its own
    :param blend_steps: Environment steps in which each task but the first drifts from the one before to itself, in place of a
        sudden switch: of the task's own. The number of the task changes when the drift begins. Only for subclasses whose tasks
        differ in numbers, which say by :meth:`blend` what lies between two of them
    :param render_mode: As in :func:`gymnasium.make`
    :raises ValueError: For an empty task list, lengths that are not positive or not one per task, an unknown environment,
        tasks whose spaces differ, or a ``blend_steps`` that is longer than a task or for tasks that have nothing between them
    :raises TypeError: When ``tasks`` is not a list of environment ids and callables, or a callable makes no environment
    :raises ImportError: When the package that a task needs is not installed
    """

    # For `gymnasium.make`, which asks the class; an instance has those of its tasks
    metadata: dict[str, Any] = {"render_modes": ["human", "rgb_array"]}  # noqa: RUF012

    def __init__(
        self,
        tasks: Sequence[Task],
        steps_per_task: int | Sequence[int],
        *,
        n_envs: int = 1,
        first_task: int = 0,
        cycles: int = 1,
        blend_steps: int = 0,
        render_mode: str | None = None,
    ):
        tasks = _check_tasks(tasks)
        check_number("cycles", cycles, 1, integer=True)
        self.cycles: int = int(cycles)
        self.steps_per_task: list[int] = _check_steps_per_task(steps_per_task, len(tasks)) * self.cycles
        self.blend_steps: int = self._check_blend_steps(blend_steps)
        # The time of the sequence, and the task of the present episode
        self.clock: TaskClock = TaskClock(self.steps_per_task, n_envs, first_task)
        self.tasks: list[gym.Env] = [
            _make_task(position, task, render_mode) for position, task in enumerate(tasks * self.cycles)
        ]
        _check_spaces(self.tasks)

        self.observation_space: gym.Space[ObsType] = self.tasks[0].observation_space
        self.action_space: gym.Space[ActType] = self.tasks[0].action_space
        self.metadata = self.tasks[0].metadata
        self.render_mode = render_mode
        self._seeded: set[int] = set()
        # How far each task has drifted to itself; those that are not there are themselves
        self._weights: dict[int, float] = {}

    @property
    def task_id(self) -> int:
        """The task of the present episode, counted from 0."""
        return self.clock.task_id

    @property
    def n_tasks(self) -> int:
        """Length of the sequence."""
        return len(self.tasks)

    @property
    def task(self) -> gym.Env:
        """The environment of the present episode."""
        return self.tasks[self.task_id]

    @property
    def first_task(self) -> int:
        """The task that the sequence begins with."""
        return self.clock.first_task

    @property
    def task_sequence(self) -> list[Any]:
        """
        A description of each task. Two environments whose descriptions are equal have the same tasks. A subclass describes its
        tasks by the arguments that tell them apart: by numbers, strings, lists or tuples, which can be compared and pickled.
        With ``cycles``, the descriptions come so often.
        """
        return [_name(task) for task in self.tasks]

    def blend(self, weight: float) -> None:
        """
        Put the present task between the task before it and itself. A subclass overrides it to allow ``blend_steps``.

        :param weight: 0 for the task before, 1 for the present one
        """
        raise NotImplementedError

    def set_clock(self, total_steps: int, n_envs: int | None = None) -> bool:
        """
        Say how far training is. The next ``reset()`` begins an episode of the task of that time.

        :param total_steps: Environment steps made so far, over all environments
        :param n_envs: Environments that step together with this one, itself included; None leaves their number as it is
        :return: Whether the present episode is of another task, so that a ``reset()`` is due
        :raises ValueError: When ``total_steps`` is negative or ``n_envs`` is not positive
        """
        self.clock.set(total_steps, n_envs)
        return self.clock.is_over

    def set_task(self, task_id: int) -> None:
        """
        Stay on one task from the next ``reset()`` on, for evaluation. Steps do not end it.

        :param task_id: The task, counted from 0
        :raises ValueError: When there is no such task
        """
        self.clock.pin(task_id)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[ObsType, dict[str, Any]]:
        """
        Begin an episode of the task that is due.

        :param seed: Seeds this and all later tasks
        :param options: Passed on to the task
        :return: Observation and info
        """
        super().reset(seed=seed)
        self.clock.begin()
        if seed is not None:
            self._seeded = {self.task_id}
        elif self.task_id not in self._seeded:
            # One seed determines the whole sequence
            self._seeded.add(self.task_id)
            seed = int(self.np_random.integers(2**31))
        if self.blend_steps:
            self._drift()
        observation, info = reset_env(self.task, seed, options)
        self._episode_return = 0.0
        return observation, {**info, "task_id": self.task_id}

    def step(self, action: ActType) -> tuple[ObsType, SupportsFloat, bool, bool, dict[str, Any]]:
        """
        One step of the present task.

        :param action: The action
        :return: Observation, reward, terminated, truncated, info
        """
        task_id = self.clock.task_id
        if self.blend_steps:
            self._drift()
        observation, reward, terminated, truncated, info = self.tasks[task_id].step(action)
        truncated = self.clock.advance() or truncated
        task_reward = float(reward)
        self._episode_return += task_reward
        info = {**info, "task_id": task_id, "task_reward": task_reward, "episode_return": self._episode_return}
        return observation, reward, terminated, truncated, info

    def _drift(self) -> None:
        task_id = self.task_id
        weight = 1.0 if task_id == self.first_task else min(self.clock.task_steps / self.blend_steps, 1.0)
        if weight != self._weights.get(task_id, 1.0):
            self._weights[task_id] = weight
            self.blend(weight)

    def _check_blend_steps(self, blend_steps: int) -> int:
        check_number("blend_steps", blend_steps, 0, min(self.steps_per_task), integer=True)
        if blend_steps and type(self).blend is ContinualEnv.blend:
            raise ValueError(
                f"`blend_steps` must be 0 for {type(self).__name__}, got {blend_steps!r}: nothing is known to lie between two "
                "of its tasks. In a subclass whose tasks differ in numbers, override `blend()`"
            )
        return int(blend_steps)

    def render(self) -> RenderFrame | list[RenderFrame] | None:
        """
        :return: The present task's frame
        """
        return self.task.render()

    def close(self) -> None:
        """Close all tasks."""
        for task in self.tasks:
            task.close()


def _check_tasks(tasks: Sequence[Task]) -> list[Task]:
    tasks = check_list("tasks", tasks, of="environment ids or callables")
    if not tasks:
        raise ValueError("`tasks` must name at least one task, got an empty list")
    for position, task in enumerate(tasks):
        if not isinstance(task, str) and not callable(task):
            raise TypeError(
                f"`tasks[{position}]` must be an environment id or a callable that makes an environment, got {task!r}"
            )
    return tasks


def _check_steps_per_task(steps_per_task: int | Sequence[int], n_tasks: int) -> list[int]:
    if not isinstance(steps_per_task, Sequence) or isinstance(steps_per_task, str):
        check_number("steps_per_task", steps_per_task, 1, integer=True)
        return [int(steps_per_task)] * n_tasks
    if len(steps_per_task) != n_tasks:
        raise ValueError(f"`steps_per_task` must be one number or one per task ({n_tasks}), got {steps_per_task!r}")
    for position, steps in enumerate(steps_per_task):
        check_number(f"steps_per_task[{position}]", steps, 1, integer=True)
    return [int(steps) for steps in steps_per_task]


def _make_task(position: int, task: Task, render_mode: str | None) -> gym.Env:
    try:
        if isinstance(task, str):
            return gym.make(task, render_mode=render_mode)
        env = task() if render_mode is None else task(render_mode=render_mode)
    except gym.error.UnregisteredEnv as error:
        # Gymnasium's message ends with the nearest names
        raise ValueError(f"Unknown environment {task!r} in `tasks`: {error}") from error
    except gym.error.DependencyNotInstalled as error:
        raise ImportError(f"Task {task!r} needs a package that is not installed: {error}") from error
    if not isinstance(env, gym.Env):
        raise TypeError(f"`tasks[{position}]` must make a Gymnasium environment, but calling it returned {env!r}")
    return env


def _check_spaces(tasks: list[gym.Env]) -> None:
    for kind in ("observation_space", "action_space"):
        first = getattr(tasks[0], kind)
        for position, task in enumerate(tasks):
            space = getattr(task, kind)
            if space != first:
                raise ValueError(
                    f"All tasks must have the same {kind}, but task 0 ({_name(tasks[0])}) has {first} and task {position} "
                    f"({_name(task)}) has {space}. Wrap the tasks so that they agree, for instance by CommonSpaces."
                )


def _name(env: gym.Env) -> str:
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__
