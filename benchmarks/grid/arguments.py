"""Arguments that several commands have in common."""

import argparse
from pathlib import Path

from benchmarks.grid.run import ROOT


def add_gpu_argument(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: The parser of a command that trains
    """
    parser.add_argument(
        "--gpus-per-run", type=gpus_per_run, default=0.0, help="GPUs of a run, e.g. 0.25; by default none is used"
    )


def gpus_per_run(text: str) -> float:
    """
    :param text: A share of a GPU, or a number of GPUs, as it is written
    :return: The number
    :raises argparse.ArgumentTypeError: For one that Ray does not offer
    """
    try:
        number = float(text)
    except ValueError:
        number = float("nan")
    if 0.0001 <= number <= 1 or (number >= 0 and number.is_integer()):
        return number
    raise argparse.ArgumentTypeError(f"must be from 0.0001 to 1, or a whole number; got {text}")


def add_folder_arguments(
    parser: argparse.ArgumentParser, results: str = "benchmarks/results", logs: str | None = None
) -> None:
    """
    :param parser: The parser of a command whose tables and pictures are part of the documentation
    :param results: Default folder of the results, below the repository
    :param logs: Default folder of the logs, below the repository; None for a command that trains nothing
    """
    parser.add_argument("--results", type=Path, default=ROOT / results, help="Folder of the results")
    if logs is not None:
        parser.add_argument("--logs", type=Path, default=ROOT / logs, help="Folder of logs and checkpoints")
    parser.add_argument("--docs", type=Path, default=ROOT / "docs", help="Folder of the documentation")
