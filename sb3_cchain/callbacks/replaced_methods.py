"""Wrappers around an object's methods, each for the time of a ``with`` block. The blocks may end in any order."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

# Is given a function that calls the method, and returns what the method is to return
Wrapper = Callable[[Callable[[], Any]], Any]

_NOT_SAVED = "_excluded_save_params"


class _StandIn:
    """Its method ``call`` stands in the place of a method. Bound methods are what deepcopy() and TrainingCheckpoint expect."""

    def __init__(self, owner: object, method: str):
        self.method: Callable[..., Any] = getattr(owner, method)
        self.own_method = vars(owner).get(method)  # set by the user on this object
        self.wrappers: list[Wrapper] = []

    def call(self, *args: Any, **kwargs: Any) -> Any:
        call = partial(self.method, *args, **kwargs)
        for wrapper in self.wrappers:
            call = partial(wrapper, call)
        return call()


@contextmanager
def wrapped(owner: object, method: str, wrapper: Wrapper, innermost: bool = False) -> Iterator[None]:
    """
    :param owner: A model, or an object that it uses, such as its environment
    :param method: Name of one of its methods
    :param wrapper: Called in place of the method inside the ``with`` block
    :param innermost: Whether it calls the method itself, and not the wrappers that are there already
    """
    stand_in = _present(owner, method)
    if stand_in is None:
        stand_in = _StandIn(owner, method)
        setattr(owner, method, stand_in.call)
    stand_in.wrappers.insert(0 if innermost else len(stand_in.wrappers), wrapper)
    try:
        with _not_saved(owner, method) if isinstance(owner, BaseAlgorithm) and method != _NOT_SAVED else nullcontext():
            yield
    finally:
        stand_in.wrappers.remove(wrapper)
        if not stand_in.wrappers and _present(owner, method) is stand_in:  # else the user put something else there
            delattr(owner, method)
            if stand_in.own_method is not None:
                setattr(owner, method, stand_in.own_method)


def _not_saved(model: BaseAlgorithm, name: str) -> Any:
    """SB3 saves all attributes of a model but those that this method names."""
    return wrapped(model, _NOT_SAVED, lambda names: [*names(), name, _NOT_SAVED])


def _present(owner: object, method: str) -> _StandIn | None:
    found = getattr(vars(owner).get(method), "__self__", None)
    return found if isinstance(found, _StandIn) else None
