"""
The grid of the paper: trains all methods in all environments of a suite under the shipped hyperparameters, and keeps a small
folder of each run. The same command goes on where it was interrupted.

    python -m benchmarks.run --suite gym_control --budget reduced --dry-run
    python -m benchmarks.run --suite gym_control --budget reduced
    python -m benchmarks.run --suite all --address auto --gpus-per-run 0.25
"""

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import gymnasium as gym
from rich.console import Console

from benchmarks.grid import BUDGETS, GridRun, Rates, grid_runs
from benchmarks.grid_view import duration
from benchmarks.results import METHODS, read_result, read_results
from benchmarks.runs import PACKAGES
from benchmarks.scheduler import complete_grid, connect, import_ray
from benchmarks.suites import SUITES


def main(arguments: Sequence[str] | None = None) -> int:
    """
    :param arguments: Of the command line
    :return: Exit code: 1 when runs failed
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--suite", required=True, choices=[*SUITES, "all"], help="Suite")
    parser.add_argument("--env", nargs="+", help="Environment ids, by default all of the suite")
    parser.add_argument(
        "--method",
        nargs="+",
        help=f"Of {', '.join(METHODS)}, in the order in which they are to run; by default all that the paper compares",
    )
    parser.add_argument(
        "--seeds", type=int, help="Number of seeds; by default the paper's, 6, or 12 in dmc and minatar; reduced: 3, smoke: 1"
    )
    parser.add_argument("--budget", default="paper", choices=BUDGETS, help="Length of the runs")
    parser.add_argument("--dry-run", action="store_true", help="List the runs and what they will cost, and train nothing")
    parser.add_argument("--address", help="Address of a Ray cluster, by default this machine alone")
    parser.add_argument("--cpus", type=int, help="Runs at a time on this machine, by default one per core")
    parser.add_argument("--gpus-per-run", type=float, default=0.0, help="GPUs of a run, e.g. 0.25; by default none is used")
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results"), help="Folder of the results")
    parser.add_argument("--logs", type=Path, default=Path("logs/grid"), help="Folder of the logs, on the machine of the run")
    args = parser.parse_args(arguments)
    # As Ray divides them
    if not (0.0001 <= args.gpus_per_run <= 1 or (args.gpus_per_run >= 0 and args.gpus_per_run.is_integer())):
        parser.error(f"--gpus-per-run must be from 0.0001 to 1, or a whole number; got {args.gpus_per_run}")
    if args.cpus is not None and (args.cpus < 1 or args.address):
        parser.error(f"--cpus must be at least 1, and goes without --address, whose nodes have their own; got {args.cpus}")

    console = Console()
    try:
        grid = grid_runs(list(SUITES) if args.suite == "all" else [args.suite], args.env, args.method, args.seeds, args.budget)
        if args.dry_run:
            list_grid(grid, args.results, console)
            return 0
        if all(run.result(args.results) for run in grid):
            console.print(f"All {len(grid)} runs are done. Results: {args.results}")
            note_versions(grid, args.results, console)
            return 0
        note_replaced(grid, args.results, console)
        ray = import_ray()
        check_writable(args.results)
        connect(ray, args.address, args.cpus, args.gpus_per_run)
    # An extra that is not installed, a folder or a cluster that is not there, too
    except (ValueError, ImportError, OSError, gym.error.Error) as error:
        parser.error(str(error))
    try:
        failures = complete_grid(ray, grid, args.results, args.logs, args.gpus_per_run, console)
    except KeyboardInterrupt:
        console.print("Interrupted. The same command goes on.")
        return 130
    finally:
        ray.shutdown()
    console.print(f"{len(grid) - len(failures)} of {len(grid)} runs are done, {len(failures)} failed. Results: {args.results}")
    for failure in failures:
        console.print(str(failure), style="red", soft_wrap=True, highlight=False, markup=False)
    note_versions(grid, args.results, console)
    return 1 if failures else 0


def list_grid(grid: Sequence[GridRun], results: Path, console: Console) -> None:
    """
    :param grid: Runs of the grid
    :param results: Folder of all results
    :param console: Where they are listed
    """
    rates = Rates(read_results(results))
    counts: Counter[str] = Counter()
    left = 0.0
    width = max(len(run.name) for run in grid)
    for run in grid:
        done = run.result(results)
        counts["done" if done else "left"] += 1
        left += 0.0 if done else rates.seconds(run)
        status = f"done in {duration(done.seconds)}" if done else f"{duration(rates.seconds(run))}"
        steps = f"{run.n_tasks} x {run.steps_per_task:,}".replace(",", " ")
        console.print(f"{run.name:{width}}  {steps:>14} steps  {status}", soft_wrap=True, highlight=False)
    console.print(
        f"{len(grid)} runs, {counts['done']} of them done. The other {counts['left']} take {duration(left)} on a core, "
        f"by the rates of the results in {results}, and where there are none by those of benchmarks/grid.py.",
        soft_wrap=True,
        highlight=False,
    )
    note_replaced(grid, results, console)
    note_versions(grid, results, console)


def check_writable(folder: Path) -> None:
    """
    :param folder: Folder of all results, which is made where it is missing
    :raises ValueError: When nothing can be written there, which a run should not come to its end to find out
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise ValueError(f"--results must be a folder that can be written to; got {folder}: {error}") from error


def note_replaced(grid: Sequence[GridRun], results: Path, console: Console) -> None:
    """
    Say which results are of other hyperparameters or lengths than the runs that will take their place.

    :param grid: Runs of the grid
    :param results: Folder of all results
    :param console: Where to
    """
    for run in grid:
        if run.result(results) is None and (other := read_result(run.path(results))) is not None:
            names = ", ".join(name for name, value in run.settings.items() if other.settings[name] != value)
            console.print(f"{other.path} is of other {names}, and will be replaced.", soft_wrap=True, highlight=False)


def note_versions(grid: Sequence[GridRun], results: Path, console: Console) -> None:
    """
    Say which results were made with other versions than are installed: they count as done.

    :param grid: Runs of the grid
    :param results: Folder of all results
    :param console: Where to
    """
    installed = {name: version(name) for name in PACKAGES}
    made_with: Counter[str] = Counter()
    for run in grid:
        if result := run.result(results):
            made_with[", ".join(f"{name} {result.versions[name]}" for name in PACKAGES)] += 1
    for versions, n_results in made_with.items():
        if versions != ", ".join(f"{name} {installed[name]}" for name in PACKAGES):
            console.print(f"{n_results} of the results are of {versions}. They count; to repeat one delete its folder.")


if __name__ == "__main__":
    sys.exit(main())
