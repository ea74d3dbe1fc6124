"""How well an agent does over a sequence of tasks, while it is trained."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_cchain.callbacks.log_folder import log_path
from sb3_cchain.callbacks.returns_file import COLUMNS, RETURNS_CSV, ReturnsFile, read_returns
from sb3_cchain.tasks.listening import start_listening
from sb3_cchain.tasks.signal import (
    TASK_KEY,
    TaskSwitch,
    episode_goes_on,
    episode_task,
    first_reset_info,
    remember_episode,
    step_task,
)
from sb3_cchain.tensorboard.overview import add_overview
from sb3_cchain.validation import check_path


class ContinualMetrics(BaseCallback):
    r"""
    Logs how well the agent does over the tasks of a :class:`~sb3_cchain.ContinualEnv`, from the episodes of training:

    - ``continual/task_id``: the task being trained; ``continual/n_switches``: switches so far
    - ``continual/mean_return``: mean return of the episodes that ended in this rollout on that task
    - ``continual/reward_per_step``: mean reward of an environment step of this rollout on that task
    - ``continual/average_task_<i>``: :math:`J(\mathcal{T}_i)`, the mean return of task ``i`` over its rollouts
    - ``continual/average_performance``: :math:`J(\mathbb{T})` so far, the mean of those over the tasks (Eq. 1 of the C-CHAIN
      paper)

    Rewards and returns are the environment's own, also where the agent learns from scaled or normalised rewards.
    A rollout in which no episode ends does not count; off-policy algorithms, whose rollouts are the few steps between two
    updates, have a row per episode. An episode that is cut by a switch counts with its return up to there.

    A task whose episodes never end has no returns. Its reward per step counts as its return: where no episode of a task ended
    before the switch cut it, or before training ended, the task has one row, with 0 episodes and the mean reward per
    environment step of the whole task.

    The same goes to a CSV file, a line per rollout and task: environment steps at the end of the rollout, task, number of
    episodes that ended, their mean return. They are kept with the model, as ``model.continual_returns``, too, so that training
    that is resumed continues both. When training begins at step 0, a file that is there already is kept as ``<name>.1`` (or
    the next free number).

    Where the task switches within an episode that goes on, such a row is of the steps up to the switch, and the return of the
    episode counts for the task in which it ends.

    In an environment that is not continual the rewards are those before ``VecNormalize``. Its tasks are those of a
    :class:`~sb3_cchain.TaskSignal` before this callback. Without one, each further environment that ``set_env()`` gives,
    followed by ``learn(..., reset_num_timesteps=False)``, is the next task.

    The algorithms with churn reduction add the callback by themselves in a continual environment, and where there is a
    ``TaskSignal``. Give it to other algorithms.

    :param path: The CSV file; by default ``returns.csv`` in the folder of the logs, if the model has ``tensorboard_log``
        or was given a logger by ``set_logger()``
    :raises ValueError: When training starts, if the file is not a file of returns, is damaged, or is being written by another
        process, or if ``learn()`` was given a second ContinualMetrics
    :raises TypeError: If ``path`` is not a path; during training, if the environment's ``info["task_id"]`` is not an integer
    """

    def __init__(self, path: str | Path | None = None):
        super().__init__()
        self.path = None if path is None else check_path("path", path)
        self._finished: dict[int, list[float]] = defaultdict(list)
        self._endless: dict[int, float] = {}
        self._file: ReturnsFile | None = None
        self._is_training = False

    def _on_training_start(self) -> None:
        start_listening(self, needs_switches=False)
        add_overview(self.model)
        self._finished.clear()
        self._endless.clear()
        is_new = self.num_timesteps == 0
        self._state: dict[str, Any] = self._past_state(is_new)
        self.model.continual_state = self._state  # type: ignore[attr-defined]
        self._switch = TaskSwitch(self._state["task_id"])

        path = self.path or log_path(self.model, RETURNS_CSV)
        self.rows: list[dict[str, float]] = [] if is_new else self._past_rows(path)
        self.model.continual_returns = self.rows  # type: ignore[attr-defined]
        self._file = None if path is None else ReturnsFile(path, self.rows, keep_old=is_new)
        self._averages: dict[int, float] = task_averages(self.rows)
        self._average_performance = float(np.mean(list(self._averages.values()))) if self._averages else np.nan
        self._n_rows = Counter(int(row["task_id"]) for row in self.rows)

        self._vec_normalize = self.model.get_vec_normalize_env()
        self._rollout_reward, self._rollout_steps = 0.0, 0
        self._is_training = True

    def _past_state(self, is_new: bool) -> dict[str, Any]:
        """Of the task being trained, kept with the model: the rewards and steps so far, and the episodes that ended."""
        state = None if is_new else getattr(self.model, "continual_state", None)
        if state is None:
            state = {"task_id": None, "n_switches": 0, "reward": 0.0, "n_steps": 0, "n_episodes": 0}
        if "returns" not in state or not episode_goes_on(self.model):
            state["returns"] = np.zeros(self.training_env.num_envs)  # of the present episodes so far
        if state["n_steps"] > 0 and state["n_episodes"] == 0 and episode_task(self.model) != state["task_id"]:
            state["n_steps"] = 0  # its row is written
        return state

    def _past_rows(self, path: Path | None) -> list[dict[str, float]]:
        """Those kept with the model or, where it has none, those of the file."""
        past = getattr(self.model, "continual_returns", [])
        if not past and path is not None and path.exists():
            past = read_returns(path)
        # Rows of training that was lost after the last save will come again, and so will the row of a task that goes on and
        # in which no episode has ended yet
        goes_on = self._state["n_steps"] > 0 and self._state["n_episodes"] == 0
        present = (self.num_timesteps, self._state["task_id"], 0) if goes_on else None
        return [
            row
            for row in past
            if row["timesteps"] <= self.num_timesteps and (row["timesteps"], row["task_id"], row["n_episodes"]) != present
        ]

    def _on_step(self) -> bool:
        infos, dones = self.locals["infos"], self.locals["dones"]
        task_id = step_task(self.model, infos)
        if task_id is not self._state["task_id"]:  # a number may also be equal and another object
            self._hear_of(task_id)
        self._count_rewards(infos)
        if any(dones.tolist()):  # between two steps this is several times as fast as `dones.any()`
            self._count_episodes(infos, dones)
        remember_episode(self.model)
        return True

    def _hear_of(self, task_id: Any) -> None:
        if self._switch.happened(task_id):
            self._state["n_switches"] += 1
            self._begin_task(task_id)
        elif self._state["task_id"] is None:
            self._begin_task(task_id)

    def _begin_task(self, task_id: Any) -> None:
        if not isinstance(task_id, Integral):
            raise TypeError(f'ContinualMetrics needs an integer as `info["task_id"]`, got {task_id!r}')
        self._close_task()
        self._state.update(task_id=task_id, reward=0.0, n_steps=0, n_episodes=0)
        self._rollout_reward, self._rollout_steps = 0.0, 0

    def _count_rewards(self, infos: list[dict[str, Any]]) -> None:
        if "task_reward" in infos[0]:
            reward = sum([info["task_reward"] for info in infos])
        else:
            normalize = self._vec_normalize
            rewards = self.locals["rewards"] if normalize is None else normalize.get_original_reward()
            if isinstance(self.model, OnPolicyAlgorithm):  # an EpisodicRollouts drops episodes
                self._state["returns"][self.model._last_episode_starts] = 0.0
            self._state["returns"] += rewards
            reward = float(rewards.sum())
        self._state["reward"] += reward
        self._state["n_steps"] += len(infos)
        self._rollout_reward += reward
        self._rollout_steps += len(infos)

    def _count_episodes(self, infos: list[dict[str, Any]], dones: NDArray[np.bool_]) -> None:
        state, ended = self._state, np.flatnonzero(dones).tolist()
        began = first_reset_info(self.training_env)
        # An environment that numbers its tasks may end them by cutting the episodes. A switch by the word of another cuts none
        was_cut = TASK_KEY in began and TaskSwitch(infos[0].get(TASK_KEY)).happened(began[TASK_KEY])
        state["n_episodes"] += sum(not (was_cut and infos[index].get("TimeLimit.truncated", False)) for index in ended)
        if state["n_episodes"] > 0:
            self._finished[state["task_id"]] += [self._episode_return(infos[index], index) for index in ended]
        else:
            self._endless[state["task_id"]] = state["reward"] / state["n_steps"]
            state.update(reward=0.0, n_steps=0)
        state["returns"][ended] = 0.0

    def _episode_return(self, info: dict[str, Any], index: int) -> float:
        if "episode_return" in info:
            return info["episode_return"]
        # Monitor's, if there is one, also knows of resets that are not at the end of an episode
        return float(info["episode"]["r"] if "episode" in info else self._state["returns"][index])

    def _take_rows(self) -> list[dict[str, float]]:
        """The rows since the last call, which are written and kept."""
        if not self._finished and not self._endless:
            return []  # as between most steps of off-policy algorithms
        values = {task_id: (len(returns), float(np.mean(returns))) for task_id, returns in self._finished.items()}
        values.update({task_id: (0, reward) for task_id, reward in self._endless.items()})
        # The present task came last, also where it is a former one that has come back
        present = self._state["task_id"]
        tasks = sorted(values, key=lambda task_id: (task_id == present, task_id))
        new = [dict(zip(COLUMNS, (self.num_timesteps, task_id, *values[task_id]), strict=True)) for task_id in tasks]
        self._finished.clear()
        self._endless.clear()
        self.rows += new
        if self._file is not None:
            self._file.append(new)
        return new

    def _on_rollout_end(self) -> None:
        new, present_task, logger = self._take_rows(), self._state["task_id"], self.logger
        logger.record("continual/task_id", present_task)
        logger.record("continual/n_switches", self._state["n_switches"])
        if self._rollout_steps > 0:
            logger.record_mean("continual/reward_per_step", self._rollout_reward / self._rollout_steps)
            self._rollout_reward, self._rollout_steps = 0.0, 0
        for row in new:
            task_id = int(row["task_id"])
            self._n_rows[task_id] += 1
            average = self._averages.get(task_id, 0.0)
            self._averages[task_id] = average + (row["mean_return"] - average) / self._n_rows[task_id]
            logger.record(f"continual/average_task_{task_id}", self._averages[task_id])
            if task_id == present_task:
                logger.record_mean("continual/mean_return", row["mean_return"])
        if new:
            self._average_performance = float(np.mean(list(self._averages.values())))
        if self._averages:
            logger.record("continual/average_performance", self._average_performance)

    def _close_task(self) -> None:
        """The row of a task in which no episode has ended."""
        state = self._state
        if state["n_episodes"] == 0 and state["n_steps"] > 0:
            self._endless[state["task_id"]] = state["reward"] / state["n_steps"]

    def _on_training_end(self) -> None:
        if not self._is_training:  # RL Zoo tells the first callback twice that training has ended
            return
        self._is_training = False
        self._close_task()
        self._take_rows()
        if self._file is not None:
            self._file.close()


def task_averages(rows: Sequence[Mapping[str, float]]) -> dict[int, float]:
    r"""
    :param rows: Rows of :func:`~sb3_cchain.callbacks.read_returns`
    :return: :math:`J(\mathcal{T}_i)` by task: the mean over its rollouts of the mean return of their episodes
    """
    by_task: dict[int, list[float]] = defaultdict(list)
    for row in rows:
        by_task[int(row["task_id"])].append(row["mean_return"])
    return {task_id: float(np.mean(returns)) for task_id, returns in by_task.items()}
