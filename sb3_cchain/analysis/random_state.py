"""Looking at training without changing it."""

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch as th


@contextmanager
def unchanged_random_state() -> Iterator[None]:
    """
    Random numbers that are drawn inside the ``with`` block from the global generators, as replay buffers, networks and some
    environments do, leave no trace: training goes on with the numbers that it would have drawn without them.
    """
    python_state, numpy_state = random.getstate(), np.random.get_state()
    devices = range(th.cuda.device_count()) if th.cuda.is_initialized() else []
    try:
        with th.random.fork_rng(devices):
            yield
    finally:
        random.setstate(python_state)
        np.random.set_state(numpy_state)
