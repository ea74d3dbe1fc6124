"""What is trained: C-CHAIN PPO with one argument at a time at another value than the shipped one, and PPO."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.grid.plan import run_length
from benchmarks.grid.results import find_result
from benchmarks.grid.run import Run, make_run, shipped_hyperparameters
from benchmarks.report.best_of import paper_strengths

SUITE = "gym_control"
ENVS = ("Continual/Acrobot-v1", "Continual/LunarLander-v3")


class Parameter(NamedTuple):
    """
    An argument of C-CHAIN PPO.

    :param argument: Its name
    :param label: Human-readable name
    :param values: What is tried
    :param default: Its value where the shipped hyperparameters do not name it
    """

    argument: str
    label: str
    values: Sequence[str]
    default: float | None = None

    def is_shipped(self, value: str, env_id: str) -> bool:
        """
        :param value: One of its values
        :param env_id: Environment id
        :return: Whether that is the shipped value
        """
        shipped = shipped_hyperparameters("ppo_cchain", env_id) or {}
        return bool(float(value) == shipped.get(self.argument, self.default))


PARAMETERS = {
    "beta": Parameter("target_churn_ratio", "β", ("1e2", "1e3", "1e4", "1e5", "1e6")),
    "reference": Parameter(
        "churn_batch_size", "reference batch, in minibatches", ("0.25", "0.5", "1", "2", "4", "8"), default=1.0
    ),
}

# J(T) by seed, of each environment and value
Scores = dict[str, dict[str, dict[int, float]]]


def base_run(env_id: str, seed: int, budget: str) -> Run:
    """
    :param env_id: Environment id
    :param seed: Seed
    :param budget: Length of the run
    :return: The run of PPO: that of the grid
    """
    return make_run(SUITE, env_id, "vanilla", seed, *run_length(SUITE, env_id, budget), budget)


def sensitivity_run(name: str, value: str, env_id: str, seed: int, budget: str) -> Run:
    """
    :param name: Key of ``PARAMETERS``
    :param value: One of its values
    :param env_id: Environment id
    :param seed: Seed
    :param budget: Length of the run
    :return: The run of C-CHAIN PPO with that value: that of the grid for the shipped values, and for each β among which the
        paper takes the best
    """
    parameter = PARAMETERS[name]
    n_tasks, steps = run_length(SUITE, env_id, budget)
    shipped = make_run(SUITE, env_id, "cchain", seed, n_tasks, steps, budget)
    own = f"sensitivity_{n_tasks}x{steps}"
    if parameter.is_shipped(value, env_id):
        return shipped
    if name == "beta":
        experiment = budget if value in paper_strengths(SUITE, "cchain") else own
        return make_run(SUITE, env_id, f"cchain@{value}", seed, n_tasks, steps, experiment)
    change = f"{parameter.argument}:{value}"
    return replace(shipped, experiment=own, variant=f"cchain_{parameter.argument}_{value}", overrides=(change,))


def all_runs(
    names: Iterable[str], values: Sequence[str] | None, env_ids: Sequence[str], seeds: Iterable[int], budget: str
) -> list[Run]:
    """
    :param names: Keys of ``PARAMETERS``
    :param values: Some of their values, None for all
    :param env_ids: Environment ids
    :param seeds: Seeds
    :param budget: Length of the runs
    :return: The runs, each once: all of a seed, then the next seed
    :raises ValueError: For a value that none of them has
    """
    names = list(names)
    known = [value for name in names for value in PARAMETERS[name].values]
    for value in values or ():
        if value not in known:
            raise ValueError(f"--value must be one of {', '.join(known)}; got {value}")
    runs = []
    for seed in seeds:
        for env_id in env_ids:
            runs += [] if values else [base_run(env_id, seed, budget)]
            for name in names:
                chosen = [value for value in PARAMETERS[name].values if values is None or value in values]
                runs += [sensitivity_run(name, value, env_id, seed, budget) for value in chosen]
    return list(dict.fromkeys(runs))


def read_scores(name: str, seeds: Sequence[int], budget: str, results: Path) -> tuple[Scores, Scores]:
    """
    :param name: Key of ``PARAMETERS``
    :param seeds: Seeds
    :param budget: Length of the runs
    :param results: Folder of all results
    :return: J(T) of the runs that are done: of each value of the parameter, and of PPO, under the name ``"ppo"``
    """

    def scores(runs: Sequence[Run]) -> dict[int, float]:
        found = {run.seed: find_result(run, results) for run in runs}
        return {seed: float(np.mean(result.task_averages())) for seed, result in found.items() if result is not None}

    values = {
        env_id: {
            value: scores([sensitivity_run(name, value, env_id, seed, budget) for seed in seeds])
            for value in PARAMETERS[name].values
        }
        for env_id in ENVS
    }
    base = {env_id: {"ppo": scores([base_run(env_id, seed, budget) for seed in seeds])} for env_id in ENVS}
    return values, base
