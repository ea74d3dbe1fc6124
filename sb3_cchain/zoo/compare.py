"""The command ``sb3-cchain compare``."""

import argparse
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from rich.console import Console

from sb3_cchain.analysis.comparison import Rows, comparison_table, draw_comparison, mixed_tasks
from sb3_cchain.analysis.plots import import_matplotlib
from sb3_cchain.callbacks.returns_file import RETURNS_CSV, read_returns
from sb3_cchain.zoo.outputs import check_output_file, print_line

# Runs below this share of the longest one are named. The last rows of runs of one length may differ a little, because
# episodes end at different steps
SHORT = 0.95


def make_parser() -> argparse.ArgumentParser:
    """
    :return: The parser of the command line
    """
    parser = argparse.ArgumentParser(
        prog="sb3-cchain compare",
        description="Compare methods by the returns of their runs over the same tasks: the mean return on each task, "
        "J(T) with its 95 %% interval, and how much more it is than that of the first method.",
    )
    parser.add_argument(
        "-r",
        "--runs",
        nargs="+",
        action="append",
        required=True,
        metavar=("LABEL", "PATH"),
        help=f"A method: its label, and files {RETURNS_CSV} of its runs, or folders that have such files at any depth; once "
        "for each method. A file that is the beginning of another, such as that of a run that was resumed, is left out",
    )
    parser.add_argument("-o", "--output", type=Path, help="Picture of the learning curves, such as comparison.png")
    parser.add_argument(
        "-w", "--window", type=int, default=10, help="Rows of the files that the running mean of the curves goes over"
    )
    return parser


def main(arguments: Sequence[str]) -> None:
    """
    :param arguments: Of the command line, after ``compare``
    """
    parser = make_parser()
    args = parser.parse_args(arguments)
    check_arguments(parser, args)
    console = Console()
    try:
        methods = {label: read_runs(paths, console) for label, *paths in args.runs}
        print_lengths(methods, console)
        print_switches(methods, console)
        returns = {label: list(runs.values()) for label, runs in methods.items()}
        for task in mixed_tasks(returns):
            why = "not all runs have ended an episode in it, so some returns would be rewards per step"
            print_line(console, f"Left out: task {task}, because {why}")
        console.print(comparison_table(returns))
        if args.output is not None:
            draw_comparison(returns, args.window).savefig(args.output)
            print_line(console, f"Written: {args.output}")
    except (ImportError, OSError, ValueError) as error:
        parser.error(str(error))


def check_arguments(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """
    End with an error in one line where arguments are wrong.

    :param parser: The parser of the command line
    :param args: Its arguments
    """
    labels = [label for label, *_ in args.runs]
    for label, *paths in args.runs:
        if not paths:
            parser.error(f"--runs must have a label and at least one path; got {label}")
        if labels.count(label) > 1:
            parser.error(f"--runs must have another label for each method; got {label} {labels.count(label)} times")
    if args.window < 1:
        parser.error(f"--window must be at least 1; got {args.window}")
    if args.output is not None:
        try:
            formats = import_matplotlib().figure.Figure().canvas.get_supported_filetypes()
        except ImportError as error:
            parser.error(str(error))
        if args.output.suffix[1:] not in formats:
            parser.error(f"--output must end in one of {', '.join(f'.{name}' for name in formats)}; got {args.output}")
        check_output_file(parser, "--output", args.output)


def read_runs(paths: Sequence[str], console: Console) -> dict[Path, Rows]:
    """
    :param paths: Files of returns, or folders that have them
    :param console: Where it is said which files are left out
    :return: The rows of each run, by file
    :raises ValueError: When there is no such file, or it is damaged
    """
    files: dict[Path, Rows] = {}
    for path in map(Path, paths):
        found = sorted(path.rglob(RETURNS_CSV)) if path.is_dir() else [path]
        if not found:
            raise ValueError(f"{path} must be a file of returns or have {RETURNS_CSV} in it, which training with -tb writes")
        files.update({file.resolve(): read_returns(file) for file in found})
    runs: dict[Path, Rows] = {}
    for file, rows in sorted(files.items(), key=lambda item: len(item[1]), reverse=True):
        # Runs of the same length are of different seeds, even where both have the worst return throughout
        longer = next((f for f, other in runs.items() if len(other) > len(rows) and other[: len(rows)] == rows), None)
        if not rows or longer is not None:
            why = f"the beginning of {longer}" if rows else "without a row"
            print_line(console, f"Left out: {file}, {why}")
        else:
            runs[file] = rows
    if not runs:
        raise ValueError(f"No episode has ended yet in the runs {', '.join(paths)}")
    return runs


def print_lengths(methods: dict[str, dict[Path, Rows]], console: Console) -> None:
    """
    Name the runs that are shorter than the others.

    :param methods: The rows of each run, by label and file
    :param console: Where
    """
    ends = {file: int(rows[-1]["timesteps"]) for runs in methods.values() for file, rows in runs.items()}
    longest = max(ends.values())
    for file, end in ends.items():
        if end < SHORT * longest:
            print_line(
                console,
                f"Shorter: {file} ends at step {end:,} of {longest:,}. The tasks that all runs have are compared, the last of "
                "them perhaps in part",
            )


def print_switches(methods: dict[str, dict[Path, Rows]], console: Console) -> None:
    """
    Name the runs whose tasks switched at other steps than those of the first run, as where switches are detected.

    :param methods: The rows of each run, by label and file
    :param console: Where
    """
    (first, rows), *others = [pair for runs in methods.values() for pair in runs.items()]
    for file, other_rows in others:
        a, b = _switches(rows), _switches(other_rows)
        n = min(len(a), len(b))
        differ = any(
            before >= other_end or other_before >= end
            for (before, end), (other_before, other_end) in zip(a[:n], b[:n], strict=True)
        )
        # Beyond the end of the shorter run there is nothing to compare with
        both_run_until = min(rows[-1]["timesteps"], other_rows[-1]["timesteps"])
        if differ or any(end <= both_run_until for _, end in (*a[n:], *b[n:])):
            print_line(
                console,
                f"Other tasks: those of {file} begin at step {_switch_steps(b)}, those of {first} at {_switch_steps(a)}. "
                "Tasks of the same number are not of the same steps",
            )


def _switches(rows: Rows) -> list[tuple[int, int]]:
    """
    :param rows: The rows of a run
    :return: For each switch, a step before it and the step of the first row after it, between which it was
    """
    switches = []
    for row, next_row in pairwise(rows):
        if next_row["task_id"] != row["task_id"]:
            end = int(next_row["timesteps"])
            switches.append((max((int(each["timesteps"]) for each in rows if each["timesteps"] < end), default=0), end))
    return switches


def _switch_steps(switches: Sequence[tuple[int, int]]) -> str:
    return ", ".join(["0", *(f"{end:,}" for _, end in switches)])
