"""
Methods side by side in an environment of the paper, under the shipped hyperparameters: trains, and writes a table and learning
curves. The same command goes on where it was interrupted.

    python -m benchmarks.compare --suite gym_control --env Continual/Acrobot-v1 --n-tasks 4 --steps-per-task 64000 --seeds 0 1
    python -m benchmarks.compare --suite minatar --steps-per-task 100000 --eval-freq 10000 --seeds 0 1
"""

import argparse
from pathlib import Path

from benchmarks.grid.executor import train_all
from benchmarks.grid.run import make_run, suite_methods
from benchmarks.grid.suites import SUITES, check_env_id, paper_length
from benchmarks.report.comparison import write_comparison
from benchmarks.report.random_policy import look_at_task


def main() -> None:
    """Parse the command line, train, write and print the tables and the curves."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suite", required=True, choices=list(SUITES), help="Suite")
    parser.add_argument("--env", help="Environment id, by default the suite's first")
    parser.add_argument("--method", nargs="+", default=["vanilla", "cchain"], help="Methods, by default Vanilla and C-CHAIN")
    parser.add_argument(
        "--seeds", nargs="+", type=int, default=[0, 1, 2], help="Seeds of agents, and of Gym Control's offsets"
    )
    parser.add_argument("--n-tasks", type=int, help="Length of the task sequence, by default the paper's")
    parser.add_argument("--steps-per-task", type=int, help="Environment steps per task, by default the paper's")
    parser.add_argument(
        "--eval-freq",
        type=int,
        help="MinAtar, DeepMind Control: environment steps between evaluations, by default the paper's",
    )
    parser.add_argument("--random-episodes", type=int, default=50, help="Episodes of the random policy in each task")
    parser.add_argument("--jobs", type=int, default=2, help="Processes at a time")
    parser.add_argument("--output", type=Path, default=Path("logs"), help="Folder of the results and logs")
    args = parser.parse_args()

    env_id = args.env or SUITES[args.suite].env_ids[0]
    try:
        check_env_id(args.suite, env_id)
        n_tasks, steps = paper_length(env_id)
        n_tasks = n_tasks if args.n_tasks is None else args.n_tasks
        steps = steps if args.steps_per_task is None else args.steps_per_task
        experiment = f"compare_{n_tasks}x{steps}"
        runs = [
            make_run(args.suite, env_id, method, seed, n_tasks, steps, experiment, args.eval_freq)
            for seed in args.seeds
            for method in args.method
        ]
    except (ValueError, ImportError) as error:
        parser.error(str(error))
    results = train_all(runs, args.output, args.jobs)

    looks = [look_at_task(runs[0], task, args.random_episodes) for task in range(n_tasks)]
    write_comparison(results, suite_methods(args.suite), looks)


if __name__ == "__main__":
    main()
