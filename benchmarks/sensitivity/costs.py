"""
What an iteration costs with each size of the reference batch: processor time, all sizes in turn. The wall time that results
have tells how busy the machine was as well. β costs nothing.
"""

import csv
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3 import PPO

from benchmarks.sensitivity.runs import ENVS, PARAMETERS
from benchmarks.speed.settings import model_settings
from benchmarks.speed.timing import seconds
from benchmarks.speed.training import iteration
from sb3_cchain import CChainPPO
from sb3_cchain.checkpoint import write_safely

COLUMNS = ("env_id", "model", "round", "seconds_per_1000_steps")
BASE = "ppo"
N_ROUNDS = 10


class Cost(NamedTuple):
    """
    Processor time of a model.

    :param seconds: Seconds per 1000 environment steps, the median over the rounds
    :param ratios: Seconds divided by PPO's of the same round: median, least and greatest
    """

    seconds: float
    ratios: tuple[float, float, float]


def measure(path: Path, n_rounds: int = N_ROUNDS, env_ids: tuple[str, ...] = ENVS, **changed: Any) -> None:
    """
    Time an iteration (rollout and ``train()``) of PPO, and of C-CHAIN PPO with each size, on one thread.

    :param path: CSV file
    :param n_rounds: How often each is timed
    :param env_ids: Environment ids
    :param changed: Arguments of the models that differ from the shipped settings
    """
    th.set_num_threads(1)
    rows = []
    for env_id in env_ids:
        models = {BASE: PPO(**model_settings("ppo", env_id, **changed))}
        for size in PARAMETERS["reference"].values:
            models[size] = CChainPPO(**model_settings("ppo_cchain", env_id, churn_batch_size=float(size), **changed))
        for model in models.values():
            iteration(model)  # from here on, every update has a churn loss
        for number in range(n_rounds):
            for name, model in models.items():
                per_1000 = 1000 * seconds(partial(iteration, model)) / model.n_steps
                rows.append((env_id, name, number, f"{per_1000:.4f}"))
    with write_safely(path) as unfinished, open(unfinished, "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows(rows)


def read_costs(path: Path) -> Mapping[str, Mapping[str, Cost]]:
    """
    :param path: CSV file of :func:`measure`
    :return: By environment and model, nothing where nothing was measured
    """
    if not path.exists():
        return {}
    timings: dict[str, dict[str, list[float]]] = {}
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            timings.setdefault(row["env_id"], {}).setdefault(row["model"], []).append(float(row["seconds_per_1000_steps"]))
    costs: dict[str, dict[str, Cost]] = {}
    for env_id, models in timings.items():
        for name, own in models.items():
            ratios = np.array(own) / np.array(models[BASE])
            cost = Cost(float(np.median(own)), (float(np.median(ratios)), float(ratios.min()), float(ratios.max())))
            costs.setdefault(env_id, {})[name] = cost
    return costs
