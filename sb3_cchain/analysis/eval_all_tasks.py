"""Evaluates on all tasks during training, for what is forgotten and what is transferred."""

from pathlib import Path

import numpy as np

from sb3_cchain.analysis.metrics.continual import return_matrix
from sb3_cchain.analysis.task_evaluation import TaskEvaluation
from sb3_cchain.callbacks.returns_file import read_returns

TASK_COLUMNS = ("timesteps", "trained_task", "task_id", "n_episodes", "mean_return")


class EvalAllTasks(TaskEvaluation):
    r"""
    Evaluates the agent on every task of a :class:`~sb3_cchain.ContinualEnv`: before training, whenever the task has switched,
    at the end of training and, if wanted, at intervals. It acts between rollouts: after the last update on a task, and before
    callbacks that come after it in the list, such as :class:`~sb3_cchain.methods.Oracle`, change the networks for the next.
    Where a task ends within a rollout, it is up to a rollout late. The tasks are the environment's own, whatever a
    :class:`~sb3_cchain.TaskSignal` says. ``MaskablePPO`` is evaluated with the environment's masks.

    Logged are

    - ``continual_eval/task_<i>``: mean return on task i
    - ``continual_eval/average``: :math:`P(t)`, the mean over all tasks (Continual World)
    - ``continual_eval/forgetting``: mean over the tasks that were left of the return right after the training on the task,
      minus the present one
    - ``continual_eval/zero_shot_transfer``: mean over the tasks to come of the present return, minus that before training

    and all returns are written to a CSV file, a line per evaluation and task: environment steps, the task trained last, the
    task evaluated on, number of episodes, their mean return. :func:`~sb3_cchain.analysis.metrics.continual.return_matrix`
    makes a matrix of them, from which forgetting and transfer are computed. They are kept with the model, as
    ``model.task_returns``, too, so that training that is resumed continues both.

    Training is not changed, its random numbers included. Each evaluation begins with the same seed, so that all of them see
    the same episodes, as far as the actions are the same. Returns are the environment's own. With ``cycles``, each task is
    evaluated once and counts for all of its visits.

    The statistics of ``VecNormalize`` are those of training at that moment. At a switch at which
    :class:`~sb3_cchain.envs.TaskVecNormalize` restarts them without a TaskSignal, they are those of the task before.

    :param eval_env: The environment to evaluate in, wrapped as that of training and with the same tasks; one that is not
        vectorised will do. None makes one like the training environment, if that was made by :func:`gymnasium.make` (as RL Zoo
        does) and the wrappers around it are those of rewards, videos and statistics
    :param n_eval_episodes: Episodes per task
    :param interval: Environment steps between evaluations besides those at switches; None for none
    :param deterministic: Whether to take the policy's most likely action
    :param seed: Seed of the evaluation episodes
    :param path: The CSV file; by default ``task_returns.csv`` in the folder of the logs, if there is one (see
        :class:`~sb3_cchain.ContinualMetrics`)
    :raises ValueError: Naming the argument that is out of its range. When training starts: for an evaluation environment that
        has other tasks, spaces or normalisation, is that of training, or cannot be made; for a second EvalAllTasks; for a file
        that is not one of task returns
    :raises TypeError: When ``path`` is not a path or ``deterministic`` not a boolean. When training starts, for an environment
        that is not continual
    """

    file_name = "task_returns.csv"
    columns = TASK_COLUMNS
    kept_as = "task_returns"

    def _new_rows(self, trained_task: int) -> list[dict[str, float]]:
        return [
            dict(zip(TASK_COLUMNS, (self.num_timesteps, trained_task, task, self.n_eval_episodes, value), strict=True))
            for task, value in enumerate(self._all_returns())
        ]

    def _all_returns(self) -> list[float]:
        """The mean return on each task."""
        n_tasks, cycles = (self.eval_env.get_attr(name, indices=0)[0] for name in ("n_tasks", "cycles"))
        return [self._mean_return(task) for task in range(n_tasks // cycles)] * cycles

    def _figures(self, trained_task: int) -> dict[str, float]:
        before, after = return_matrix(self.rows)
        now = np.array([row["mean_return"] for row in self.rows[-len(before) :]])
        left = np.diag(after)[:trained_task] - now[:trained_task]
        to_come = (now - before)[trained_task + 1 :]
        figures = {f"task_{task}": value for task, value in enumerate(now)} | {"average": now.mean()}
        for name, values in (("forgetting", left), ("zero_shot_transfer", to_come)):
            known = values[~np.isnan(values)]
            if len(known):
                figures[name] = known.mean()
        return {f"continual_eval/{name}": float(value) for name, value in figures.items()}


def read_task_returns(path: str | Path) -> list[dict[str, float]]:
    """
    :param path: CSV file written by :class:`EvalAllTasks`
    :return: Its rows
    :raises ValueError: When it is not such a file, or a line of it is damaged
    """
    return read_returns(path, TASK_COLUMNS)
