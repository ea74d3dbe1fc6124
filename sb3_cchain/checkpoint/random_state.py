"""The state of the global generators of random numbers of a process."""

import random
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th


def random_state(device: th.device | None = None) -> dict[str, Any]:
    """
    :param device: Device whose random numbers are drawn, too
    :return: The state of the generators of Python, NumPy and PyTorch
    """
    state = {"python": random.getstate(), "numpy": np.random.get_state(), "torch": th.get_rng_state()}
    if device is not None and device.type == "cuda":
        state["cuda"] = th.cuda.get_rng_state(device)
    return state


def restore_random_state(state: Mapping[str, Any], device: th.device | None = None) -> None:
    """
    :param state: What :func:`random_state` returned
    :param device: The same device
    """
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])
    th.set_rng_state(state["torch"])
    if device is not None and device.type == "cuda":
        th.cuda.set_rng_state(state["cuda"], device)


@contextmanager
def unchanged_random_state() -> Iterator[None]:
    """
    Random numbers that are drawn inside the ``with`` block from the global generators, as replay buffers, networks and some
    environments do, leave no trace: training goes on with the numbers that it would have drawn without them.
    """
    state = random_state()
    try:
        # Of all GPUs
        with th.random.fork_rng(range(th.cuda.device_count()) if th.cuda.is_initialized() else []):
            yield
    finally:
        restore_random_state(state)
