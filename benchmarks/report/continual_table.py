"""The table of what continual RL reports besides J(T): plasticity, forward transfer, recovery after a switch, forgetting."""

from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks.grid.results import Result
from benchmarks.report.markdown import markdown_table
from benchmarks.report.task_tables import MISSING, seeds_text
from sb3_cchain.analysis.metrics.continual import area_under_curve, forward_transfer, plasticity_gap, recovery_times
from sb3_cchain.methods.registry import Method

FORGETTING = "continual_eval/forgetting"
HEADER = ["method", "seeds", "gap, first task", "gap, last task", "forward transfer", "recovered", "steps to recover"]

WORDS = """\
Means over the seeds. The **gap** of a task is J(T_i) of the Oracle, whose networks are fresh in each task, minus J(T_i) of
the method (Section 3.2 of the paper): a gap that grows is plasticity lost. It and forward transfer are of the seeds that the
Oracle has, too, because the seed may draw the tasks. **Forward transfer** is the share of what the
Oracle lacks to the best, as areas under the learning curves, that the method gains, mean over the tasks from the second on
(Wołczyk et al., 2021; the best is the highest return of a rollout in that task by any run here): less than 0 is worse than
fresh networks. **Recovered** counts the switches after which a rollout's mean return reached that of the last five rollouts of
the task before, and **steps to recover** is the median of the time that it took; after a task in which the agent collapsed,
that level is low and soon reached. **Forgetting**, where runs evaluated on all tasks, is the mean over the tasks before the
last of the return right after the task, minus that at the end."""


def continual_table(results: Sequence[Result], lines: Mapping[str, Method], digits: int, own_scales: bool) -> str:
    """
    :param results: Runs in one environment, of one length
    :param lines: Label of each method or variant, in their order
    :param digits: Digits of returns after the point
    :param own_scales: Whether tasks differ in the size of their returns, so that there is no level to recover to
    :return: A row for each method; what needs the Oracle is missing without its runs
    """
    fresh = {run.seed: run for run in results if run.method == "oracle"}
    best = [
        max((max(run.returns_in_task(task)[1], default=-np.inf) for run in results), default=np.nan)
        for task in range(results[0].n_tasks)
    ]
    with_forgetting = any(FORGETTING in run.metrics for run in results)
    rows = []
    for line, method in lines.items():
        runs = [run for run in results if run.line == line]
        if not runs:
            continue
        cells = [method.label, seeds_text(sorted(run.seed for run in runs)), *[MISSING] * 5]
        if runs[0].method != "oracle" and (paired := [run for run in runs if run.seed in fresh]):
            oracles = [fresh[run.seed] for run in paired]
            gap = plasticity_gap(_averages(paired), _averages(oracles))
            transfer = forward_transfer(_areas(paired), _areas(oracles), best)[1:]
            cells[2:5] = [
                _text(gap[0], digits),
                _text(gap[-1], digits),
                _text(np.mean(transfer) if len(transfer) else np.nan, 2),
            ]
        if not own_scales:
            times = np.concatenate([recovery_times(run.returns) for run in runs])
            recovered = times[~np.isnan(times)]
            if len(times):
                cells[5] = f"{len(recovered)} of {len(times)}"
                cells[6] = f"{np.median(recovered):,.0f}" if len(recovered) else MISSING
        if with_forgetting:
            last = [run.metrics[FORGETTING][-1][1] for run in runs if FORGETTING in run.metrics]
            cells.append(_text(np.mean(last) if last else np.nan, digits))
        rows.append(cells)
    return markdown_table([*HEADER, "forgetting"] if with_forgetting else HEADER, rows)


def _averages(runs: Sequence[Result]) -> np.ndarray:
    """J(T_i) of each task, mean over the runs."""
    return np.mean([run.task_averages() for run in runs], axis=0)


def _areas(runs: Sequence[Result]) -> np.ndarray:
    """The area under the learning curve of each task, mean over the runs."""
    areas = []
    for run in runs:
        ends = [0, *run.task_boundaries]
        areas.append([area_under_curve(*run.returns_in_task(task), ends[task], ends[task + 1]) for task in range(run.n_tasks)])
    return np.mean(areas, axis=0)


def _text(value: float | np.floating, digits: int) -> str:
    # Without the sign of -0.00
    return MISSING if np.isnan(value) else f"{round(float(value), digits) + 0.0:.{digits}f}"
