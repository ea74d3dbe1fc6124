"""
How churn, the neural tangent kernel (NTK) and the networks develop over the tasks: of PPO, TRAC and C-CHAIN, and of C-CHAIN
with one component of its gradient alone (the figures and the ablation of Section 5.2 of the paper). Trains with the monitors.
The same command goes on where it was interrupted.

    python -m benchmarks.plasticity                                               # Acrobot at the budget reduced
    python -m benchmarks.plasticity --suite procgen --env Continual/Starpilot-v0 Continual/Chaser-v0 --budget paper --dry-run
    python -m benchmarks.plasticity --suite minatar --method vanilla cchain --steps-per-task 50000 --seeds 0 1
    python -m benchmarks.plasticity --write         # trains nothing; all tables and pictures, into the documentation
"""

import argparse
from collections.abc import Sequence

from rich.console import Console

from benchmarks.grid.arguments import add_folder_arguments, add_gpu_argument
from benchmarks.grid.executor import train_all
from benchmarks.grid.plan import BUDGETS, run_length
from benchmarks.grid.results import find_result
from benchmarks.grid.run import Run
from benchmarks.grid.suites import SUITES
from benchmarks.plasticity.page import read_groups, section, table
from benchmarks.plasticity.rates import WatchedRates
from benchmarks.plasticity.runs import COMPONENTS, default_names, watched_run
from benchmarks.plasticity.snapshots import keep_snapshots
from benchmarks.report.places import write_tables
from benchmarks.run import list_grid


def main(arguments: Sequence[str] | None = None) -> None:
    """
    :param arguments: Arguments of the command line
    """
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.plasticity", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--suite", default="gym_control", choices=list(SUITES), help="Suite of the environments")
    parser.add_argument("--env", nargs="+", help="Environment ids, by default the one that the demo shows")
    parser.add_argument(
        "--method",
        nargs="+",
        help=f"Methods of the suite, and {', '.join(COMPONENTS)} for C-CHAIN with one component of its gradient; by default "
        "all that the paper's analysis compares",
    )
    parser.add_argument("--budget", default="reduced", choices=BUDGETS, help="Length of the runs, as of benchmarks.run")
    parser.add_argument("--n-tasks", type=int, help="Length of the task sequence, by default the budget's")
    parser.add_argument("--steps-per-task", type=int, help="Environment steps per task, by default the budget's")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1], help="Seeds of agents, and of Gym Control's offsets")
    parser.add_argument("--jobs", type=int, default=1, help="Runs at a time")
    add_gpu_argument(parser)
    parser.add_argument("--dry-run", action="store_true", help="List the runs and what they will cost, and train nothing")
    parser.add_argument(
        "--write", action="store_true", help="Put all tables and pictures into the documentation, train nothing"
    )
    add_folder_arguments(parser, logs="logs/plasticity")
    args = parser.parse_args(arguments)

    if args.write:
        sections = [section(results, args.docs) for results in read_groups(args.results)]
        write_tables({"plasticity": "\n\n".join(sections)}, args.docs)
        return
    try:
        runs = chosen_runs(args)
    except (ValueError, ImportError) as error:
        parser.error(str(error))
    if args.dry_run:
        list_grid(runs, args.results, args.logs, Console(), WatchedRates)
        return
    try:
        results = train_all(runs, args.results, args.jobs, args.logs, args.gpus_per_run)
    finally:  # also when only some of them were done before it was interrupted
        for result in filter(None, (find_result(run, args.results) for run in runs)):
            keep_snapshots(result, args.logs)
    for env_id in dict.fromkeys(run.env_id for run in runs):
        print(f"\n{env_id}\n\n{table([result for result in results if result.env_id == env_id])}")
    print(f"\nResults: {args.results}. Pictures: python -m benchmarks.plasticity --write")


def chosen_runs(args: argparse.Namespace) -> list[Run]:
    """
    :param args: The command line
    :return: Its runs: all methods of a seed, then the next seed
    :raises ValueError: As :func:`~benchmarks.plasticity.runs.watched_run`
    """
    runs = []
    for seed in args.seeds:
        for env_id in args.env or [SUITES[args.suite].demo.env_id]:
            if env_id not in SUITES[args.suite].env_ids:
                raise ValueError(f"--env must be one of {', '.join(SUITES[args.suite].env_ids)}; got {env_id}")
            n_tasks, steps = run_length(args.suite, env_id, args.budget)
            length = (
                n_tasks if args.n_tasks is None else args.n_tasks,
                steps if args.steps_per_task is None else args.steps_per_task,
            )
            for name in args.method or default_names(args.suite, env_id):
                runs.append(watched_run(args.suite, name, env_id, seed, *length))
    return runs


if __name__ == "__main__":
    main()
