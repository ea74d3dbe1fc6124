"""How the released code of the paper scores a run, where that is not J(T) of the episodes that ended in training."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Score:
    """
    The score of a run is the mean over its tasks of the mean over the points of a task.

    :param metric: Name of the scalar in ``metrics.csv`` that holds the points
    :param words: What a point is, for the report
    :param interval: Points are what was logged at multiples of so many environment steps; 1 for all that was logged
    """

    metric: str
    words: str
    interval: int = 1

    def average(self, steps: np.ndarray, values: np.ndarray) -> float:
        """
        :param steps: Environment steps at which the scalar was logged in a task
        :param values: Its values
        :return: The mean over the points, NaN without any
        """
        points = values[steps % self.interval == 0]
        return float(points.mean()) if len(points) else math.nan


@dataclass(frozen=True)
class Evaluation:
    """
    How a suite is evaluated: by episodes of the task being trained.

    :param per_task: Evaluations in a task, at regular intervals
    :param deterministic: Whether the policy's likeliest actions are taken, not sampled ones
    :param least_interval: Environment steps between two of them at least, in tasks that are longer than that
    :param n_episodes: Episodes of each
    """

    per_task: int
    deterministic: bool
    least_interval: int = 0
    n_episodes: int = 10

    def interval(self, steps_per_task: int) -> int:
        """
        :param steps_per_task: Environment steps per task
        :return: Environment steps between two evaluations
        """
        return min(max(steps_per_task // self.per_task, self.least_interval), steps_per_task)

    def callback(self, interval: int) -> dict[str, dict[str, Any]]:
        """
        :param interval: Environment steps between two evaluations
        :return: The callback that evaluates, as in a YAML file
        """
        arguments = {"interval": interval, "n_eval_episodes": self.n_episodes, "deterministic": self.deterministic}
        return {"sb3_cchain.analysis.EvalTrainedTask": arguments}
