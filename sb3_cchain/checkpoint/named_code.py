"""Classes and functions by their names, as a checkpoint refers to them."""

import importlib
from typing import Any


def name_in_module(named: Any) -> str:
    """
    :param named: A class or a function
    :return: What :func:`find_named` finds it by, ``"module:Class"``
    """
    return f"{named.__module__}:{named.__qualname__}"


def find_named(name: str) -> Any:
    """
    :param name: Name of a class or a function, ``"module:Class"``
    :return: What has this name
    :raises AttributeError: When nothing has
    :raises ImportError: When its module cannot be imported
    """
    module, _, qualified = name.partition(":")
    found: Any = importlib.import_module(module)
    for part in qualified.split("."):
        found = getattr(found, part)
    return found


def stock_class(kind: type) -> type:
    """
    :param kind: A class
    :return: It, or Gymnasium's ``TimeLimit`` for the one that RL Zoo puts in its place as soon as it is imported
    """
    return kind.__mro__[1] if kind.__module__ == "rl_zoo3.gym_patches" else kind
