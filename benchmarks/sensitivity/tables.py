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


def sensitivity_table(
    name: str, values: Scores, base: Scores, seeds: Sequence[int], costs: Mapping[str, Mapping[str, Cost]]
) -> str:
    """
    :param name: Key of ``PARAMETERS``
    :param values: J(T) of C-CHAIN PPO, by environment and value
    :param base: J(T) of PPO
    :param seeds: Seeds that are to be run
    :param costs: Processor time, by environment and model; empty where it does not depend on the parameter
    :return: PPO and each value: J(T) of each seed, their mean, and the cost; below, how many runs are missing
    """
    parameter = PARAMETERS[name]
    header = [parameter.label]
    for env_id in values:
        header += [f"{short_name(env_id)}, by seed", "mean"]
        if costs:
            header += ["s / 1000 steps", "time / PPO"]
    rows = []
    for value in (BASE, *parameter.values):
        shipped = value != BASE and all(parameter.is_shipped(value, env_id) for env_id in values)
        row = ["PPO" if value == BASE else f"{value} (shipped)" if shipped else value]
        for env_id in values:
            scores = (base if value == BASE else values)[env_id][value]
            row += [" / ".join(f"{scores[seed]:.1f}" if seed in scores else MISSING for seed in seeds), _mean(scores)]
            if costs:
                row += _cost_cells(costs.get(env_id, {}).get(value))
        rows.append(row)
    cells = [scores for table in (values, base) for of_env in table.values() for scores in of_env.values()]
    n_runs, n_done = len(cells) * len(seeds), sum(map(len, cells))
    words = f"Seeds {', '.join(map(str, seeds))}; {n_done} of {n_runs} runs are done. The others are missing ({MISSING})."
    return f"{markdown_table(header, rows)}\n\n{fill(words, LINE_LENGTH)}"


def _mean(scores: Mapping[int, float]) -> str:
    return f"{np.mean(list(scores.values())):.1f}" if scores else MISSING


def _cost_cells(cost: Cost | None) -> list[str]:
    if cost is None:
        return [MISSING, MISSING]
    median, least, greatest = cost.ratios
    return [f"{cost.seconds:.2f}", f"{median:.2f} ({least:.2f} to {greatest:.2f})"]
