"""Processor time and floating-point operations of a case."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from rich.progress import track
from rich.table import Table
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.speed.cases import Case


def seconds(call: Callable[[], Any]) -> float:
    """
    :param call: What to time
    :return: Seconds of processor time: with one thread, what it takes on a machine that does nothing else
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


def ratios(case: Case, n_rounds: int) -> Table:
    """
    :param case: What to time
    :param n_rounds: Timings of each
    :return: Ratios of the seconds within a round, and of the operations of the first measure
    """
    title = f"{case.title}, {n_rounds} rounds, one thread"
    table = Table("", "ratio", "median", "min", "max", title=title)
    for measure, call in case.measures.items():
        rounds = [
            {name: seconds(partial(call, model)) for name, model in case.models.items()}
            for _ in track(range(n_rounds), description=measure)
        ]
        for one, other in case.pairs:
            figures = [timing[one] / timing[other] for timing in rounds]
            table.add_row(measure, f"{one} / {other}", *(f"{f(figures):.2f}" for f in (np.median, np.min, np.max)))
    measure, call = next(iter(case.measures.items()))
    one, other = case.pairs[0]
    needed, base = (n_operations(partial(call, case.models[name])) for name in (one, other))
    table.caption = f"Floating-point operations of {one} / {other}, {measure}: {needed / base:.2f}"
    return table
