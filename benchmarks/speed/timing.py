"""Processor time and floating-point operations of a case."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import ceil
from typing import Any

import numpy as np
import torch as th
from rich.progress import track
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.speed.tables import Table

# Operations for which a product is repeated, about a tenth of a second
PRODUCT_OPERATIONS = 5e9

# The measure whose operations are counted
TRAIN = "`train()`"


@dataclass
class Entry:
    """
    What is timed under one name.

    :param round: Does it once. Returns the seconds of each measure
    :param n_operations: Floating-point operations of the measure ``TRAIN``, in a case with a product
    """

    round: Callable[[], dict[str, float]]
    n_operations: int = 0


@dataclass
class Product:
    """
    A matrix product or convolution: how fast the machine is when it does nothing else.

    :param name: What it is
    :param compute: Computes it
    """

    name: str
    compute: Callable[[], th.Tensor]

    def operations_per_second(self) -> float:
        """
        :return: Its floating-point operations per second
        """
        needed = n_operations(self.compute)
        n_repeats = ceil(PRODUCT_OPERATIONS / needed)
        with th.no_grad():
            return n_repeats * needed / seconds(lambda: [self.compute() for _ in range(n_repeats)])


@dataclass
class Case:
    """
    What is timed in turn.

    :param entries: By name
    :param bases: The names by whose seconds those of all are divided; operations are divided by those of the first
    :param n_rounds: How often each is timed
    :param product: The largest one of a forward pass, where operations are counted
    :param note: What the reader must know
    :param base_of: The entry by whose seconds those of an entry are divided, where each has one of its own
    """

    entries: dict[str, Entry]
    bases: Sequence[str]
    n_rounds: int
    product: Product | None = None
    note: str = ""
    base_of: Mapping[str, str] = field(default_factory=dict)


def seconds(call: Callable[[], Any]) -> float:
    """
    :param call: What to time
    :return: Seconds of processor time: on one core, what it takes on a machine that does nothing else
    """
    start = time.process_time()
    call()
    return time.process_time() - start


def n_operations(call: Callable[[], Any]) -> int:
    """
    :param call: What to count
    :return: Floating-point operations of its matrix products and convolutions
    """
    with FlopCounterMode(display=False) as counter:
        call()
    return counter.get_total_flops()


def time_case(case: Case, n_rounds: int | None = None) -> Table:
    """
    :param case: What to time
    :param n_rounds: Timings of each, instead of the case's own number
    :return: For each measure and entry its seconds (median), these divided by those of each base in the same round (median,
        least and greatest), and, in a case with a product, the operations of ``TRAIN`` and their number per second
    """
    n_rounds = n_rounds or case.n_rounds
    timings: dict[str, list[dict[str, float]]] = {name: [] for name in case.entries}
    speeds = []
    for _ in track(range(n_rounds), description=", ".join(case.entries), transient=True):
        if case.product:
            speeds.append(case.product.operations_per_second())
        for name, entry in case.entries.items():
            timings[name].append(entry.round())

    first = next(iter(case.bases or case.entries))
    header = ["", "", "seconds", *(f"time / {base}" for base in case.bases), *(["time / its base"] if case.base_of else [])]
    if case.product:
        header += [f"operations / {first}", "speed"]
    rows = []
    for measure in timings[first][0]:
        seconds_of = {name: np.array([timing[measure] for timing in rounds]) for name, rounds in timings.items()}
        for name, entry in case.entries.items():
            own = seconds_of[name]
            row = [measure, name, f"{np.median(own):.2g}"]
            row += ["1" if name == base else ratio(own, seconds_of[base]) for base in case.bases]
            if case.base_of:
                row.append(ratio(own, seconds_of[case.base_of[name]]) if name in case.base_of else "1")
            if case.product and measure == TRAIN:
                share = np.median(entry.n_operations / own / speeds)
                row += [f"{entry.n_operations / case.entries[first].n_operations:.2f}", f"{100 * share:.0f} %"]
            elif case.product:
                row += ["", ""]
            rows.append(row)
    note = f"{n_rounds} rounds."
    if case.product:
        note += f" Speed is relative to {case.product.name}: {np.median(speeds) / 1e9:.0f}·10⁹ operations per second."
    return Table(header, rows, f"{note} {case.note}".strip())


def ratio(own: np.ndarray, base: np.ndarray) -> str:
    """
    :param own: Seconds of each round
    :param base: Those of the base
    :return: Median of the ratios within a round, and the least and greatest
    """
    ratios = own / base
    return f"{np.median(ratios):.2f} ({ratios.min():.2f} to {ratios.max():.2f})"
