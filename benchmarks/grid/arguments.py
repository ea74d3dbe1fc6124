"""Arguments that the commands which compare variants of a method have in common."""

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path


def add_variant_arguments(
    parser: argparse.ArgumentParser, variants: Iterable[str], seeds: Sequence[int], n_tasks: int, steps_per_task: int
) -> None:
    """
    :param parser: The command's parser
    :param variants: Names of what it compares, by default all
    :param seeds: Default seeds
    :param n_tasks: Default length of the task sequence
    :param steps_per_task: Default environment steps per task
    """
    names = list(variants)
    parser.add_argument("--variants", nargs="+", default=names, choices=names, help="What is compared")
    parser.add_argument("--seeds", nargs="+", type=int, default=seeds, help="Seeds of agents and of the offsets")
    parser.add_argument("--n-tasks", type=int, default=n_tasks, help="Length of the task sequence")
    parser.add_argument("--steps-per-task", type=int, default=steps_per_task, help="Environment steps per task")
    parser.add_argument("--jobs", type=int, default=2, help="Processes at a time")
    parser.add_argument("--output", type=Path, default=Path("logs"), help="Folder of the results and logs")
