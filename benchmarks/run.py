"""
The grid of the paper: trains all methods in all environments of a suite under the shipped hyperparameters, and keeps a small
folder for each run. The same command goes on where it was interrupted.

    python -m benchmarks.run --suite gym_control --budget reduced --dry-run
    python -m benchmarks.run --suite gym_control --budget reduced
    python -m benchmarks.run --suite shelf --dry-run
    python -m benchmarks.run --suite all --address auto --gpus-per-run 0.25
"""

import argparse
import shlex
import signal
import sys
from collections import Counter
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
from rich.console import Console

from benchmarks.grid.arguments import add_gpu_argument
from benchmarks.grid.attempts import PACKAGES, newest_checkpoint
from benchmarks.grid.executor import LocalBackend, complete, ended_by_sigterm
from benchmarks.grid.plan import BUDGETS, N_SEEDS, Rates, grid_runs, shelf_runs
from benchmarks.grid.results import find_result, read_result, read_results
from benchmarks.grid.run import Run
from benchmarks.grid.score_table import score_table
from benchmarks.grid.suites import SUITES
from benchmarks.grid.view import duration
from benchmarks.number_text import thousands
from sb3_cchain.checkpoint import check_writable
from sb3_cchain.methods.registry import METHOD_NAMES


def main(arguments: Sequence[str] | None = None) -> int:
    """
    :param arguments: Arguments of the command line
    :return: Exit code: 1 when runs failed
    """
    paper_seeds = ", ".join(f"{suite.n_paper_seeds} in {name}" for name, suite in SUITES.items())
    fewer_seeds = ", ".join(f"{n} in {budget}" for budget, n in N_SEEDS.items())
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--suite",
        required=True,
        choices=[*SUITES, "shelf", "all"],
        help="Suite; shelf: all methods of PPO in the registry, in three environments at the budget reduced",
    )
    parser.add_argument("--env", nargs="+", help="Environment ids, by default all of the suite")
    parser.add_argument(
        "--method",
        nargs="+",
        help=f"Some of {', '.join(METHOD_NAMES)}, in the order in which they are to run; by default all that the paper "
        "compares in the suite. cchain@1e3 is C-CHAIN with β 1e3 in place of the shipped one, weight_clipping@0.5 weight "
        "clipping with κ 0.5, l2_init@10 L2 Init with c 10. cchain@all is C-CHAIN with each β of which the paper takes the "
        "best; weight_clipping@all and l2_init@all likewise",
    )
    parser.add_argument(
        "--seeds",
        nargs="+",
        type=int,
        help=f"Seeds, by default from 0 on as many as in the paper ({paper_seeds}); of the other budgets {fewer_seeds}",
    )
    parser.add_argument("--budget", choices=BUDGETS, help="Length of the runs, by default the paper's; reduced for the shelf")
    parser.add_argument("--dry-run", action="store_true", help="List the runs and what they will cost, and train nothing")
    parser.add_argument("--address", help="Address of a Ray cluster; by default this machine alone, without Ray")
    parser.add_argument("--cpus", type=int, help="Runs at a time on this machine, by default one per core")
    add_gpu_argument(parser)
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results"), help="Folder of the results")
    parser.add_argument("--logs", type=Path, default=Path("logs/grid"), help="Folder of the logs, on the machine of the run")
    args = parser.parse_args(arguments)
    if args.cpus is not None and (args.cpus < 1 or args.address):
        parser.error(f"--cpus must be at least 1, and goes without --address, whose nodes have their own; got {args.cpus}")

    console = Console()
    try:
        if args.suite == "shelf":
            grid = shelf_runs(args.env, args.method, args.seeds, args.budget or "reduced")
        else:
            suites = list(SUITES) if args.suite == "all" else [args.suite]
            grid = grid_runs(suites, args.env, args.method, args.seeds, args.budget or "paper")
        if args.dry_run:
            list_grid(grid, args.results, args.logs, console)
            return 0
        if all(find_result(run, args.results) for run in grid):
            console.print(f"All {len(grid)} runs are done.")
            print_scores(grid, args.results, console)
            print_versions(grid, args.results, console)
            return 0
        print_replaced(grid, args.results, console)
        backend = make_backend(args.address, args.cpus, args.gpus_per_run)
        try:
            check_writable(args.results)
        except OSError as error:
            parser.error(f"--results must be a folder that can be written to; got {args.results}: {error}")
    # An extra that is not installed, a folder or a cluster that is not there
    except (ValueError, ImportError, OSError, gym.error.Error) as error:
        parser.error(str(error))
    try:
        with ended_by_sigterm(), backend:
            failures = complete(grid, args.results, args.logs, backend, console)
    except (KeyboardInterrupt, SystemExit) as stopped:
        console.print("Interrupted. The same command goes on.")
        return 128 + (signal.SIGTERM if isinstance(stopped, SystemExit) else signal.SIGINT)
    console.print(f"{len(grid) - len(failures)} of {len(grid)} runs are done, {len(failures)} failed.")
    for failure in failures:
        console.print(str(failure), style="red", soft_wrap=True, highlight=False, markup=False)
    print_scores(grid, args.results, console)
    print_versions(grid, args.results, console)
    return 1 if failures else 0


def make_backend(address: str | None, cpus: int | None, gpus_per_run: float) -> Any:
    """
    :param address: Address of a Ray cluster, None for this machine
    :param cpus: Runs at a time on this machine, None for one per core
    :param gpus_per_run: GPUs of a run
    :return: Where the runs are executed
    """
    if address is None:
        return LocalBackend(cpus, gpus_per_run)
    from benchmarks.grid.ray_backend import RayBackend

    return RayBackend(address, gpus_per_run)


def list_grid(grid: Sequence[Run], results: Path, logs: Path, console: Console, rates_of: type[Rates] = Rates) -> None:
    """
    :param grid: Runs of the grid
    :param results: Folder of all results
    :param logs: Folder of the logs, with the checkpoints that runs go on from
    :param console: Where they are listed
    :param rates_of: Makes from the results how long the others take
    """
    rates = rates_of(read_results(results)[0])
    n_done, seconds_left = 0, 0.0
    width = max(len(run.name) for run in grid)
    for run in grid:
        if done := find_result(run, results):
            n_done += 1
            status = f"done in {duration(done.seconds)}"
        else:
            origin, _ = newest_checkpoint(run, logs)
            n_steps = 0 if origin is None else origin.num_timesteps
            seconds = rates.seconds(run) * (1 - n_steps / run.total_steps)
            seconds_left += seconds
            status = duration(seconds)
            if n_steps:
                status += f"; goes on from step {thousands(n_steps)}"
        steps = f"{run.n_tasks} x {thousands(run.steps_per_task)}"
        console.print(f"{run.name:{width}}  {steps:>14} steps  {status}", soft_wrap=True, highlight=False)
    console.print(
        f"{len(grid)} runs, {n_done} of them done. The other {len(grid) - n_done} take {duration(seconds_left)} on a core, "
        f"by the rates of the results in {results}, and where there are none by those of benchmarks/grid/suites.py.",
        soft_wrap=True,
        highlight=False,
    )
    print_replaced(grid, results, console)
    print_versions(grid, results, console)


def print_scores(grid: Sequence[Run], results: Path, console: Console) -> None:
    """
    Print what the runs that are done have reached, where their results are, and how to make the report.

    :param grid: Runs of the grid
    :param results: Folder of all results
    :param console: Where it is printed
    """
    done = [result for run in grid if (result := find_result(run, results))]
    if done:
        console.print(score_table(done))
    budgets = shlex.join(dict.fromkeys(run.experiment for run in grid))
    for line in (
        f"Results: {results}",
        f"Report:  python -m benchmarks.report --budget {budgets} --results {shlex.quote(str(results))}",
    ):
        console.print(line, soft_wrap=True, highlight=False, markup=False)


def print_replaced(grid: Sequence[Run], results: Path, console: Console) -> None:
    """
    Print which results have other hyperparameters or lengths than the runs that will take their place.

    :param grid: Runs of the grid
    :param results: Folder of all results
    :param console: Where it is printed
    """
    for run in grid:
        other = read_result(run.path_in(results))
        if other is not None and other.settings != run.settings:
            names = ", ".join(name for name, value in run.settings.items() if other.settings[name] != value)
            console.print(f"{other.path} has other {names}, and will be replaced.", soft_wrap=True, highlight=False)


def print_versions(grid: Sequence[Run], results: Path, console: Console) -> None:
    """
    Print which results were made with other versions than those installed: they count as done.

    :param grid: Runs of the grid
    :param results: Folder of all results
    :param console: Where it is printed
    """
    installed = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    made_with: Counter[str] = Counter()
    for run in grid:
        if result := find_result(run, results):
            made_with[", ".join(f"{name} {result.versions.get(name, 'unknown')}" for name in PACKAGES)] += 1
    for versions, n_results in made_with.items():
        if versions != installed:
            console.print(
                f"{n_results} of the results were made with {versions}. They count. To repeat one, delete its folder."
            )


if __name__ == "__main__":
    sys.exit(main())
