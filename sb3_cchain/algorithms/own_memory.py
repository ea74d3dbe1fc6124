"""Minibatches of buffers of a user's own, which may fill the same memory for each minibatch."""

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th

_PACKAGES = ("stable_baselines3.", "sb3_contrib.")


def is_shared(*methods: Callable[..., Any]) -> bool:
    """
    :param methods: The methods by which a buffer makes its minibatches
    :return: Whether a minibatch may be in memory that the next one is written to. Those of SB3's and sb3-contrib's own
        buffers are not.
    """
    modules = [getattr(getattr(method, "__func__", None), "__module__", "") for method in methods]
    return not all(module.startswith(_PACKAGES) for module in modules)


def copied(sample: Any) -> Any:
    """
    :param sample: A minibatch, or a part of one
    :return: The same in memory of its own
    """
    if isinstance(sample, th.Tensor):
        return sample.clone()
    if isinstance(sample, np.ndarray):
        return sample.copy()
    if isinstance(sample, dict):
        result = copy.copy(sample)
        result.update({key: copied(value) for key, value in sample.items()})
        return result
    if isinstance(sample, tuple):
        parts = [copied(part) for part in sample]
        return type(sample)(*parts) if hasattr(sample, "_fields") else tuple(parts)
    return sample
