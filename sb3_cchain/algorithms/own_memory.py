"""Minibatches of buffers of a user's own, which may fill the same memory for each minibatch."""

import copy
from typing import Any, TypeVar

Sample = TypeVar("Sample")

_PACKAGES = ("stable_baselines3.", "sb3_contrib.")


def is_shared(buffer: Any, *methods: str) -> bool:
    """
    :param buffer: A buffer
    :param methods: The names of the methods by which it makes its minibatches
    :return: Whether a minibatch may be in memory that the next one is written to. Those of SB3's and sb3-contrib's own
        methods are not.
    """
    modules = [getattr(getattr(getattr(buffer, name, None), "__func__", None), "__module__", "") for name in methods]
    return not all(module.startswith(_PACKAGES) for module in modules)


def copied(sample: Sample) -> Sample:
    """
    :param sample: A minibatch, or a part of one
    :return: The same in memory of its own
    """
    return copy.deepcopy(sample)
