"""
PPO and C-CHAIN PPO side by side on continual Acrobot, the same seed and tasks, one process each. Prints a table and the path
of a picture.

    make demo
    make demo ARGS="--seeds 0 1 2 3"
"""

import argparse
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.gym_control import ALGOS, gym_control_run
from benchmarks.report import plot_curves, row_of
from benchmarks.runs import complete

ENV_ID = "Continual/Acrobot-v1"


def main() -> None:
    """Parse the command line, train, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="Seeds of agents and of task offsets")
    parser.add_argument("--n-tasks", type=int, default=4, help="Length of the task sequence")
    parser.add_argument("--steps-per-task", type=int, default=32_000, help="Environment steps per task")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="Folder of runs and picture")
    args = parser.parse_args()

    folder = args.output / f"{args.n_tasks}x{args.steps_per_task}"
    runs = [
        gym_control_run(algo, ENV_ID, seed, args.n_tasks, args.steps_per_task, folder) for seed in args.seeds for algo in ALGOS
    ]
    console = Console()
    console.print(
        f"{ENV_ID}: {args.n_tasks} tasks of {args.steps_per_task} steps. After each switch the same swing-up is seen through "
        "observations with another offset. The worst return is -400."
    )
    complete(runs)

    table = Table(
        "algorithm", "seed", *(f"task {task}" for task in range(args.n_tasks)), "J(T)", title="Average return per task"
    )
    for run in runs:
        table.add_row(*row_of(run))
    console.print(table)
    picture = args.output / f"demo_{args.n_tasks}x{args.steps_per_task}_seeds_{'_'.join(map(str, args.seeds))}.png"
    plot_curves(runs, picture, "Continual Acrobot")
    console.print(f"Picture: {picture}", soft_wrap=True)


if __name__ == "__main__":
    main()
