"""Evaluates on all tasks during training, for what is forgotten and what is transferred."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_cchain.analysis.metrics.continual import return_matrix
from sb3_cchain.analysis.random_state import unchanged_random_state
from sb3_cchain.callbacks.log_folder import log_folder
from sb3_cchain.callbacks.returns_file import ReturnsFile, read_returns
from sb3_cchain.tasks.callback_tree import require_single
from sb3_cchain.tasks.evaluation import check_same_tasks
from sb3_cchain.tasks.signal import (
    TASK_KEY,
    TaskSwitch,
    active_signal,
    first_reset_info,
    is_continual,
    require_continual,
)
from sb3_cchain.tasks.sync import warn_without_sync
from sb3_cchain.tensorboard.overview import add_overview
from sb3_cchain.validation import check_bool, check_number

TASK_RETURNS_CSV = "task_returns.csv"
TASK_COLUMNS = ("timesteps", "trained_task", "task_id", "n_episodes", "mean_return")


class EvalAllTasks(BaseCallback):
    r"""
    Evaluates the agent on every task of a :class:`~sb3_cchain.ContinualEnv`: before training, whenever the task has switched,
    at the end of training and, if wanted, at intervals. It acts between rollouts: after the last update on a task, and before
    callbacks that come after it in the list, such as :class:`~sb3_cchain.methods.Oracle`, change the networks for the next.
    Where a task ends within a rollout, it is up to a rollout late. The tasks are the environment's own, whatever a
    :class:`~sb3_cchain.TaskSignal` says. ``MaskablePPO`` is evaluated without masks.

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
        does) and its wrappers leave the observations as they are
    :param n_eval_episodes: Episodes per task
    :param interval: Environment steps between evaluations besides those at switches; None for none
    :param deterministic: Whether to take the policy's most likely action
    :param seed: Seed of the evaluation episodes
    :param path: The CSV file; by default ``task_returns.csv`` in the folder of the logs, if there is one (see
        :class:`~sb3_cchain.ContinualMetrics`)
    :raises ValueError: Naming the argument that is out of its range. When training starts: for an evaluation environment that
        has other tasks or spaces, or cannot be made; for a second EvalAllTasks; for a file that is not one of task returns
    :raises TypeError: When ``path`` is not a path or ``deterministic`` not a boolean. When training starts, for an environment
        that is not continual
    """

    def __init__(
        self,
        eval_env: gym.Env | VecEnv | None = None,
        *,
        n_eval_episodes: int = 5,
        interval: int | None = None,
        deterministic: bool = True,
        seed: int = 0,
        path: str | Path | None = None,
    ):
        super().__init__()
        check_number("n_eval_episodes", n_eval_episodes, 1, integer=True)
        if interval is not None:
            check_number("interval", interval, 1, integer=True)
        check_bool("deterministic", deterministic)
        check_number("seed", seed, 0, integer=True)
        if path is not None and not isinstance(path, (str, PathLike)):
            raise TypeError(f"`path` must be a path, got {path!r}")
        self.eval_env: Any = eval_env  # vectorised, once there is a model
        self.n_eval_episodes = n_eval_episodes
        self.interval = interval
        self.deterministic = deterministic
        self.seed = seed
        self.path = None if path is None else Path(path)
        self._file: ReturnsFile | None = None
        self._last_step = 0

    def _init_callback(self) -> None:
        require_continual(self)
        env = _make_eval_env(self.model) if self.eval_env is None else self.eval_env
        self.eval_env = self.model._wrap_env(env, verbose=0)
        normalize = unwrap_vec_normalize(self.eval_env)
        if normalize is not None:
            normalize.training = False  # its statistics are those of training
        expected, given = self.training_env.observation_space, self.eval_env.observation_space
        if given.shape != expected.shape:
            raise ValueError(
                f"`eval_env` must have the observations of the training environment, {expected}, got {given}. Wrap it as the "
                "training environment"
            )
        if not is_continual(self.eval_env):
            raise TypeError(f"`eval_env` must be a continual environment, got {self.eval_env.unwrapped}")
        check_same_tasks(self.training_env, self.eval_env)

    def _on_training_start(self) -> None:
        require_single(self)
        warn_without_sync(self)
        add_overview(self.model)
        is_new = self.num_timesteps == 0
        past = [] if is_new else getattr(self.model, "task_returns", [])
        self.rows = [row for row in past if row["timesteps"] <= self.num_timesteps]
        self.model.task_returns = self.rows  # type: ignore[attr-defined]
        folder = log_folder(self.model)
        path = self.path or (folder / TASK_RETURNS_CSV if folder is not None else None)
        self._file = None if path is None else ReturnsFile(path, self.rows, keep_old=is_new, columns=TASK_COLUMNS)
        self._switch = TaskSwitch()
        self._trained_task: int | None = None
        self._last_step = self.num_timesteps

    def _on_rollout_start(self) -> None:
        before, now = self._switch.task_id, first_reset_info(self.training_env)[TASK_KEY]
        if self._switch.happened(now):
            self._evaluate(before, at_switch=True)
            self._trained_task = None  # nothing is left to evaluate if training ends before it is trained on the next
        elif self._is_due():
            self._evaluate(now)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self._trained_task = self.locals["infos"][0][TASK_KEY]

    def _on_training_end(self) -> None:
        if self._trained_task is not None:
            self._evaluate(self._trained_task)
            self.logger.dump(self.num_timesteps)
        if self._file is not None:
            self._file.close()

    def _is_due(self) -> bool:
        if self.num_timesteps == 0:
            return True
        return self.interval is not None and self.num_timesteps // self.interval > self._last_step // self.interval

    def _evaluate(self, trained_task: int, at_switch: bool = False) -> None:
        self._last_step = self.num_timesteps
        self._copy_statistics(at_switch)
        with _unchanged(self.model):
            returns = self._all_returns()
        new = [
            dict(zip(TASK_COLUMNS, (self.num_timesteps, trained_task, task, self.n_eval_episodes, value), strict=True))
            for task, value in enumerate(returns)
        ]
        self.rows += new
        if self._file is not None:
            self._file.append(new)
        for name, value in _figures(self.rows, trained_task).items():
            self.logger.record(f"continual_eval/{name}", value)

    def _copy_statistics(self, at_switch: bool) -> None:
        source, target = self.model.get_vec_normalize_env(), unwrap_vec_normalize(self.eval_env)
        if source is None or target is None or not source.norm_obs:
            return
        statistics = source.obs_rms
        if at_switch and active_signal(self.training_env) is None:
            statistics = getattr(source, "last_task_obs_rms", statistics)
        target.obs_rms = deepcopy(statistics)

    def _all_returns(self) -> list[float]:
        """The mean return on each task."""
        n_tasks, cycles = (self.eval_env.get_attr(name, indices=0)[0] for name in ("n_tasks", "cycles"))
        returns = []
        for task in range(n_tasks // cycles):
            self.eval_env.env_method("set_task", task)
            self.eval_env.seed(self.seed)
            returns.append(self._mean_return())
        return returns * cycles

    def _mean_return(self) -> float:
        returns: list[float] = []

        def collect(step: Mapping[str, Any], _: Any) -> None:
            if step["done"]:
                returns.append(step["info"]["episode_return"])

        evaluate_policy(self.model, self.eval_env, self.n_eval_episodes, self.deterministic, callback=collect, warn=False)
        return float(np.mean(returns))


def read_task_returns(path: str | Path) -> list[dict[str, float]]:
    """
    :param path: CSV file written by :class:`EvalAllTasks`
    :return: Its rows
    :raises ValueError: When it is not such a file, or a line of it is damaged
    """
    return read_returns(path, TASK_COLUMNS)


def _figures(rows: list[dict[str, float]], trained_task: int) -> dict[str, float]:
    """What is logged of the last evaluation, which is in the rows."""
    before, after = return_matrix(rows)
    now = np.array([row["mean_return"] for row in rows[-len(before) :]])
    left = np.diag(after)[:trained_task] - now[:trained_task]
    to_come = (now - before)[trained_task + 1 :]
    figures = {f"task_{task}": value for task, value in enumerate(now)} | {"average": now.mean()}
    for name, values in (("forgetting", left), ("zero_shot_transfer", to_come)):
        known = values[~np.isnan(values)]
        if len(known):
            figures[name] = known.mean()
    return {name: float(value) for name, value in figures.items()}


def _make_eval_env(model: BaseAlgorithm) -> VecEnv:
    """An environment like that of training, wrapped as far as Stable-Baselines3 does it."""
    training_env = model.get_env()
    assert training_env is not None
    spec = training_env.get_attr("spec", indices=0)[0]
    if spec is None:
        raise ValueError("The training environment was not made by gymnasium.make(): give EvalAllTasks an `eval_env`")
    env = model._wrap_env(gym.make(replace(spec, additional_wrappers=())), verbose=0)
    normalize = model.get_vec_normalize_env()
    if normalize is None:
        return env
    return VecNormalize(
        env,
        training=False,
        norm_obs=normalize.norm_obs,
        norm_reward=False,
        clip_obs=normalize.clip_obs,
        epsilon=normalize.epsilon,
        norm_obs_keys=normalize.norm_obs_keys,
    )


@contextmanager
def _unchanged(model: BaseAlgorithm) -> Iterator[None]:
    """Leave a model as it was: random numbers and the mode of its networks."""
    was_training = model.policy.training
    actions = model.action_space.np_random.bit_generator  # of DQN's random actions
    state = deepcopy(actions.state)
    try:
        with unchanged_random_state():
            yield
    finally:
        actions.state = state
        model.policy.set_training_mode(was_training)
