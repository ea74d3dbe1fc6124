"""Describes values by text, to be compared with that of another process."""

from collections.abc import Mapping
from typing import Any

import numpy as np


def describe_value(value: Any, with_schedules: bool = False) -> str | None:
    """
    :param value: Any
    :param with_schedules: Whether functions are called as schedules, and described by three of their values
    :return: Text that is the same in another process; None for what cannot be described so
    """
    if isinstance(value, type):
        return value.__name__
    if isinstance(value, Mapping):
        texts = {str(key): describe_value(entry, with_schedules) for key, entry in value.items()}
        return None if None in texts.values() else str(texts)
    if isinstance(value, (list, tuple)):
        items = [describe_value(entry, with_schedules) for entry in value]
        return None if None in items else f"[{', '.join(map(str, items))}]"
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (bool, int, float, str)):
        return repr(value)
    if with_schedules and callable(value):
        try:
            values = [float(value(progress)) for progress in (1.0, 0.5, 0.0)]  # pyright: ignore[reportArgumentType]
            return f"schedule {values}"
        except Exception:  # no schedule
            return None
    return None
