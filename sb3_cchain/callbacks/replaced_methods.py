"""What stands in the place of an object's methods for a while. The blocks may end in any order."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

# Is given a function that calls the method, and returns what the method is to return
Wrapper = Callable[[Callable[[], Any]], Any]


@contextmanager
def wrapped(owner: object, method: str, wrapper: Wrapper, innermost: bool = False) -> Iterator[None]:
    """
    :param owner: A model, or an object that it uses, such as its environment
    :param method: Name of one of its methods
    :param wrapper: Called in place of the method inside the ``with`` block
    :param innermost: Whether it calls the method itself, and not the wrappers that are there already
    """
    wrappers: list[Wrapper] = _parts_of(owner, method, "wrappers", _with_wrappers)
    wrappers.insert(0 if innermost else len(wrappers), wrapper)
    try:
        with not_saved(owner, method) if isinstance(owner, BaseAlgorithm) else nullcontext():
            yield
    finally:
        wrappers.remove(wrapper)
        if not wrappers:
            _put_back(owner, method)


@contextmanager
def not_saved(model: BaseAlgorithm, name: str) -> Iterator[None]:
    """
    :param model: A model, all attributes of which Stable-Baselines3 saves
    :param name: An attribute that is not saved inside the ``with`` block
    """
    names: list[str] = _parts_of(model, "_excluded_save_params", "names", _with_names)
    names.append(name)
    try:
        yield
    finally:
        names.remove(name)
        if not names:
            _put_back(model, "_excluded_save_params")


def _parts_of(owner: object, method: str, parts: str, make: Callable[[Any], Any]) -> Any:
    """What several blocks add to, an attribute of the function that stands in the place of a method."""
    replacement: Any = vars(owner).get(method)
    if not hasattr(replacement, parts):
        before, replacement = replacement, make(getattr(owner, method))
        replacement.before = before
        setattr(owner, method, replacement)
    return getattr(replacement, parts)


def _put_back(owner: object, method: str) -> None:
    before = vars(owner)[method].before
    delattr(owner, method)
    if before is not None:  # a method that the user gave to this object
        setattr(owner, method, before)


# These are functions, not objects of a class, because TrainingCheckpoint saves the state of objects


def _with_wrappers(method: Callable[..., Any]) -> Any:
    wrappers: list[Wrapper] = []

    def replacement(*args: Any, **kwargs: Any) -> Any:
        call = partial(method, *args, **kwargs)
        for wrapper in wrappers:
            call = partial(wrapper, call)
        return call()

    replacement.wrappers = wrappers  # type: ignore[attr-defined]
    return replacement


def _with_names(excluded_save_params: Callable[[], list[str]]) -> Any:
    names: list[str] = []

    def replacement() -> list[str]:
        return [*excluded_save_params(), *names, "_excluded_save_params"]

    replacement.names = names  # type: ignore[attr-defined]
    return replacement
