"""How well an agent does over a sequence of tasks, while it is trained."""

import csv
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cchain.tasks.sync import require_continual
from sb3_cchain.tensorboard.overview import add_overview

RETURNS_CSV = "returns.csv"
COLUMNS = ("timesteps", "task_id", "n_episodes", "mean_return")


class ContinualMetrics(BaseCallback):
    r"""
    Logs how well the agent does over the tasks of a :class:`~sb3_cchain.ContinualEnv`, from the episodes of training:

    - ``continual/task_id``: the task being trained; ``continual/n_switches``: switches so far
    - ``continual/mean_return``: mean return of the episodes that ended in this rollout on that task
    - ``continual/average_task_<i>``: :math:`J(\mathcal{T}_i)`, the mean of the above over the rollouts of task ``i``
    - ``continual/average_performance``: :math:`J(\mathbb{T})` so far, the mean of those over the tasks (Eq. 1 of the C-CHAIN
      paper)

    Returns are the environment's own, whatever scales or normalises the rewards that the agent learns from.
    Rollouts in which no episode ends count nowhere; off-policy algorithms, whose rollouts are the few steps between two
    updates, so have a row per episode. An episode that is cut by a switch counts with its return up to there.

    The same goes to a CSV file, a line per rollout and task: environment steps at the end of the rollout, task, number of
    episodes that ended, their mean return. They are kept with the model, as ``model.continual_returns``, too, so that training
    that is resumed continues both.

    ``CChainPPO`` adds the callback by itself in a continual environment; give it to other algorithms.

    :param path: The CSV file; by default ``returns.csv`` in the folder of the logs, if the model has ``tensorboard_log``
        or was given a logger by ``set_logger()``
    """

    def __init__(self, path: str | Path | None = None):
        super().__init__()
        self.path = None if path is None else Path(path)
        self._finished: dict[int, list[float]] = defaultdict(list)

    def _on_training_start(self) -> None:
        require_continual(self, self.training_env)
        add_overview(self.model)
        self._finished.clear()
        # The logger of a model without `tensorboard_log` writes to a temporary folder, another at each `learn()`
        has_folder = self.model.tensorboard_log is not None or self.model._custom_logger
        folder = self.logger.get_dir() if has_folder else None
        self._open_path = self.path or (Path(folder) / RETURNS_CSV if folder is not None else None)
        past = getattr(self.model, "continual_returns", [])
        if not past and self._open_path is not None and self._open_path.exists():
            past = read_returns(self._open_path)
        # Rows of training that was lost after the last save are dropped: they will come again
        self.rows = [row for row in past if row["timesteps"] <= self.num_timesteps]
        self.model.continual_returns = self.rows  # type: ignore[attr-defined]
        self._averages: dict[int, float] = task_averages(self.rows)
        self._average_performance = float(np.mean(list(self._averages.values()))) if self._averages else np.nan
        self._n_rows = Counter(int(row["task_id"]) for row in self.rows)
        if self._open_path is not None:
            self._open_path.parent.mkdir(parents=True, exist_ok=True)
            with open(self._open_path, "w", newline="") as file:
                writer = csv.DictWriter(file, COLUMNS)
                writer.writeheader()
                writer.writerows(self.rows)
        self._task_id, self._n_switches = -1, 0

    def _on_step(self) -> bool:
        infos = self.locals["infos"]
        if self._task_id not in (-1, infos[0]["task_id"]):
            self._n_switches += 1
        self._task_id = infos[0]["task_id"]
        for info, done in zip(infos, self.locals["dones"], strict=True):
            if done:
                self._finished[info["task_id"]].append(info["episode_return"])
        return True

    def _on_rollout_end(self) -> None:
        new = [
            dict(zip(COLUMNS, (self.num_timesteps, task_id, len(returns), float(np.mean(returns))), strict=True))
            for task_id, returns in sorted(self._finished.items())
        ]
        self._finished.clear()
        self.rows += new
        if self._open_path is not None and new:
            with open(self._open_path, "a", newline="") as file:
                csv.DictWriter(file, COLUMNS).writerows(new)

        self.logger.record("continual/task_id", self._task_id)
        self.logger.record("continual/n_switches", self._n_switches)
        for row in new:
            task_id = int(row["task_id"])
            self._n_rows[task_id] += 1
            average = self._averages.get(task_id, 0.0)
            self._averages[task_id] = average + (row["mean_return"] - average) / self._n_rows[task_id]
            self.logger.record(f"continual/average_task_{task_id}", self._averages[task_id])
            if task_id == self._task_id:
                self.logger.record_mean("continual/mean_return", row["mean_return"])
        if new:
            self._average_performance = float(np.mean(list(self._averages.values())))
        if self._averages:
            self.logger.record("continual/average_performance", self._average_performance)


def task_averages(rows: Sequence[Mapping[str, float]]) -> dict[int, float]:
    r"""
    :param rows: Rows of :func:`read_returns`
    :return: :math:`J(\mathcal{T}_i)` by task: the mean over its rollouts of the mean return of their episodes
    """
    by_task: dict[int, list[float]] = defaultdict(list)
    for row in rows:
        by_task[int(row["task_id"])].append(row["mean_return"])
    return {task_id: float(np.mean(returns)) for task_id, returns in by_task.items()}


def read_returns(path: str | Path) -> list[dict[str, float]]:
    """
    :param path: CSV file written by :class:`ContinualMetrics`
    :return: Its rows
    """
    with open(path, newline="") as file:
        return [
            {column: float(row[column]) if column == "mean_return" else int(row[column]) for column in COLUMNS}
            for row in csv.DictReader(file)
        ]
