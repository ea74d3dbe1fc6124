"""J(T) and cost as tables."""

from collections.abc import Mapping, Sequence
from textwrap import fill

import numpy as np

from benchmarks.grid.run import short_name
from benchmarks.report.markdown import markdown_table
from benchmarks.report.task_tables import MISSING
from benchmarks.sensitivity.costs import BASE, Cost
from benchmarks.sensitivity.runs import PARAMETERS, Scores
from benchmarks.speed.tables import LINE_LENGTH


def sensitivity_table(name: str, values: Scores, base: Scores, seeds: Sequence[int]) -> str:
    """
    :param name: Key of ``PARAMETERS``
    :param values: J(T) of C-CHAIN PPO, by environment and value
    :param base: J(T) of PPO
    :param seeds: Seeds that are to be run
    :return: PPO and each value: J(T) of each seed, and their mean; below, how many runs are missing
    """
    parameter = PARAMETERS[name]
    header = [parameter.label]
    for env_id in values:
        header += [f"{short_name(env_id)}, by seed", "mean"]
    rows = []
    for value in (BASE, *parameter.values):
        row = [_row_name(name, value, list(values))]
        for env_id in values:
            scores = (base if value == BASE else values)[env_id][value]
            row += [" / ".join(f"{scores[seed]:.1f}" if seed in scores else MISSING for seed in seeds), _mean(scores)]
        rows.append(row)
    cells = [scores for table in (values, base) for of_env in table.values() for scores in of_env.values()]
    n_runs, n_done = len(cells) * len(seeds), sum(map(len, cells))
    words = f"Seeds {', '.join(map(str, seeds))}; {n_done} of {n_runs} runs are done. The others are missing ({MISSING})."
    return f"{markdown_table(header, rows)}\n\n{fill(words, LINE_LENGTH)}"


def cost_table(name: str, env_ids: Sequence[str], costs: Mapping[str, Mapping[str, Cost]]) -> str:
    """
    :param name: Key of ``PARAMETERS``
    :param env_ids: Environments
    :param costs: Processor time, by environment and model
    :return: PPO and each value: seconds of 1000 steps, and these divided by PPO's
    """
    parameter = PARAMETERS[name]
    header = [parameter.label]
    for env_id in env_ids:
        header += [f"{short_name(env_id)}, s / 1000 steps", "time / PPO"]
    rows = []
    for value in (BASE, *parameter.values):
        row = [_row_name(name, value, env_ids)]
        for env_id in env_ids:
            row += _cost_cells(costs.get(env_id, {}).get(value))
        rows.append(row)
    return markdown_table(header, rows)


def _row_name(name: str, value: str, env_ids: Sequence[str]) -> str:
    if value == BASE:
        return "PPO"
    return f"{value} (shipped)" if all(PARAMETERS[name].is_shipped(value, env_id) for env_id in env_ids) else value


def _mean(scores: Mapping[int, float]) -> str:
    return f"{np.mean(list(scores.values())):.1f}" if scores else MISSING


def _cost_cells(cost: Cost | None) -> list[str]:
    if cost is None:
        return [MISSING, MISSING]
    median, least, greatest = cost.ratios
    return [f"{cost.seconds:.2f}", f"{median:.2f} ({least:.2f} to {greatest:.2f})"]
