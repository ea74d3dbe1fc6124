"""
What churn reduction, the related methods and the monitors cost. All is measured on one core, in processor time, and models
that are compared are timed in turn: figures depend little on what else the machine does. The tables are printed in Markdown.

    python -m benchmarks.speed --write                   # all of them, into the documentation
    python -m benchmarks.speed --case minatar procgen    # these
"""

import argparse
import multiprocessing
import os
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version

import torch as th

from benchmarks.grid.run import ROOT
from benchmarks.report.places import write_tables
from benchmarks.speed import sbx_ppo
from benchmarks.speed.cases import CASES
from benchmarks.speed.checkpoint_cost import checkpoint_table, share_table
from benchmarks.speed.memory import memory_table
from benchmarks.speed.monitor_cost import monitor_table
from benchmarks.speed.tables import Table
from benchmarks.speed.timing import time_case
from benchmarks.speed.update_parts import dqn_parts, ppo_parts

# Beside the cases, what is measured in another way
OTHERS: dict[str, Callable[[], Table]] = {
    "ppo_parts": ppo_parts,
    "dqn_parts": dqn_parts,
    "memory": memory_table,
    "monitors": monitor_table,
    "checkpoints": checkpoint_table,
    "checkpoint_share": share_table,
}


def made_with() -> str:
    """
    :return: The versions that figures depend on
    """
    packages = ["torch", "stable_baselines3", *(["sbx-rl", "jax"] if sbx_ppo.is_installed() else [])]
    return "Measured with " + ", ".join(f"{package} {version(package)}" for package in packages) + "."


def table_of(case: str, n_rounds: int | None) -> Table:
    """
    :param case: Name of a case
    :param n_rounds: Timings of each
    :return: Its table
    """
    table = time_case(CASES[case](), n_rounds)
    for process in multiprocessing.active_children():  # SBX's
        process.terminate()
    return table


def main() -> None:
    """Parse the command line, measure, print, write."""
    names = [*CASES, *OTHERS]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", nargs="+", default=names, choices=names, help="What to measure")
    parser.add_argument(
        "--rounds", type=int, help="Timings of each model in the cases that compare models, instead of their own number"
    )
    parser.add_argument("--write", action="store_true", help="Put the tables into their places in docs/")
    args = parser.parse_args()
    th.set_num_threads(1)
    if hasattr(os, "sched_setaffinity"):  # Linux
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    if not sbx_ppo.is_installed():
        print('SBX is left out: pip install "sb3-cchain[sbx]"')
    for name in args.case:
        start = time.monotonic()
        measure = OTHERS.get(name) or partial(table_of, name, args.rounds)
        text = measure().markdown()
        print(f"\n{name}, {time.monotonic() - start:.0f} s\n\n{text}", flush=True)
        if args.write:
            write_tables({name: text}, ROOT / "docs")
    if args.write and args.case == names:
        write_tables({"made_with": made_with()}, ROOT / "docs")


if __name__ == "__main__":
    main()
