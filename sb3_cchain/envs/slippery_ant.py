"""Slippery Ant: a robot that walks on a floor whose friction changes."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_cchain.envs.continual_env import ContinualEnv
from sb3_cchain.validation import check_array, check_number


class ContinualSlipperyAnt(ContinualEnv[NDArray[np.float64], NDArray[np.floating[Any]]]):
    """
    Slippery Ant (Dohare et al., "Loss of plasticity in deep continual learning", Nature 2024,
    https://doi.org/10.1038/s41586-024-07711-7): a task is a friction between the robot and the floor, drawn log-uniformly.

    It is Gymnasium's ``Ant-v5``, where the authors have ``Ant-v3`` of the old Gym: returns are not the same. As in their code,
    the sliding friction of all bodies is set, the floor included. Their frictions are in a file; here they are drawn by
    ``friction_seed``, that of the first task, too.

    :param n_tasks: Length of the sequence
    :param steps_per_task: Environment steps per task, one number for all or one per task
    :param friction_range: The least and the greatest friction that can be drawn
    :param friction_seed: Seed of the frictions. They do not depend on ``reset(seed=...)``
    :param frictions: The frictions themselves, ``(n_tasks,)``; read back as the attribute ``frictions``. Gymnasium's own is 1
    :param kwargs: ``n_envs``, ``first_task``, ``cycles``, ``blend_steps``, ``render_mode``: see
        :class:`~sb3_cchain.ContinualEnv`. ``n_tasks`` and ``frictions`` are of one cycle. With ``blend_steps``, the logarithm
        of the friction goes from that of the task before to the task's own in a straight line
    :raises ValueError: Naming the argument that is out of its range
    :raises ImportError: When MuJoCo is not installed
    """

    def __init__(
        self,
        *,
        n_tasks: int = 10,
        steps_per_task: int | Sequence[int] = 2_000_000,
        friction_range: Sequence[float] = (0.02, 2.0),
        friction_seed: int = 0,
        frictions: ArrayLike | None = None,
        **kwargs: Any,
    ):
        check_number("n_tasks", n_tasks, 1, integer=True)
        check_number("friction_seed", friction_seed, 0, integer=True)
        if frictions is None:
            low, high = _check_range(friction_range)
            self.frictions = np.exp(np.random.default_rng(friction_seed).uniform(np.log(low), np.log(high), n_tasks))
        else:
            self.frictions = check_array("frictions", frictions, (n_tasks,), "the shape (n_tasks,) =")
            if not (self.frictions > 0).all():
                raise ValueError(f"`frictions` must be finite and greater than 0, got {frictions!r}")
        tasks = [partial(_make_task, friction) for friction in self.frictions.tolist()]
        super().__init__(tasks, steps_per_task, **kwargs)

    @property
    def task_sequence(self) -> list[float]:
        """The friction of each task."""
        return self.frictions.tolist() * self.cycles

    def blend(self, weight: float) -> None:
        """
        :param weight: 0 for the friction of the task before, 1 for that of the present task
        """
        before, own = (self.frictions[task % len(self.frictions)] for task in (self.task_id - 1, self.task_id))
        _set_friction(self.task, before ** (1 - weight) * own**weight)


def _check_range(friction_range: Sequence[float]) -> tuple[float, float]:
    try:
        low, high = friction_range
    except (TypeError, ValueError):
        raise ValueError(
            f"`friction_range` must be two numbers, the least and the greatest friction, got {friction_range!r}"
        ) from None
    check_number("friction_range[0]", low, 0, exclusive=True)
    check_number("friction_range[1]", high, low)
    return low, high


def _make_task(friction: float, **kwargs: Any) -> gym.Env:
    try:
        # The checker around the continual environment suffices
        env = gym.make("Ant-v5", disable_env_checker=True, **kwargs)
    except gym.error.DependencyNotInstalled as error:
        raise ImportError(f'MuJoCo is not installed: pip install "sb3-cchain[mujoco]" ({error})') from error
    _set_friction(env, friction)
    return env


def _set_friction(env: gym.Env, friction: float) -> None:
    # Sliding, torsional and rolling friction of each body. In a contact, the greater of two frictions counts
    env.unwrapped.model.geom_friction[:, 0] = friction  # type: ignore[attr-defined]
