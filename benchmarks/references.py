"""
C-CHAIN with other reference batches (``churn_reference``, ``churn_batch_size``), under the shipped hyperparameters otherwise:
trains, and writes a table and learning curves for each environment. The same command goes on where it was interrupted.

    python -m benchmarks.references --n-tasks 4 --steps-per-task 64000 --seeds 0 1 2 3
    python -m benchmarks.references --suite minatar --variants independent next --n-tasks 1 --steps-per-task 20000
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace

from benchmarks.grid.arguments import add_variant_arguments
from benchmarks.grid.executor import train_all
from benchmarks.grid.results import Result
from benchmarks.grid.run import Run, make_run, suite_methods
from benchmarks.report.figures import plot_learning_curves
from benchmarks.report.markdown import markdown_table
from benchmarks.report.task_tables import cost_table, mean_rows, returns_header, returns_rows

# The suites whose algorithms have the argument, and the environments that are trained in by default
ENVIRONMENTS = {"gym_control": ["Continual/Acrobot-v1", "Continual/LunarLander-v3"], "minatar": ["Continual/MinAtar-v0"]}
CCHAIN = suite_methods("gym_control")["cchain"]

# What is compared: label and colour of each, and how it differs from the shipped hyperparameters
LINES = {
    "independent": replace(CCHAIN, label="independent"),
    "next": replace(CCHAIN, label="next", color="tab:orange"),
    "half": replace(CCHAIN, label="independent, half the size", color="tab:green"),
}
OVERRIDES = {"independent": (), "next": ("churn_reference:'next'",), "half": ("churn_batch_size:0.5",)}


def variant_run(suite: str, name: str, env_id: str, seed: int, n_tasks: int, steps: int) -> Run:
    """
    :param suite: One of ``ENVIRONMENTS``
    :param name: One of ``LINES``; DQN has no other sizes
    :param env_id: Environment id
    :param seed: Seed
    :param n_tasks: Length of the task sequence
    :param steps: Environment steps per task
    :return: The run
    :raises ValueError: As :func:`~benchmarks.grid.run.make_run`, and for another size in DQN
    """
    if suite == "minatar" and name == "half":
        raise ValueError("--variants must be independent or next in minatar, where the reference batch has one size; got half")
    run = make_run(suite, env_id, CCHAIN.name, seed, n_tasks, steps, f"references_{n_tasks}x{steps}")
    return replace(run, variant=name, overrides=OVERRIDES[name])


def write_report(results: Sequence[Result]) -> None:
    """
    Write ``table.md`` and ``curves.png`` beside the runs, and print the table.

    :param results: All runs in one environment
    """
    rows = [*returns_rows(results, LINES), *mean_rows(results, LINES)]
    tables = f"{markdown_table(returns_header(results[0].task_names), rows)}\n\n{cost_table(results, LINES)}"
    folder = results[0].path.parents[1]
    (folder / "table.md").write_text(tables + "\n")
    plot_learning_curves(results, folder / "curves.png", LINES, results[0].env_id)
    print(f"{tables}\n\nWritten: {folder}/table.md, {folder}/curves.png")


def main() -> None:
    """Parse the command line, train, write and print the tables and the curves."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suite", default="gym_control", choices=list(ENVIRONMENTS), help="Suite of the environments")
    parser.add_argument("--env", nargs="+", help="Environment ids")
    add_variant_arguments(parser, LINES, seeds=[0, 1, 2, 3], n_tasks=4, steps_per_task=64_000)
    args = parser.parse_args()
    env_ids = args.env or ENVIRONMENTS[args.suite]

    try:
        runs = [
            variant_run(args.suite, name, env_id, seed, args.n_tasks, args.steps_per_task)
            for seed in args.seeds
            for env_id in env_ids
            for name in args.variants
        ]
    except (ValueError, ImportError) as error:
        parser.error(str(error))
    results = train_all(runs, args.output, args.jobs)
    for env_id in env_ids:
        write_report([result for result in results if result.env_id == env_id])


if __name__ == "__main__":
    main()
