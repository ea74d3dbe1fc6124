"""
Continual supervised learning, as in Appendix A.4 of the C-CHAIN paper: Permuted-MNIST and RandomLabel-MNIST, learned by
Vanilla, C-CHAIN, L2 Init and weight clipping. Tasks that are done are not learned again; the same command goes on.

    python -m benchmarks.supervised --dry-run                               # the runs, and how long they take
    python -m benchmarks.supervised --data FOLDER                           # everything, at the paper's length
    python -m benchmarks.supervised --problem permuted_mnist --method vanilla cchain --seeds 0 --tasks 100
    python -m benchmarks.supervised --write                                 # trains nothing; tables and picture
"""

import argparse
from collections.abc import Sequence

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bars
from rich.table import Table

from benchmarks.grid.arguments import add_folder_arguments
from benchmarks.report.places import write_tables
from benchmarks.supervised.images import Images, load_images
from benchmarks.supervised.learner import METHODS, OPTIMIZERS, Settings
from benchmarks.supervised.picture import plot
from benchmarks.supervised.tables import read_results, results_table
from benchmarks.supervised.tasks import PROBLEMS
from benchmarks.supervised.training import Progress, Run, check_settings, check_state, n_done, train, updates_per_second
from sb3_cchain.validation import check_number

PICTURE = "images/supervised.png"


def main(arguments: Sequence[str] | None = None) -> None:
    """
    :param arguments: Arguments of the command line
    """
    parser = _parser()
    args = parser.parse_args(arguments)
    if not args.write:
        try:
            runs = make_runs(args)
            images = load_images(args.data)
            for run in runs:
                check_settings(run, images)
                check_state(run, length(run, args.tasks))
        except (ImportError, ValueError) as error:
            parser.error(str(error))
        if args.dry_run:
            show(runs, images, args.tasks)
            return
        train_all(runs, images, args.tasks)
    problems = {name: read_results(args.results, name) for name in PROBLEMS}
    tables = {f"supervised_{name}": results_table(name, results) for name, results in problems.items()}
    if args.write:
        plot(problems, args.docs / PICTURE)
        write_tables(tables, args.docs)
    else:
        print(*(f"\n{PROBLEMS[name].title}\n\n{tables[f'supervised_{name}']}" for name in args.problem), sep="\n")


def _parser() -> argparse.ArgumentParser:
    defaults = Settings()
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.supervised", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--problem", nargs="+", choices=list(PROBLEMS), default=list(PROBLEMS), help="By default both")
    add("--method", nargs="+", choices=list(METHODS), default=list(METHODS), help="By default all")
    add("--seeds", nargs="+", type=int, default=[0, 1, 2], help="By default 0 1 2")
    add("--tasks", type=int, help="Learn only the first tasks; the same command with more of them goes on from there")
    add("--images", type=int, help="Images of a task, by default the paper's")
    add("--epochs", type=int, help="Passes through the images of a task, by default the paper's")
    add(
        "--data",
        metavar="FOLDER|mnist|digits",
        help="Folder with MNIST's IDX files; MNIST by torchvision; or the digits of scikit-learn. By default the second where "
        "torchvision is installed, the third otherwise",
    )
    add("--optimizer", choices=list(OPTIMIZERS), default=defaults.optimizer, help="By default Adam")
    add("--learning-rate", type=float, default=defaults.learning_rate, help="By default %(default)g")
    add("--target-churn-ratio", type=float, default=defaults.target_churn_ratio, help="β of C-CHAIN, by default %(default)g")
    add("--churn-coef", default=defaults.churn_coef, help="λ of C-CHAIN, by default adapted to β")
    add("--l2-init-coef", type=float, default=defaults.l2_init_coef, help="c of L2 Init, by default %(default)g")
    add("--clip-ratio", type=float, default=defaults.clip_ratio, help="κ of weight clipping, by default %(default)g")
    add("--dry-run", action="store_true", help="List the runs and how long they take, and stop")
    add("--write", action="store_true", help="Train nothing; put tables and picture into the documentation")
    add_folder_arguments(parser, "benchmarks/results/supervised", "logs/supervised")
    return parser


def make_runs(args: argparse.Namespace) -> list[Run]:
    """
    :param args: Arguments of the command line
    :return: The runs, in the order in which they are made: all methods with a seed, then the next seed
    :raises ValueError: Naming the argument that is out of its range
    """
    for name in ("tasks", "images", "epochs"):
        if getattr(args, name) is not None:
            check_number(name, getattr(args, name), minimum=1, integer=True)
    for seed in args.seeds:
        check_number("seeds", seed, minimum=0, integer=True)
    names = ("optimizer", "learning_rate", "target_churn_ratio", "churn_coef", "l2_init_coef", "clip_ratio")
    settings = Settings(**{name: getattr(args, name) for name in names})
    runs = []
    for seed in args.seeds:
        for name in args.problem:
            lengths = args.images or PROBLEMS[name].n_images, args.epochs or PROBLEMS[name].n_epochs
            runs += [Run(name, method, seed, settings, *lengths, args.results, args.logs) for method in args.method]
    return runs


def length(run: Run, n_tasks: int | None) -> int:
    """
    :param run: A run
    :param n_tasks: Number of tasks that was asked for, if any
    :return: Number of tasks to be done, at most the paper's
    """
    return min(n_tasks or run.problem.n_tasks, run.problem.n_tasks)


def show(runs: Sequence[Run], images: Images, n_tasks: int | None) -> None:
    """
    Print what is done, and how long the rest takes at the speed of the moment.

    :param runs: The runs
    :param images: The images
    :param n_tasks: Number of tasks, if not the paper's
    """
    table = Table("run", "tasks done", "updates left", "updates/s", "hours left", title=images.source)
    speeds = {run.method: updates_per_second(run, images) for run in {run.method: run for run in runs}.values()}
    total = 0.0
    for run in runs:
        n_wanted, n_finished = length(run, n_tasks), n_done(run)
        n_updates = max(n_wanted - n_finished, 0) * run.updates_per_task
        hours = n_updates / speeds[run.method] / 3600
        total += hours
        cells = (f"{n_finished} of {n_wanted}", str(n_updates), f"{speeds[run.method]:.0f}", f"{hours:.2f}")
        table.add_row(run.name, *cells)
    table.add_row("all, one after the other", "", "", "", f"{total:.2f}")
    Console().print(table)


def train_all(runs: Sequence[Run], images: Images, n_tasks: int | None) -> None:
    """
    Make the runs one after the other, with a bar for each.

    :param runs: The runs
    :param images: The images
    :param n_tasks: Number of tasks, if not the paper's
    """
    columns = (
        *(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[accuracy]}")),
        TimeRemainingColumn(),
    )
    with Bars(*columns) as bars:
        for run in runs:
            n_wanted = length(run, n_tasks)
            if n_done(run) >= n_wanted:
                continue
            bar = bars.add_task(run.name, total=n_wanted, accuracy="")

            def after_task(progress: Progress, bar=bar) -> None:
                n_finished = len(progress.accuracies)
                mean = f"accuracy {sum(progress.accuracies) / n_finished:.4f}" if n_finished else ""
                bars.update(bar, completed=n_finished, accuracy=mean)

            train(run, images, n_wanted, after_task)


if __name__ == "__main__":
    main()
