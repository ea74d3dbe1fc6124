"""What is trained: methods of a suite, and C-CHAIN with one component of its gradient, all watched by the monitors."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.grid.run import Run, available_methods, make_run, shipped_hyperparameters, suite_lines, suite_methods
from benchmarks.grid.suites import SUITES
from benchmarks.report.quantities import PLASTICITY, Quantity
from sb3_cchain.methods.registry import Method

# The first word of these runs' experiment
EXPERIMENT = "plasticity"

# What the paper's analysis compares, and the components of C-CHAIN's gradient in its ablation, with their colours
METHODS = ("vanilla", "trac", "cchain")
COMPONENTS = {"projection": "magenta", "orthogonal": "limegreen"}

# How often a run is looked at, at most. A matrix of ProcGen's network takes 3.5 s of a core and 0.45 GB of memory
N_LOOKS = 200

CHURN = "churn_monitor/fresh/policy_churn"
# In the suites whose policies have other outputs than the probabilities of actions. DQN does not log in step with its updates
OTHER_CHURN = {
    "dmc": Quantity(CHURN, "policy churn, squared change of the mean action", logarithmic=True, delay=1),
    "minatar": Quantity("churn_monitor/fresh/value_churn", "value churn, absolute", logarithmic=True),
}


def quantities(suite: str) -> list[Quantity]:
    """
    :param suite: Name of a suite
    :return: What is drawn and tabled in it
    """
    return [OTHER_CHURN.get(suite, quantity) if quantity.name == CHURN else quantity for quantity in PLASTICITY]


def lines(suite: str, names: Iterable[str] = ()) -> dict[str, Method]:
    """
    :param suite: Name of a suite
    :param names: Names of methods, some with another strength
    :return: Label and colour of all methods of the suite, of those with another strength, and of the components
    """
    components = {}
    if SUITES[suite].algo == "ppo":
        cchain = suite_methods(suite)["cchain"]
        components = {name: replace(cchain, label=f"{name} alone", color=color) for name, color in COMPONENTS.items()}
    return {**suite_lines(suite, [name for name in names if name not in COMPONENTS]), **components}


def default_names(suite: str, env_id: str) -> list[str]:
    """
    :param suite: Name of a suite
    :param env_id: One of its environments
    :return: What is compared in it: those that the paper's analysis compares, as far as they have hyperparameters there
    """
    known = [*available_methods(suite, env_id), *COMPONENTS]
    return [name for name in (*METHODS, *COMPONENTS) if name in lines(suite) and name in known]


def watched_run(suite: str, name: str, env_id: str, seed: int, n_tasks: int, steps: int) -> Run:
    """
    :param suite: Name of a suite
    :param name: Name of a method, or of a component
    :param env_id: One of the suite's environments
    :param seed: Seed
    :param n_tasks: Length of the task sequence
    :param steps: Environment steps per task
    :return: The run, with the monitors beside the callbacks of the shipped hyperparameters
    :raises ValueError: As :func:`~benchmarks.grid.run.make_run`, and for a component where there are none
    """
    is_component = name in COMPONENTS
    if is_component and name not in lines(suite):
        raise ValueError(f"`method` must not be a component of C-CHAIN's gradient in {suite}, which has none; got {name}")
    run = make_run(suite, env_id, "cchain" if is_component else name, seed, n_tasks, steps, f"{EXPERIMENT}_{n_tasks}x{steps}")
    shipped = shipped_hyperparameters(run.algo, env_id) or {}
    sync, *others = shipped["callback"]  # monitors come before what changes the network
    overrides = (*run.overrides, f"callback:{[sync, *monitors(run, shipped), *others]}")
    if is_component:
        return replace(run, variant=name, overrides=(*overrides, f"churn_component:'{name}'"))
    return replace(run, overrides=overrides)


def monitors(run: Run, shipped: Mapping[str, Any]) -> list[str | dict[str, Any]]:
    """
    :param run: A run
    :param shipped: Its hyperparameters
    :return: The monitors, as in a YAML file
    """
    interval = _look_interval(_n_trainings(run, shipped))
    return [
        "sb3_cchain.ChurnMonitor",
        {"benchmarks.plasticity.snapshots.NTKSnapshots": {"times": snapshot_times(run), "interval": interval}},
        {"sb3_cchain.analysis.NetworkHealth": {"interval": interval}},
    ]


def n_looks(run: Run) -> int:
    """
    :param run: A run
    :return: How often it is looked at
    """
    n_trainings = _n_trainings(run, shipped_hyperparameters(run.algo, run.env_id) or {})
    return n_trainings // _look_interval(n_trainings)


def _n_trainings(run: Run, shipped: Mapping[str, Any]) -> int:
    return run.total_steps // shipped.get("n_steps", 1)  # of DQN here, one in a step


def _look_interval(n_trainings: int) -> int:
    return max(n_trainings // N_LOOKS, 1)


def snapshot_times(run: Run) -> list[int]:
    """
    :param run: A run
    :return: When its NTK is kept: at the end of the first task, at the end of the last, and half-way in between
    """
    return sorted({int(time) for time in np.linspace(run.steps_per_task, run.total_steps, 3)})
