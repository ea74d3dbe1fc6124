"""A training, and the file that it leaves."""

import csv
import shutil
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from copy import deepcopy
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.callbacks import MaskableEvalCallback
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from benchmarks.family.case import Case, Variant
from benchmarks.family.cases import CASES
from sb3_cchain import ChurnMonitor, TaskSync, TrainingCheckpoint, resume
from sb3_cchain.checkpoint import has_checkpoint, write_safely

# What `ChurnMonitor` measures
CHURN = ("policy_churn", "value_churn")


@dataclass(frozen=True)
class Run:
    """
    A training of a case.

    :param case_name: Key of ``CASES``
    :param variant_name: Key of the case's variants
    :param seed: Seed
    :param results: Folder of all results
    :param logs: Folder of the checkpoints of runs that are not done
    """

    case_name: str
    variant_name: str
    seed: int
    results: Path
    logs: Path

    @property
    def case(self) -> Case:
        """Its case."""
        return CASES[self.case_name]

    @property
    def variant(self) -> Variant:
        """Its variant."""
        return self.case.variants[self.variant_name]

    @property
    def name(self) -> str:
        """Its name."""
        return f"{self.case_name}/{self.variant_name}_seed_{self.seed}"

    @property
    def result(self) -> Path:
        """Its evaluations."""
        return self.results / f"{self.name}.csv"

    @property
    def checkpoints(self) -> Path:
        """Its checkpoints, until it is done."""
        return self.logs / self.name


def runs_of(case_name: str, results: Path, logs: Path) -> list[Run]:
    """
    :param case_name: Key of ``CASES``
    :param results: Folder of all results
    :param logs: Folder of the checkpoints
    :return: All runs of the case, in the order in which they are made: all variants of a seed, then the next seed
    """
    case = CASES[case_name]
    return [Run(case_name, variant, seed, results, logs) for seed in range(case.seeds) for variant in case.variants]


def train_all(runs: Sequence[Run], n_jobs: int) -> Iterator[Run]:
    """
    Train those that have no result yet.

    :param runs: Runs
    :param n_jobs: Runs at a time
    :return: Each run, as soon as it is done
    """
    waiting = [run for run in runs if not run.result.exists()]
    if n_jobs == 1:
        yield from map(train, waiting)
        return
    # A process for each run, where Python can
    fresh: dict[str, Any] = {"max_tasks_per_child": 1} if sys.version_info >= (3, 11) else {}
    with ProcessPoolExecutor(n_jobs, mp_context=get_context("spawn"), **fresh) as pool:
        try:
            for done in as_completed([pool.submit(train, run) for run in waiting]):
                yield done.result()
        except BaseException:
            # Else the pool would make all runs that wait, before the error or Ctrl-C shows
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def train(run: Run) -> Run:
    """
    Train to the end, from the last checkpoint if there is one, and write down the evaluations.

    :param run: The run
    :return: It
    """
    if run.result.exists():
        # Another process has made it meanwhile
        return run
    th.set_num_threads(1)
    case, variant = run.case, run.variant
    evaluation = _evaluation(run)
    churn_log = ChurnLog(evaluation.eval_freq)
    callbacks: list[BaseCallback] = [evaluation, TrainingCheckpoint(max(case.steps // 10, 1), run.checkpoints, keep=1)]
    if case.n_tasks > 1:
        callbacks.insert(0, TaskSync())
    if case.monitor is not None:
        # Before the evaluation, which writes the log and empties it
        callbacks = [ChurnMonitor(**case.monitor), churn_log, *callbacks]
    env = _make_env(case, case.n_envs)
    if has_checkpoint(run.checkpoints):
        resume(run.checkpoints, env, callbacks, device="cpu")
    else:
        settings = deepcopy({**case.settings, **variant.arguments})  # algorithms may write into `policy_kwargs`
        model = variant.algorithm(case.policy, env, seed=run.seed, device="cpu", **settings)
        # Nobody but the evaluation may empty the log, which holds the churn
        model.learn(case.steps, callbacks, log_interval=None)  # type: ignore[arg-type]  # SB3 takes None, too
    _write(run, evaluation, churn_log)
    shutil.rmtree(run.checkpoints, ignore_errors=True)
    return run


def _make_env(case: Case, n_envs: int, seed: int | None = None) -> VecEnv:
    env = make_vec_env(case.env, n_envs, seed=seed, env_kwargs=dict(case.env_kwargs))
    if not case.normalize:
        return env
    # As RL Zoo does
    is_training = seed is None
    return VecNormalize(env, training=is_training, norm_reward=is_training, gamma=case.settings.get("gamma", 0.99))


def _evaluation(run: Run) -> EvalCallback:
    case = run.case
    callback_class = MaskableEvalCallback if issubclass(run.variant.algorithm, MaskablePPO) else EvalCallback
    return callback_class(
        _make_env(case, 1, seed=1000 + run.seed),
        n_eval_episodes=case.n_eval_episodes,
        eval_freq=max(case.eval_freq // case.n_envs, 1),
        log_path=str(run.checkpoints / "evaluations"),
        verbose=0,
    )


class ChurnLog(BaseCallback):
    """
    Keeps what ``ChurnMonitor`` logged since the evaluation before.

    :param eval_freq: As of ``EvalCallback``
    """

    def __init__(self, eval_freq: int):
        super().__init__()
        self.eval_freq = eval_freq
        self.churn: dict[str, list[float | str]] = {name: [] for name in CHURN}

    def _on_step(self) -> bool:
        if self.n_calls % self.eval_freq == 0:
            for name, values in self.churn.items():
                values.append(self.logger.name_to_value.get(f"churn_monitor/fixed/{name}", ""))
        return True


def _write(run: Run, evaluation: EvalCallback, churn_log: ChurnLog) -> None:
    columns = {
        "timesteps": evaluation.evaluations_timesteps,
        "mean_return": np.mean(evaluation.evaluations_results, axis=1).tolist(),
    }
    if run.case.score == "success_rate":
        columns["success_rate"] = np.mean(evaluation.evaluations_successes, axis=1).tolist()
    if run.case.monitor is not None:
        columns.update(churn_log.churn)
    with write_safely(run.result) as path, open(path, "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        # On-policy algorithms complete their last rollout
        writer.writerows(row for row in zip(*columns.values(), strict=True) if row[0] <= run.case.steps)


def read(run: Run) -> np.ndarray:
    """
    :param run: A run that is done
    :return: Its evaluations: environment steps and score, ``(n_evaluations, 2)``. Where churn is measured, that of the policy
        and of the values since the evaluation before are two more columns, NaN where there was no update.
    :raises ValueError: When the file has other columns, or not the length of the case
    """
    with open(run.result, newline="") as file:
        rows = list(csv.DictReader(file))
    columns = ["timesteps", run.case.score, *(() if run.case.monitor is None else CHURN)]
    try:
        evaluations = np.array([[float(row[name] or "nan") for name in columns] for row in rows])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{run.result} must have the columns {' and '.join(columns)}: {error!r}") from error
    expected = run.case.steps // run.case.eval_freq
    if len(evaluations) != expected:
        raise ValueError(
            f"{run.result} must have {expected} evaluations, as the case {run.case_name} has, got {len(evaluations)}. "
            "It may be of another length: delete it to make the run again."
        )
    return evaluations
