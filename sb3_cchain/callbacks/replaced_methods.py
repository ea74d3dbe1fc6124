"""What stands in the place of an object's methods for a while. The blocks may end in any order."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from typing import Any, TypeVar

from stable_baselines3.common.base_class import BaseAlgorithm

# Is given a function that calls the method, and returns what the method is to return
Wrapper = Callable[[Callable[[], Any]], Any]


class _StandIn:
    """Its method ``call`` stands in the place of a method. Bound methods are what deepcopy() and TrainingCheckpoint expect."""

    def __init__(self, owner: object, method: str):
        self.method: Callable[..., Any] = getattr(owner, method)
        self.own_method = vars(owner).get(method)  # that the user gave to this object

    def call(self, *args: Any, **kwargs: Any) -> Any:
        raise NotImplementedError


class _Wrapped(_StandIn):
    def __init__(self, owner: object, method: str):
        super().__init__(owner, method)
        self.wrappers: list[Wrapper] = []

    def call(self, *args: Any, **kwargs: Any) -> Any:
        call = partial(self.method, *args, **kwargs)
        for wrapper in self.wrappers:
            call = partial(wrapper, call)
        return call()


class _ExcludedSaveParams(_StandIn):
    def __init__(self, owner: object, method: str):
        super().__init__(owner, method)
        self.names: list[str] = []

    def call(self, *args: Any, **kwargs: Any) -> list[str]:
        return [*self.method(), *self.names, "_excluded_save_params"]


AnyStandIn = TypeVar("AnyStandIn", bound=_StandIn)


@contextmanager
def wrapped(owner: object, method: str, wrapper: Wrapper, innermost: bool = False) -> Iterator[None]:
    """
    :param owner: A model, or an object that it uses, such as its environment
    :param method: Name of one of its methods
    :param wrapper: Called in place of the method inside the ``with`` block
    :param innermost: Whether it calls the method itself, and not the wrappers that are there already
    """
    stand_in = _stand_in(owner, method, _Wrapped)
    stand_in.wrappers.insert(0 if innermost else len(stand_in.wrappers), wrapper)
    try:
        with not_saved(owner, method) if isinstance(owner, BaseAlgorithm) else nullcontext():
            yield
    finally:
        stand_in.wrappers.remove(wrapper)
        if not stand_in.wrappers:
            _put_back(owner, method, stand_in)


@contextmanager
def not_saved(model: BaseAlgorithm, name: str) -> Iterator[None]:
    """
    :param model: A model, all attributes of which Stable-Baselines3 saves
    :param name: An attribute that is not saved inside the ``with`` block
    """
    stand_in = _stand_in(model, "_excluded_save_params", _ExcludedSaveParams)
    stand_in.names.append(name)
    try:
        yield
    finally:
        stand_in.names.remove(name)
        if not stand_in.names:
            _put_back(model, "_excluded_save_params", stand_in)


def _stand_in(owner: object, method: str, kind: type[AnyStandIn]) -> AnyStandIn:
    present = _present(owner, method)
    if isinstance(present, kind):
        return present
    made = kind(owner, method)
    setattr(owner, method, made.call)
    return made


def _put_back(owner: object, method: str, stand_in: _StandIn) -> None:
    if _present(owner, method) is not stand_in:
        return  # the user has put something else in its place, which may call it
    delattr(owner, method)
    if stand_in.own_method is not None:
        setattr(owner, method, stand_in.own_method)


def _present(owner: object, method: str) -> Any:
    return getattr(vars(owner).get(method), "__self__", None)
