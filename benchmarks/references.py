"""
C-CHAIN with other reference batches (``churn_reference``, ``churn_batch_size``), under the shipped hyperparameters otherwise:
trains, and writes a table and learning curves for each environment. The same command goes on where it was interrupted.

    python -m benchmarks.references --n-tasks 4 --steps-per-task 64000 --seeds 0 1 2 3
    python -m benchmarks.references --suite minatar --variants independent next --n-tasks 1 --steps-per-task 20000
"""

import argparse
from dataclasses import replace
from pathlib import Path

from benchmarks.grid.executor import train_all
from benchmarks.grid.run import Run, make_run, suite_methods
from benchmarks.report.comparison import write_comparison

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


def main() -> None:
    """Parse the command line, train, write and print the tables and the curves."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suite", default="gym_control", choices=list(ENVIRONMENTS), help="Suite of the environments")
    parser.add_argument("--env", nargs="+", help="Environment ids")
    parser.add_argument("--variants", nargs="+", default=list(LINES), choices=list(LINES), help="What is compared")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3], help="Seeds of agents and of the offsets")
    parser.add_argument("--n-tasks", type=int, default=4, help="Length of the task sequence")
    parser.add_argument("--steps-per-task", type=int, default=64_000, help="Environment steps per task")
    parser.add_argument("--jobs", type=int, default=2, help="Processes at a time")
    parser.add_argument("--output", type=Path, default=Path("logs"), help="Folder of the results and logs")
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
        write_comparison([result for result in results if result.env_id == env_id], LINES)


if __name__ == "__main__":
    main()
