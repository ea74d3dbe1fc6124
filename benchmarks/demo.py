"""
Vanilla and C-CHAIN side by side in a continual environment, the same seed and tasks, one process each. Prints a table and the
path of a picture.

    make demo
    make demo SUITE=procgen
    make demo ARGS="--seeds 0 1 2 3"
"""

import argparse
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from benchmarks.curves import plot_suite, row_of
from benchmarks.runs import complete
from benchmarks.suites import SUITES, look_at


class Demo(NamedTuple):
    """What is shown of a suite, by default."""

    env_id: str
    n_tasks: int
    steps_per_task: int
    explanation: str


DEMOS = {
    "gym_control": Demo(
        "Continual/Acrobot-v1",
        4,
        32_000,
        "After each switch the same swing-up is seen through observations with another offset. The worst return is -400.",
    ),
    "procgen": Demo(
        "Continual/Starpilot-v0",
        3,
        3000,
        "After each switch it is another level of the same game. Learning takes 100 times longer than " "this.",
    ),
    "dmc": Demo(
        "Continual/Walker-v0",
        3,
        16_384,
        "After each switch the same robot has another goal, which it is told by the rewards alone. At this length C-CHAIN's "
        "coefficient stays at its warm-up value.",
    ),
    "minatar": Demo(
        "Continual/MinAtar-v0",
        3,
        20_000,
        "After each switch it is another game. The first 10 000 actions in each are random. The returns are those of greedy "
        "evaluations. Learning takes 50 times longer than this.",
    ),
}


def main() -> None:
    """Parse the command line, train, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suite", default="gym_control", choices=list(DEMOS), help="Suite")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="Seeds of agents, and of Gym Control's offsets")
    parser.add_argument("--n-tasks", type=int, help="Length of the task sequence")
    parser.add_argument("--steps-per-task", type=int, help="Environment steps per task")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="Folder of runs and picture")
    args = parser.parse_args()

    demo, suite = DEMOS[args.suite], SUITES[args.suite]
    n_tasks, steps_per_task = args.n_tasks or demo.n_tasks, args.steps_per_task or demo.steps_per_task
    name = f"{args.suite}_{n_tasks}x{steps_per_task}"
    folder, eval_freq = args.output / name, steps_per_task // 5
    runs = [
        suite.run(algo, demo.env_id, seed, n_tasks, steps_per_task, folder / f"{algo}_seed{seed}", eval_freq)
        for seed in args.seeds
        for algo in suite.algos
    ]
    console = Console()
    console.print(f"{demo.env_id}: {n_tasks} tasks of {steps_per_task} steps. {demo.explanation}")
    complete(runs)

    tasks = [look_at(suite, runs[0], task) for task in range(n_tasks)]
    table = Table("algorithm", "seed", *(task.name for task in tasks), "J(T)", title="Average return per task")
    for run in runs:
        table.add_row(*row_of(run, suite.returns))
    table.add_row("random policy", "", *(f"{task.random_return:.1f}" for task in tasks))
    console.print(table)
    picture = args.output / f"demo_{name}_seeds_{'_'.join(map(str, args.seeds))}.png"
    plot_suite(suite, runs, picture, demo.env_id, tasks)
    console.print(f"Picture: {picture}", soft_wrap=True)


if __name__ == "__main__":
    main()
