"""J(T) and cost as tables."""

from collections.abc import Callable, Mapping, Sequence
from textwrap import fill

import numpy as np

from benchmarks.grid.run import short_name
from benchmarks.report.markdown import markdown_table
from benchmarks.report.places import LINE_LENGTH
from benchmarks.report.task_tables import MISSING
from benchmarks.sensitivity.costs import BASE, Cost
from benchmarks.sensitivity.runs import PARAMETERS, Scores


def sensitivity_table(name: str, values: Scores, base: Scores, seeds: Sequence[int]) -> str:
    """
    :param name: Key of ``PARAMETERS``
    :param values: J(T) of C-CHAIN PPO, by environment and value
    :param base: J(T) of PPO
    :param seeds: Seeds that are to be run
    :return: PPO and each value: J(T) of each seed, and their mean; below, how many runs are missing
    """

    def cells(env_id: str, value: str) -> list[str]:
        scores = (base if value == BASE else values)[env_id][value]
        return [" / ".join(f"{scores[seed]:.1f}" if seed in scores else MISSING for seed in seeds), _mean(scores)]

    all_scores = [scores for table in (values, base) for of_env in table.values() for scores in of_env.values()]
    n_runs, n_done = len(all_scores) * len(seeds), sum(map(len, all_scores))
    words = f"Seeds {', '.join(map(str, seeds))}; {n_done} of {n_runs} runs are done. The others are missing ({MISSING})."
    return f"{_table(name, list(values), ('by seed', 'mean'), cells)}\n\n{fill(words, LINE_LENGTH)}"


def cost_table(name: str, env_ids: Sequence[str], costs: Mapping[str, Mapping[str, Cost]]) -> str:
    """
    :param name: Key of ``PARAMETERS``
    :param env_ids: Environments
    :param costs: Processor time, by environment and model
    :return: PPO and each value: seconds of 1000 steps, and these divided by PPO's
    """

    def cells(env_id: str, value: str) -> list[str]:
        cost = costs.get(env_id, {}).get(value)
        if cost is None:
            return [MISSING, MISSING]
        median, least, greatest = cost.ratios
        return [f"{cost.seconds:.2f}", f"{median:.2f} ({least:.2f} to {greatest:.2f})"]

    return _table(name, env_ids, ("s / 1000 steps", "time / PPO"), cells)


def _table(name: str, env_ids: Sequence[str], columns: tuple[str, str], cells: Callable[[str, str], list[str]]) -> str:
    """A row for PPO and for each value; two columns for each environment, the first of which names it."""
    header = [PARAMETERS[name].label]
    for env_id in env_ids:
        header += [f"{short_name(env_id)}, {columns[0]}", columns[1]]
    rows = []
    for value in (BASE, *PARAMETERS[name].values):
        rows.append([_row_name(name, value, env_ids), *(cell for env_id in env_ids for cell in cells(env_id, value))])
    return markdown_table(header, rows)


def _row_name(name: str, value: str, env_ids: Sequence[str]) -> str:
    if value == BASE:
        return "PPO"
    return f"{value} (shipped)" if all(PARAMETERS[name].is_shipped(value, env_id) for env_id in env_ids) else value


def _mean(scores: Mapping[int, float]) -> str:
    return f"{np.mean(list(scores.values())):.1f}" if scores else MISSING
