"""The suites of the paper: their environments, the algorithms that are compared in them, and what their tasks are."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.results import METHODS
from benchmarks.runs import Run
from sb3_cchain import ContinualEnv
from sb3_cchain.envs.registration import CONTINUAL_ENVS

ALL_ENVS = [f"Continual/{name}" for name in CONTINUAL_ENVS]
PROCGEN_ENVS = [f"Continual/{name}" for name, entry in CONTINUAL_ENVS.items() if entry["entry_point"].endswith("Procgen")]


@dataclass(frozen=True)
class Suite:
    """
    One suite.

    :param env_ids: Its environments
    :param task_name: What a task of an environment is called, by its number
    :param algos: Vanilla and C-CHAIN, by their names on the command line
    :param others: The methods that the paper compares them with
    :param evaluates: Whether what counts is the return of greedy evaluations, not of training
    :param env_kwargs: Arguments of the environment, as on the command line, for a number of tasks and a seed
    :param own_scales: Whether tasks differ in the size of their returns
    :param visible: Whether one sees in a frame what a task is
    """

    env_ids: list[str]
    task_name: Callable[[Any, int], str]
    algos: tuple[str, str] = ("ppo", "ppo_cchain")
    others: tuple[str, ...] = ("ppo_oracle",)
    evaluates: bool = False
    env_kwargs: Callable[[int, int], tuple[str, ...]] = lambda n_tasks, seed: ()
    own_scales: bool = False
    visible: bool = True

    @property
    def returns(self) -> Callable[[Run], list[dict[str, float]]]:
        """The returns that count, of a run."""
        return Run.evaluations if self.evaluates else Run.returns

    @property
    def methods(self) -> dict[str, str]:
        """The algorithms by the names of their methods, in the order of ``METHODS``."""
        vanilla, cchain = self.algos
        algos = {"vanilla": vanilla, "cchain": cchain}
        algos.update({algo.removeprefix("double_dqn_").removeprefix("ppo_"): algo for algo in self.others})
        return {method: algos[method] for method in METHODS if method in algos}

    def length(self, env_id: str) -> tuple[int, int]:
        """
        :param env_id: One of ``env_ids``
        :return: The paper's number of tasks, and environment steps per task
        """
        env: Any = gym.make(env_id).unwrapped
        return env.n_tasks, env.steps_per_task[0]

    def run(
        self, algo: str, env_id: str, seed: int, n_tasks: int, steps_per_task: int, folder: Path, eval_freq: int | None = None
    ) -> Run:
        """
        :param algo: One of ``algos`` and ``others``
        :param env_id: One of ``env_ids``
        :param seed: Seed of the agent; and of the offsets in Gym Control, where the algorithms meet the same tasks under the
            same seed
        :param n_tasks: Length of the task sequence
        :param steps_per_task: Environment steps per task
        :param folder: Where the run's files go
        :param eval_freq: Environment steps between evaluations where the suite evaluates; by default 30 in a task, as in the
            paper
        :return: The run
        :raises ValueError: For more tasks than the environment has, or no evaluation in a task
        """
        if not self.env_kwargs(n_tasks, seed) and n_tasks > self.length(env_id)[0]:
            raise ValueError(f"`n_tasks` must be at most {self.length(env_id)[0]}, the tasks of {env_id}; got {n_tasks}")
        if self.evaluates and not 0 < (eval_freq or steps_per_task // 30) <= steps_per_task:
            raise ValueError(f"`eval_freq` must be between 1 and `steps_per_task`, which is {steps_per_task}; got {eval_freq}")
        eval_freq = (eval_freq or steps_per_task // 30) if self.evaluates else -1
        env_kwargs = self.env_kwargs(n_tasks, seed)
        return Run(algo, env_id, seed, n_tasks, steps_per_task, folder, env_kwargs, eval_freq)


SUITES = {
    "gym_control": Suite(
        ["Continual/CartPole-v1", "Continual/Acrobot-v1", "Continual/LunarLander-v3", "Continual/MountainCar-v0"],
        lambda env, task: f"task {task}",
        others=("ppo_oracle", "ppo_trac", "ppo_weight_clipping", "ppo_l2_init"),
        env_kwargs=lambda n_tasks, seed: (f"n_tasks:{n_tasks}", f"offset_seed:{seed}"),
        visible=False,
    ),
    "procgen": Suite(
        PROCGEN_ENVS,
        lambda env, task: f"level {env.levels[task].start}",
        others=(
            *("ppo_oracle", "ppo_trac", "ppo_weight_clipping", "ppo_l2_init"),
            *("ppo_layer_norm", "ppo_redo", "ppo_adam_rel"),
        ),
        env_kwargs=lambda n_tasks, seed: (f"n_tasks:{n_tasks}",),
    ),
    # The paper evaluates with sampled actions and the statistics of the moment, which the episodes of training have, too
    "dmc": Suite(
        ["Continual/Walker-v0", "Continual/Quadruped-v0", "Continual/Dog-v0"],
        lambda env, task: env.task_names[task],
        own_scales=True,
    ),
    "minatar": Suite(
        ["Continual/MinAtar-v0"],
        lambda env, task: env.games[task],
        algos=("double_dqn", "dqn_cchain"),
        others=("double_dqn_oracle",),
        evaluates=True,
        own_scales=True,
    ),
}


@dataclass(frozen=True)
class Task:
    """
    What there is to know of a task without an agent.

    :param name: For people
    :param random_return: Mean return of uniformly random actions
    :param frame: A picture of it, ``(height, width, 3)``, or None where it cannot be drawn
    """

    name: str
    random_return: float
    frame: np.ndarray | None


def make_env(run: Run, task: int, **kwargs: Any) -> gym.Env:
    """
    :param run: A run
    :param task: Number of one of its tasks
    :param kwargs: Further arguments of the environment
    :return: The run's environment, which stays on that task
    """
    for argument in run.env_kwargs:
        name, value = argument.split(":")
        kwargs[name] = int(value)
    # Long enough to stay
    return gym.make(run.env_id, first_task=task, steps_per_task=10**9, **kwargs)


def look_at(suite: Suite, run: Run, task: int, n_episodes: int = 20) -> Task:
    """
    :param suite: The run's suite
    :param run: A run
    :param task: Number of one of its tasks
    :param n_episodes: Episodes of random actions
    :return: The task, with the frame of the 30th step, where the suite is one to see
    """
    env = make_env(run, task, render_mode="rgb_array" if suite.visible else None)
    assert isinstance(env.unwrapped, ContinualEnv)
    env.action_space.seed(0)
    env.reset(seed=0)
    returns: list[float] = []
    frame = None
    n_steps = 0
    while len(returns) < n_episodes:
        *_, terminated, truncated, info = env.step(env.action_space.sample())
        n_steps += 1
        if suite.visible and n_steps == 30:
            frame = _frame(env)
        if terminated or truncated:
            returns.append(info["episode_return"])
            env.reset()
    env.close()
    return Task(suite.task_name(env.unwrapped, task), float(np.mean(returns)), frame)


def _frame(env: gym.Env) -> np.ndarray | None:
    try:
        return np.asarray(env.render())
    except Exception as error:  # of whatever graphics library there is or is not; the curves are worth having without
        warnings.warn(f"No frame of the task can be drawn: {error}")
        return None
