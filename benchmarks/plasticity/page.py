"""Tables and pictures of the documentation, made from the results alone."""

from collections.abc import Sequence
from pathlib import Path

from benchmarks.grid.results import Result, read_results
from benchmarks.grid.run import short_name
from benchmarks.number_text import thousands
from benchmarks.plasticity.heat_maps import plot_heat_maps
from benchmarks.plasticity.runs import EXPERIMENT, lines, quantities
from benchmarks.report.figures import plot_quantities
from benchmarks.report.task_tables import quantities_table, seeds_text

PICTURES = "images/plasticity"


def read_groups(folder: Path) -> list[list[Result]]:
    """
    :param folder: Folder of all results
    :return: The watched runs, those of one environment and length together
    :raises ValueError: When one of them is damaged
    """
    groups: dict[tuple[str, str], list[Result]] = {}
    for experiment in sorted(folder.glob(f"{EXPERIMENT}_*")):
        results, left_out = read_results(experiment)
        if left_out:
            raise ValueError("\n".join(left_out.values()))
        for result in results:
            groups.setdefault((result.experiment, result.env_id), []).append(result)
    return list(groups.values())


def table(results: Sequence[Result]) -> str:
    """
    :param results: Runs in one environment, of one length
    :return: The mean of each quantity in each task, for each seed
    """
    suite = results[0].suite
    return quantities_table(results, lines(suite, [result.line for result in results]), quantities(suite), per_seed=True)


def section(results: Sequence[Result], docs: Path) -> str:
    """
    Draw the pictures of some runs.

    :param results: Runs in one environment, of one length
    :param docs: Folder of the documentation
    :return: A section of the page: heading, table and pictures
    """
    run = results[0]
    labels = lines(run.suite, [result.line for result in results])
    env, steps = short_name(run.env_id), thousands(run.steps_per_task)
    seeds = sorted({result.seed for result in results})
    title = f"{env}, {run.n_tasks} tasks of {steps} steps, {'seeds' if len(seeds) > 1 else 'seed'} {seeds_text(seeds)}"
    name = f"{PICTURES}/{env}_{run.n_tasks}x{run.steps_per_task}"
    parts = [f"### {env}, {run.n_tasks} × {steps} steps", table(results)]
    (docs / PICTURES).mkdir(parents=True, exist_ok=True)
    plot_quantities(results, docs / f"{name}.png", labels, quantities(run.suite), title, window=5)
    parts.append(f"![Returns, NTK, churn and dormant units over the tasks of {env}](../{name}.png)")
    if plot_heat_maps(results, labels, docs / f"{name}_ntk.png", f"NTK, {title}") is not None:
        parts.append(f"![The NTK at three times of the training on {env}](../{name}_ntk.png)")
    return "\n\n".join(parts)
