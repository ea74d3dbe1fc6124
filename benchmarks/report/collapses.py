"""Collapses in Gym Control: tasks at whose end the policy repeats one action, and how much it changed when they began."""

from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks.grid.results import Result
from benchmarks.report.markdown import markdown_table
from benchmarks.report.task_tables import in_order
from sb3_cchain.methods.registry import Method

# A policy has collapsed where the mean return of the last ten rollouts of a task is below this. The best policy that repeats
# one action has -400 in Acrobot, 9.5 in CartPole and -139 in LunarLander, where it leaves the engines off. Not in MountainCar,
# where a policy that has not found the goal yet looks the same
COLLAPSED = {"Continual/Acrobot-v1": -250, "Continual/CartPole-v1": 100, "Continual/LunarLander-v3": -100}

POLICY_CHURN = "churn/policy_churn"
# Where churn was logged, its median over the last ten iterations must be below this, too: a policy that learns slowly may end
# with returns as low as those above, but it changes
NO_CHURN = 1e-9


def has_collapsed(result: Result, task: int) -> bool:
    """
    :param result: A run in an environment of ``COLLAPSED``
    :param task: Number of one of its tasks
    :return: Whether its policy has collapsed at the end of the task
    """
    if result.returns_in_task(task)[1][-10:].mean() >= COLLAPSED[result.env_id]:
        return False
    return POLICY_CHURN not in result.metrics or bool(np.median(_policy_churn(result, task)[-10:]) < NO_CHURN)


def collapses(results: Sequence[Result]) -> tuple[int, int]:
    """
    :param results: Runs in environments of ``COLLAPSED``
    :return: Tasks after a switch at whose end the policy has collapsed, and tasks after a switch
    """
    ends = [has_collapsed(result, task) for result in results for task in range(1, result.n_tasks)]
    return sum(ends), len(ends)


def collapses_table(results: Sequence[Result], lines: Mapping[str, Method]) -> str:
    """
    :param results: Runs in one environment of ``COLLAPSED``, of one length
    :param lines: Label of each method or variant, in their order
    :return: For each run that reduces churn: the policy churn of the first iteration of each task after a switch, in bold
        where the policy has collapsed at the end of the task
    """
    tasks = range(1, results[0].n_tasks)
    rows = []
    for result in in_order([result for result in results if POLICY_CHURN in result.metrics], lines):
        churn = [_policy_churn(result, task)[0] for task in tasks]
        cells = [f"{value:.1g}" for value in churn]
        cells = [f"**{cell}**" if has_collapsed(result, task) else cell for task, cell in zip(tasks, cells, strict=True)]
        rows.append([lines[result.line].label, str(result.seed), *cells])
    return markdown_table(["method", "seed", *map(str, tasks)], rows)


def _policy_churn(result: Result, task: int) -> np.ndarray:
    # SB3 writes what an iteration logged at the end of the next rollout
    return result.metric_in_task(POLICY_CHURN, task, delay=1)[1]
