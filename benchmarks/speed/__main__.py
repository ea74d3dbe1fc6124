"""
What churn reduction costs: the base algorithm, C-CHAIN, and the loop that copies the network at every minibatch, timed in turn
in one process under the shipped settings. Prints ratios, so that the machine's own speed drops out, and how many times as many
floating-point operations are needed.

    python -m benchmarks.speed
    python -m benchmarks.speed --case minatar procgen
"""

import argparse

import torch as th
from rich.console import Console

from benchmarks.speed.cases import CASES
from benchmarks.speed.timing import ratios


def main() -> None:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", nargs="+", default=list(CASES), choices=list(CASES), help="What to time")
    parser.add_argument("--rounds", type=int, default=20, help="Timings of each")
    args = parser.parse_args()
    th.set_num_threads(1)
    for name in args.case:
        Console().print(ratios(CASES[name](), args.rounds))


if __name__ == "__main__":
    main()
