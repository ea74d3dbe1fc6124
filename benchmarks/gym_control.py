"""
Vanilla PPO and C-CHAIN on continual Gym Control: trains, and writes a table and learning curves.

    python -m benchmarks.gym_control --env Continual/Acrobot-v1 --n-tasks 4 --steps-per-task 64000 --seeds 0 1 2
"""

import argparse
from pathlib import Path

from benchmarks.report import report
from benchmarks.runs import Run, complete

ALGOS = ["ppo", "ppo_cchain"]


def gym_control_run(algo: str, env_id: str, seed: int, n_tasks: int, steps_per_task: int, folder: Path) -> Run:
    """
    :param algo: Name of the algorithm on the command line
    :param env_id: Environment id
    :param seed: Seed of the agent, and of the tasks' offsets: the algorithms meet the same tasks under the same seed
    :param n_tasks: Length of the task sequence
    :param steps_per_task: Environment steps per task
    :param folder: Parent of the run's folder
    :return: The run
    """
    env_kwargs = (f"n_tasks:{n_tasks}", f"offset_seed:{seed}")
    return Run(algo, env_id, seed, n_tasks, steps_per_task, folder / f"{algo}_seed{seed}", env_kwargs)


def main() -> None:
    """Parse the command line, train, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", required=True, help="Environment id")
    parser.add_argument("--algo", nargs="+", default=ALGOS, choices=ALGOS, help="Algorithms")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="Seeds of agents and of task offsets")
    parser.add_argument("--n-tasks", type=int, default=10, help="Length of the task sequence")
    parser.add_argument("--steps-per-task", type=int, default=160_000, help="Environment steps per task")
    parser.add_argument("--jobs", type=int, default=2, help="Processes at a time")
    parser.add_argument("--output", type=Path, default=Path("logs/gym_control"), help="Folder of the runs")
    args = parser.parse_args()

    folder = args.output / f"{args.env.replace('/', '-')}_{args.n_tasks}x{args.steps_per_task}"
    runs = [
        gym_control_run(algo, args.env, seed, args.n_tasks, args.steps_per_task, folder)
        for seed in args.seeds
        for algo in args.algo
    ]
    complete(runs, args.jobs)
    report(runs, folder, args.env)


if __name__ == "__main__":
    main()
