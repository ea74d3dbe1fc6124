"""Puts another object in the place of an attribute, for a while."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def replaced(owner: object, name: str, replacement: Any) -> Iterator[None]:
    """
    :param owner: An object
    :param name: One of its attributes, of its own or of its class
    :param replacement: What stands there inside the ``with`` block
    """
    absent = object()
    before = vars(owner).get(name, absent)
    setattr(owner, name, replacement)
    try:
        yield
    finally:
        if before is absent:
            delattr(owner, name)
        else:
            setattr(owner, name, before)
