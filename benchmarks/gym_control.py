"""
Vanilla PPO and C-CHAIN on continual Gym Control: trains, and writes a table and learning curves.

    python -m benchmarks.gym_control --env Continual/Acrobot-v1 --n-tasks 4 --steps-per-task 64000 --seeds 0 1 2
"""

import argparse
from pathlib import Path

from benchmarks.report import LABELS, markdown_table, plot_curves
from benchmarks.runs import Run, complete


def main() -> None:
    """Parse the command line, train, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", required=True, help="Environment id")
    parser.add_argument("--algo", nargs="+", default=list(LABELS), choices=list(LABELS), help="Algorithms")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="Seeds of agents and of task offsets")
    parser.add_argument("--n-tasks", type=int, default=10, help="Length of the task sequence")
    parser.add_argument("--steps-per-task", type=int, default=160_000, help="Environment steps per task")
    parser.add_argument("--jobs", type=int, default=2, help="Processes at a time")
    parser.add_argument("--output", type=Path, default=Path("logs/gym_control"), help="Folder of the runs")
    args = parser.parse_args()

    folder = args.output / f"{args.env.replace('/', '-')}_{args.n_tasks}x{args.steps_per_task}"
    runs = [
        Run(algo, args.env, seed, args.n_tasks, args.steps_per_task, folder / f"{algo}_seed{seed}")
        for seed in args.seeds
        for algo in args.algo
    ]
    complete(runs, args.jobs)

    runs.sort(key=lambda run: (list(LABELS).index(run.algo), run.seed))
    (folder / "table.md").write_text(markdown_table(runs) + "\n")
    plot_curves(runs, folder / "curves.png", args.env)
    print((folder / "table.md").read_text())
    print(f"Written: {folder}/table.md, {folder}/curves.png")


if __name__ == "__main__":
    main()
