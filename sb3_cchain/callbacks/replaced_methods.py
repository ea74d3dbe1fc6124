"""What stands in the place of an object's methods for a while. The blocks may end in any order."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

# Is given a function that calls the method, and returns what the method is to return
Wrapper = Callable[[Callable[[], Any]], Any]


class _WrappedMethod:
    """Calls a method through wrappers, the first one innermost."""

    def __init__(self, method: Callable[..., Any]):
        self.method = method
        self.wrappers: list[Wrapper] = []

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        call = partial(self.method, *args, **kwargs)
        for wrapper in self.wrappers:
            call = partial(wrapper, call)
        return call()


class _ExcludedSaveParams:
    """Adds names to those that a model's ``_excluded_save_params()`` returns."""

    def __init__(self, method: Callable[[], list[str]]):
        self.method = method
        self.names: list[str] = []

    def __call__(self) -> list[str]:
        return [*self.method(), *self.names, "_excluded_save_params"]


@contextmanager
def wrapped(owner: object, method: str, wrapper: Wrapper) -> Iterator[None]:
    """
    :param owner: A model, or an object that it uses, such as its environment
    :param method: Name of one of its methods
    :param wrapper: Called in place of the method inside the ``with`` block
    """
    replacement = vars(owner).get(method)
    if not isinstance(replacement, _WrappedMethod):
        replacement = _WrappedMethod(getattr(owner, method))
        setattr(owner, method, replacement)
    replacement.wrappers.append(wrapper)
    try:
        with not_saved(owner, method) if isinstance(owner, BaseAlgorithm) else nullcontext():
            yield
    finally:
        replacement.wrappers.remove(wrapper)
        if not replacement.wrappers:
            delattr(owner, method)


@contextmanager
def not_saved(model: BaseAlgorithm, name: str) -> Iterator[None]:
    """
    :param model: A model, all attributes of which Stable-Baselines3 saves
    :param name: An attribute that is not saved inside the ``with`` block
    """
    replacement = vars(model).get("_excluded_save_params")
    if not isinstance(replacement, _ExcludedSaveParams):
        replacement = _ExcludedSaveParams(model._excluded_save_params)
        model._excluded_save_params = replacement  # type: ignore[method-assign]
    replacement.names.append(name)
    try:
        yield
    finally:
        replacement.names.remove(name)
        if not replacement.names:
            del model._excluded_save_params
