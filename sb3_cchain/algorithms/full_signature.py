"""The signature of a class whose constructor passes arguments on, for all who read it: ``help()``, platforms, editors."""

from inspect import Parameter, Signature, signature
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm

_REST = (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD)


class FullSignature:
    """Its subclasses show the arguments of the algorithm that they derive from with their own."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls.__signature__ = full_signature(cls)  # type: ignore[attr-defined]


def full_signature(cls: type) -> Signature:
    """
    :param cls: A class
    :return: Its signature, in which the arguments of the next constructor stand for ``*args`` and ``**kwargs``. A constructor
        without both, or with defaults before them, decides by itself what it passes on, and is the last one.
    """
    named: dict[str, Parameter] = {}
    rest: list[Parameter] = []
    for base in cls.__mro__:
        if base is BaseAlgorithm:  # `cls` is a mixin, which has no algorithm yet
            break
        if "__init__" in vars(base):
            _, *parameters = signature(vars(base)["__init__"]).parameters.values()
            rest = [each for each in parameters if each.kind in _REST]
            named |= {each.name: each for each in parameters if each.kind not in _REST and each.name not in named}
            if len(rest) < len(_REST) or any(map(_is_optional, parameters)):
                break
    return Signature(sorted([*named.values(), *rest], key=lambda each: each.kind))


def _is_optional(parameter: Parameter) -> bool:
    is_positional = parameter.kind in (Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD)
    return is_positional and parameter.default is not Parameter.empty
