"""Minibatches of buffers of a user's own, which may fill the same memory for each minibatch."""

from typing import Any

_PACKAGES = ("stable_baselines3.", "sb3_contrib.")


def fills_memory_again(buffer: Any, *methods: str) -> bool:
    """
    :param buffer: A buffer
    :param methods: The names of the methods by which it makes its minibatches
    :return: Whether a minibatch may be in memory that the next one is written to. Those of SB3's and sb3-contrib's own
        methods are not.
    """
    modules = [getattr(getattr(getattr(buffer, name, None), "__func__", None), "__module__", "") for name in methods]
    return not all(module.startswith(_PACKAGES) for module in modules)
