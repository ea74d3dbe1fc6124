"""Checks of arguments, with errors that name the argument, its value and what is allowed."""

import math
import os
from collections.abc import Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


def check_number(
    name: str,
    value: Any,
    minimum: float = -math.inf,
    maximum: float = math.inf,
    exclusive: bool = False,
    integer: bool = False,
    below: float = math.inf,
) -> None:
    """
    :param name: The argument's name
    :param value: Its value; NumPy's numbers are numbers, booleans are not
    :param minimum: The least value allowed
    :param maximum: The greatest value allowed
    :param exclusive: Whether ``minimum`` itself is forbidden
    :param integer: Whether the value must be an integer
    :param below: What it must be less than
    :raises ValueError: When it is not a finite number in that range
    """
    kind = Integral if integer else Real
    if (
        isinstance(value, kind)
        and not isinstance(value, bool)
        and math.isfinite(value)
        and minimum <= value <= maximum  # type: ignore[operator]
        and not (exclusive and value == minimum)
        and value < below
    ):
        return
    expected = "an integer" if integer else "a number"
    lower = f"greater than {minimum:.12g}" if exclusive else f"greater than or equal to {minimum:.12g}"
    if math.isfinite(below):
        expected += f" {lower} and less than {below:.12g}"
    elif math.isfinite(maximum):
        expected += f" {lower} and at most {maximum:.12g}" if exclusive else f" between {minimum:.12g} and {maximum:.12g}"
    elif math.isfinite(minimum):
        expected += f" {lower}"
    raise ValueError(f"`{name}` must be {expected}, got {value!r}")


def check_bool(name: str, value: Any) -> None:
    """
    :param name: The argument's name
    :param value: Its value; NumPy's booleans are booleans, strings and numbers are not
    :raises TypeError: When it is not a boolean
    """
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(f"`{name}` must be True or False, got {value!r}")


def check_choice(name: str, value: Any, allowed: Sequence[str]) -> None:
    """
    :param name: The argument's name
    :param value: Its value
    :param allowed: The values allowed
    :raises ValueError: When it is none of them
    """
    if value not in tuple(allowed):
        raise ValueError(f"`{name}` must be one of {', '.join(map(repr, allowed))}, got {value!r}")


def check_list(name: str, value: Any, of: str) -> list[Any]:
    """
    :param name: The argument's name
    :param value: Its value
    :param of: What it should be a list of
    :return: Its elements
    :raises TypeError: When it is a string, or cannot be iterated over
    """
    if isinstance(value, str):
        raise TypeError(f"`{name}` must be a list of {of}, got the string {value!r}")
    try:
        return list(value)
    except TypeError:
        raise TypeError(f"`{name}` must be a list of {of}, got {value!r}") from None


def check_array(
    name: str, value: Any, shape: tuple[int, ...], words: str = "the shape", dtype: DTypeLike = np.float64
) -> NDArray[Any]:
    """
    :param name: The argument's name
    :param value: Its value: an array, or lists of numbers
    :param shape: The shape that it must have
    :param words: What the error calls this shape
    :param dtype: Type of the numbers
    :return: A copy, as an array
    :raises ValueError: When it is not an array of finite numbers, or has another shape
    """
    try:
        array: NDArray[Any] = np.array(value, dtype=dtype)
    except (TypeError, ValueError) as error:
        raise ValueError(f"`{name}` must be an array of numbers, got {value!r}") from error
    if array.shape != shape:
        raise ValueError(f"`{name}` must have {words} {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"`{name}` must be finite, got {value!r}")
    return array


def check_path(name: str, value: object) -> Path:
    """
    :param name: The argument's name
    :param value: Its value
    :return: The path
    :raises TypeError: When it is no path
    """
    if not isinstance(value, (str, os.PathLike)):
        raise TypeError(f"`{name}` must be a path, got {value!r}")
    return Path(value)
