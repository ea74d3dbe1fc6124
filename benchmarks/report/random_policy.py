"""What a task is without an agent: its name, a frame, and the return of random actions."""

import warnings
from dataclasses import dataclass

import gymnasium as gym
import numpy as np

from benchmarks.grid.run import Run
from benchmarks.grid.suites import SUITES, make_env


@dataclass(frozen=True)
class TaskLook:
    """
    A task without an agent.

    :param random_return: Mean return of uniformly random actions
    :param frame: A picture of it, ``(height, width, 3)``, or None where it cannot be drawn
    """

    random_return: float
    frame: np.ndarray | None


def look_at_task(run: Run, task: int, n_episodes: int = 20) -> TaskLook:
    """
    :param run: A run
    :param task: Number of one of its tasks
    :param n_episodes: Episodes of random actions
    :return: What the task looks like, with the frame of the 30th step where a frame shows what the task is
    """
    visible = SUITES[run.suite].visible
    env = make_env(run.suite, run.env_id, run.n_tasks, run.seed, task, render_mode="rgb_array" if visible else None)
    env.action_space.seed(0)
    env.reset(seed=0)
    returns: list[float] = []
    frame = None
    n_steps = 0
    while len(returns) < n_episodes:
        *_, terminated, truncated, info = env.step(env.action_space.sample())
        n_steps += 1
        if visible and n_steps == 30:
            frame = _frame(env)
        if terminated or truncated:
            returns.append(info["episode_return"])
            env.reset()
    env.close()
    return TaskLook(float(np.mean(returns)), frame)


def _frame(env: gym.Env) -> np.ndarray | None:
    try:
        return np.asarray(env.render())
    except Exception as error:  # any error of any graphics library: the curves are worth having without the frame
        warnings.warn(f"No frame of the task can be drawn: {error}")
        return None
