r"""
How well an agent does over a sequence of tasks: pure functions of tables of returns.

Two kinds of tables go in:

- the returns of training, rows of ``returns.csv`` (:class:`~sb3_cchain.ContinualMetrics`), of the task being trained alone
- the returns of evaluations on all tasks, rows of ``task_returns.csv`` (:class:`~sb3_cchain.analysis.EvalAllTasks`), which
  :func:`return_matrix` makes a matrix of: :math:`R_{j,i}`, the return on task i after training on task j

Greater returns are better, and what is missing is NaN. "The C-CHAIN paper" is Tang et al. (ICML 2025,
https://arxiv.org/abs/2506.00592), "Continual World" Wołczyk et al. (NeurIPS 2021, https://arxiv.org/abs/2105.10919), "CORA"
Powers et al. (CoLLAs 2022, https://arxiv.org/abs/2110.10067), "GEM" Lopez-Paz and Ranzato (NeurIPS 2017,
https://arxiv.org/abs/1706.08840).
"""

from collections.abc import Mapping, Sequence
from itertools import groupby, pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating[Any]]

# --- From the returns of training ---------------------------------------------------------------------------------------


def task_curve(rows: Sequence[Mapping[str, float]], task_id: int) -> tuple[Array, Array]:
    """
    :param rows: Rows of ``returns.csv``
    :param task_id: A task
    :return: Environment steps and mean returns of its rollouts, ``(n_rollouts,)`` each
    """
    chosen = [(row["timesteps"], row["mean_return"]) for row in rows if row["task_id"] == task_id]
    steps, returns = np.array(chosen, dtype=float).reshape(-1, 2).T
    return steps, returns


def average_performance(task_averages: ArrayLike) -> float:
    r"""
    :math:`J(\mathbb{T}) = \frac{1}{k} \sum_j J(\mathcal{T}_j)`, Eq. 1 of the C-CHAIN paper.

    :param task_averages: :math:`J(\mathcal{T}_j)`, the mean return over the training on each task, ``(n_tasks,)``:
        :func:`~sb3_cchain.callbacks.task_averages`
    :return: Their mean
    """
    return float(np.mean(np.asarray(task_averages, dtype=float)))


def plasticity_gap(task_averages: ArrayLike, fresh_averages: ArrayLike) -> Array:
    r"""
    :math:`\bar J(\mathcal{T}_j) - J(\mathcal{T}_j)`, Section 3.2 of the C-CHAIN paper: how much less the agent gets on each
    task than an agent of good plasticity, such as a newly initialised one. Plasticity is lost where the gap grows from task to
    task.

    :param task_averages: :math:`J(\mathcal{T}_j)` of the agent, ``(n_tasks,)``
    :param fresh_averages: Those of an agent that begins each task with fresh networks
        (:class:`~sb3_cchain.methods.Oracle`), ``(n_tasks,)``
    :return: The gap on each task, ``(n_tasks,)``
    """
    return np.asarray(fresh_averages, dtype=float) - np.asarray(task_averages, dtype=float)


def area_under_curve(timesteps: ArrayLike, returns: ArrayLike, start: float, end: float) -> float:
    r"""
    :math:`\frac{1}{\Delta} \int_{start}^{end} p(t) \, dt`, the mean height of a learning curve (Continual World). Between two
    points the curve is straight; before the first and after the last it is level. Unlike the mean over rollouts it gives
    points weight by the time between them, which matters where episodes, not rollouts, make the points (DQN).

    :param timesteps: Environment steps, ascending, ``(n_points,)``
    :param returns: Return at each, ``(n_points,)``
    :param start: Where the task begins
    :param end: Where it ends
    :return: The area over its length; NaN without points
    """
    steps, values = np.asarray(timesteps, dtype=float), np.asarray(returns, dtype=float)
    if not len(steps):
        return float("nan")
    inside = (steps > start) & (steps < end)
    grid = np.concatenate([[start], steps[inside], [end]])
    ends = np.interp([start, end], steps, values)
    heights = np.concatenate([ends[:1], values[inside], ends[1:]])
    return float(np.sum(np.diff(grid) * (heights[1:] + heights[:-1]) / 2) / (end - start))


def forward_transfer(areas: ArrayLike, fresh_areas: ArrayLike, best: ArrayLike) -> Array:
    r"""
    :math:`FT_i = (AUC_i - AUC_i^b) / (best_i - AUC_i^b)` (Continual World): which share of what a fresh agent lacks to the
    best the agent gains by having learned the tasks before. 1 is as good as can be, 0 is as a fresh agent, less than 0 is
    worse. Continual World has success rates, whose best is 1.

    :param areas: :func:`area_under_curve` of the agent on each task, ``(n_tasks,)``
    :param fresh_areas: Those of a fresh agent that is trained on that task alone, as long, ``(n_tasks,)``
    :param best: The greatest return that there is, one number or ``(n_tasks,)``
    :return: Forward transfer to each task, ``(n_tasks,)``; NaN where the fresh agent's area is the best
    """
    fresh = np.asarray(fresh_areas, dtype=float)
    room = np.asarray(best, dtype=float) - fresh
    return (np.asarray(areas, dtype=float) - fresh) / np.where(room == 0, np.nan, room)


def recovery_times(rows: Sequence[Mapping[str, float]], window: int = 5, tolerance: float = 0.0) -> Array:
    """
    Environment steps from each switch until a rollout's mean return is again what it was at the end of the task before. It
    says something where tasks do not differ in the size of their returns.

    :param rows: Rows of ``returns.csv``
    :param window: The level to reach is the mean of so many last rollouts of the task before
    :param tolerance: How much less than that suffices
    :return: The time of each switch, ``(n_switches,)``; NaN where the level was not reached within the task
    """
    # A task that comes back has several parts
    parts = [list(part) for _, part in groupby(rows, key=lambda row: row["task_id"])]
    times = []
    for before, after in pairwise(parts):
        level = np.mean([row["mean_return"] for row in before[-window:]]) - tolerance
        reached = [row["timesteps"] for row in after if row["mean_return"] >= level]
        times.append(reached[0] - before[-1]["timesteps"] if reached else np.nan)
    return np.array(times, dtype=float)


# --- From evaluations on all tasks --------------------------------------------------------------------------------------


def return_matrix(rows: Sequence[Mapping[str, float]]) -> tuple[Array, Array]:
    """
    :param rows: Rows of ``task_returns.csv``
    :return: The returns on each task before training, ``(n_tasks,)``, and R, the returns on task i after training on task j,
        ``(n_tasks, n_tasks)``, j first. The last evaluation of each task counts; NaN where there is none
    """
    n_tasks = 1 + max((int(row["task_id"]) for row in rows), default=-1)
    before, after = np.full(n_tasks, np.nan), np.full((n_tasks, n_tasks), np.nan)
    for row in rows:
        where = before if row["timesteps"] == 0 else after[int(row["trained_task"])]
        where[int(row["task_id"])] = row["mean_return"]
    return before, after


def final_performance(after: ArrayLike) -> float:
    r"""
    :math:`P(T) = \frac{1}{N} \sum_i p_i(T)` (Continual World): the mean return on all tasks at the end.

    :param after: R, ``(n_tasks, n_tasks)``
    :return: The mean of its last row; NaN without tasks
    """
    matrix = np.asarray(after, dtype=float)
    return float(np.mean(matrix[-1])) if len(matrix) else float("nan")


def forgetting(after: ArrayLike) -> Array:
    r"""
    :math:`F_i = p_i(i \cdot \Delta) - p_i(T)` (Continual World): how much less the agent gets at the end on a task than it got
    right after the training on it. Less than 0 is better than then.

    :param after: R, ``(n_tasks, n_tasks)``
    :return: Forgetting of each task, ``(n_tasks,)``; that of the last is 0
    """
    matrix = np.asarray(after, dtype=float)
    return np.diag(matrix) - matrix[-1] if len(matrix) else np.zeros(0)


def backward_transfer(after: ArrayLike) -> float:
    r"""
    :math:`BWT = \frac{1}{N-1} \sum_{i<N} (R_{N,i} - R_{i,i})` (GEM): what later tasks did to earlier ones, on average. It is
    the mean of :func:`forgetting` over all tasks but the last, with the opposite sign.

    :param after: R, ``(n_tasks, n_tasks)``
    :return: The mean; NaN for a single task, or none
    """
    earlier = -forgetting(after)[:-1]
    return float(np.mean(earlier)) if len(earlier) else float("nan")


def zero_shot_transfer(before: ArrayLike, after: ArrayLike) -> float:
    r"""
    :math:`FWT = \frac{1}{N-1} \sum_{i>1} (R_{i-1,i} - \bar b_i)` (GEM): what the agent gets on a task just before it is
    trained on it, more than before all training.

    :param before: :math:`\bar b`, ``(n_tasks,)``
    :param after: R, ``(n_tasks, n_tasks)``
    :return: The mean; NaN for a single task
    """
    gained = np.diag(np.asarray(after, dtype=float), k=1) - np.asarray(before, dtype=float)[1:]
    return float(np.mean(gained)) if len(gained) else float("nan")


def isolated_changes(before: ArrayLike, after: ArrayLike) -> Array:
    r"""
    :math:`(r_{i,j} - r_{i,j-1}) / |r_{i,max}|` (CORA): what the training on task j alone did to the return on task i, on the
    scale of the greatest return on task i after any task.

    Its entries with j > i are CORA's *isolated forgetting* with the opposite sign, those with j < i its *isolated zero-shot
    forward transfer*; those with j = i are what the training on the task itself brought.

    :param before: The returns before training, ``(n_tasks,)``
    :param after: R, ``(n_tasks, n_tasks)``
    :return: The changes, j first, ``(n_tasks, n_tasks)``; NaN for a task whose greatest return is 0
    """
    matrix = np.asarray(after, dtype=float)
    scale = np.abs(matrix.max(axis=0))
    return np.diff(np.vstack([np.asarray(before, dtype=float), matrix]), axis=0) / np.where(scale == 0, np.nan, scale)


def isolated_forgetting(before: ArrayLike, after: ArrayLike) -> Array:
    """
    :param before: The returns before training, ``(n_tasks,)``
    :param after: R, ``(n_tasks, n_tasks)``
    :return: For each task the mean of CORA's isolated forgetting (:func:`isolated_changes`) over the tasks after it,
        ``(n_tasks,)``; NaN for the last
    """
    changes = isolated_changes(before, after)
    return np.array([-changes[i + 1 :, i].mean() if i + 1 < len(changes) else np.nan for i in range(len(changes))])


def isolated_zero_shot_transfer(before: ArrayLike, after: ArrayLike) -> Array:
    """
    :param before: The returns before training, ``(n_tasks,)``
    :param after: R, ``(n_tasks, n_tasks)``
    :return: For each task the mean of CORA's isolated zero-shot forward transfer (:func:`isolated_changes`) over the tasks
        before it, ``(n_tasks,)``; NaN for the first
    """
    changes = isolated_changes(before, after)
    return np.array([changes[:i, i].mean() if i else np.nan for i in range(len(changes))])
