"""
Vanilla and C-CHAIN side by side in a continual environment, with the same seed and tasks, one process each. Prints a table and
the path of a picture.

    make demo
    make demo SUITE=procgen
    make demo ARGS="--seeds 0 1 2 3"
"""

import argparse
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.grid.executor import train_all
from benchmarks.grid.run import make_run, suite_methods
from benchmarks.grid.suites import SUITES
from benchmarks.report.figures import plot_learning_curves
from benchmarks.report.random_policy import look_at_task
from benchmarks.report.task_tables import average_cells, returns_header, returns_rows


def main() -> None:
    """Parse the command line, train, show the table and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suite", default="gym_control", choices=list(SUITES), help="Suite")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="Seeds of agents, and of Gym Control's offsets")
    parser.add_argument("--n-tasks", type=int, help="Length of the task sequence")
    parser.add_argument("--steps-per-task", type=int, help="Environment steps per task")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="Folder of the results, logs and picture")
    args = parser.parse_args()

    demo = SUITES[args.suite].demo
    n_tasks = demo.n_tasks if args.n_tasks is None else args.n_tasks
    steps = demo.steps_per_task if args.steps_per_task is None else args.steps_per_task
    try:
        runs = [
            make_run(args.suite, demo.env_id, method, seed, n_tasks, steps, f"demo_{n_tasks}x{steps}", steps // 5)
            for seed in args.seeds
            for method in ("vanilla", "cchain")
        ]
    except (ValueError, ImportError) as error:
        parser.error(str(error))
    console = Console()
    console.print(f"{demo.env_id}: {n_tasks} tasks of {steps} steps. {demo.explanation}")
    results = train_all(runs, args.output)

    lines = suite_methods(args.suite)
    looks = [look_at_task(runs[0], task) for task in range(n_tasks)]
    table = Table(*returns_header(results[0].task_names), title="Average return per task")
    for row in returns_rows(results, lines):
        table.add_row(*row)
    table.add_row("random policy", "", *average_cells([look.random_return for look in looks]))
    console.print(table)
    seeds = "_".join(map(str, args.seeds))
    picture = args.output / f"demo_{args.suite}_{n_tasks}x{steps}_seeds_{seeds}.png"
    plot_learning_curves(results, picture, lines, demo.env_id, looks)
    console.print(f"Picture: {picture}", soft_wrap=True)


if __name__ == "__main__":
    main()
