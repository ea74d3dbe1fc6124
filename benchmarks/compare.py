"""
Vanilla, C-CHAIN and the related methods in an environment of the paper, under the shipped hyperparameters: trains, and writes
a table and learning curves. The same command goes on where it was interrupted.

    python -m benchmarks.compare --suite gym_control --env Continual/Acrobot-v1 --n-tasks 4 --steps-per-task 64000 --seeds 0 1
    python -m benchmarks.compare --suite minatar --steps-per-task 100000 --eval-freq 10000 --seeds 0 1
"""

import argparse
from pathlib import Path

from benchmarks.curves import report
from benchmarks.runs import complete
from benchmarks.suites import SUITES, look_at


def main() -> None:
    """Parse the command line, train, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suite", required=True, choices=list(SUITES), help="Suite")
    parser.add_argument("--env", help="Environment id, by default the suite's first")
    parser.add_argument("--algo", nargs="+", help="Algorithms, by default Vanilla and C-CHAIN")
    parser.add_argument(
        "--seeds", nargs="+", type=int, default=[0, 1, 2], help="Seeds of agents, and of Gym Control's offsets"
    )
    parser.add_argument("--n-tasks", type=int, help="Length of the task sequence, by default the paper's")
    parser.add_argument("--steps-per-task", type=int, help="Environment steps per task, by default the paper's")
    parser.add_argument(
        "--eval-freq", type=int, help="MinAtar: environment steps between evaluations, by default 30 in a task"
    )
    parser.add_argument("--random-episodes", type=int, default=50, help="Episodes of the random policy in each task")
    parser.add_argument("--jobs", type=int, default=2, help="Processes at a time")
    parser.add_argument("--output", type=Path, default=Path("logs"), help="Folder of the runs")
    args = parser.parse_args()

    suite = SUITES[args.suite]
    env_id = args.env or suite.env_ids[0]
    algos = args.algo or list(suite.algos)
    if env_id not in suite.env_ids:
        parser.error(f"--env must be one of {', '.join(suite.env_ids)}; got {env_id}")
    if not set(algos) <= {*suite.algos, *suite.others}:
        parser.error(f"--algo must be of {', '.join([*suite.algos, *suite.others])}; got {' '.join(algos)}")
    length = suite.length(env_id)
    n_tasks, steps_per_task = args.n_tasks or length[0], args.steps_per_task or length[1]
    folder = args.output / args.suite / f"{env_id.replace('/', '-')}_{n_tasks}x{steps_per_task}"
    runs = [
        suite.run(algo, env_id, seed, n_tasks, steps_per_task, folder / f"{algo}_seed{seed}", args.eval_freq)
        for seed in args.seeds
        for algo in algos
    ]
    complete(runs, args.jobs)
    tasks = [look_at(suite, runs[0], task, args.random_episodes) for task in range(n_tasks)]
    report(suite, runs, folder, tasks)


if __name__ == "__main__":
    main()
