"""How well an agent does over a sequence of tasks, while it is trained."""

import csv
from collections import defaultdict
from itertools import chain
from pathlib import Path

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

RETURNS_CSV = "returns.csv"
COLUMNS = ("timesteps", "task_id", "n_episodes", "mean_return")


class ContinualMetrics(BaseCallback):
    r"""
    Logs how well the agent does over the tasks of a :class:`~sb3_cchain.ContinualEnv`, from the episodes of training:

    - ``continual/task_id``: the task being trained; ``continual/n_switches``: switches so far
    - ``continual/mean_return``: mean return of the episodes that ended in this rollout on that task
    - ``continual/average_performance``: :math:`J(\mathbb{T})` so far, the mean of the above over the rollouts
      (Eq. 1 of the C-CHAIN paper)
    - ``continual/average_task_<i>``: :math:`J(\mathcal{T}_i)`, the same over the rollouts of task ``i``

    Returns are the environment's own, whatever scales or normalises the rewards that the agent learns from.
    Rollouts in which no episode ends count nowhere.

    The same goes to a CSV file, a line per rollout and task: environment steps at the end of the rollout, task, number of
    episodes that ended, their mean return. Training that is resumed continues the file.

    ``CChainPPO`` adds the callback by itself in a continual environment; give it to other algorithms.

    :param path: The CSV file; by default ``returns.csv`` in the logger's folder, if it has one (``tensorboard_log`` or
        ``model.set_logger()``)
    """

    def __init__(self, path: str | Path | None = None):
        super().__init__()
        self.path = None if path is None else Path(path)
        self.mean_returns: dict[int, list[float]] = defaultdict(list)
        self._finished: dict[int, list[float]] = defaultdict(list)

    def _on_training_start(self) -> None:
        self.mean_returns.clear()
        self._finished.clear()
        path, folder = self.path, self.logger.get_dir()
        if path is None and folder is not None:
            path = Path(folder) / RETURNS_CSV
        self._open_path = path
        if path is None:
            return
        # Rows of training that was lost after the last save are dropped: they will come again
        past = [row for row in read_returns(path) if row["timesteps"] <= self.num_timesteps] if path.exists() else []
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(past)
        for row in past:
            self.mean_returns[int(row["task_id"])].append(row["mean_return"])

    def _on_step(self) -> bool:
        for info, done in zip(self.locals["infos"], self.locals["dones"], strict=True):
            if done:
                self._finished[info["task_id"]].append(info["episode_return"])
        return True

    def _on_rollout_end(self) -> None:
        rows = []
        for task_id, returns in sorted(self._finished.items()):
            mean_return = float(np.mean(returns))
            self.mean_returns[task_id].append(mean_return)
            rows.append((self.num_timesteps, task_id, len(returns), mean_return))
            self.logger.record("continual/mean_return", mean_return)
            self.logger.record(f"continual/average_task_{task_id}", np.mean(self.mean_returns[task_id]))
        self._finished.clear()
        task_id = self.locals["infos"][0]["task_id"]
        self.logger.record("continual/task_id", task_id)
        self.logger.record("continual/n_switches", task_id)
        if self.mean_returns:
            self.logger.record("continual/average_performance", np.mean(list(chain(*self.mean_returns.values()))))
        if self._open_path is not None and rows:
            with open(self._open_path, "a", newline="") as file:
                csv.writer(file).writerows(rows)


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
