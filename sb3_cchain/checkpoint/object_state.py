"""
The state of an object: what its attributes hold, to be put back into an object that was made in the same way in another process.

Objects stay the objects that they are, and only data is put back. So whoever else refers to them, such as hooks and closures,
refers to the right one afterwards, and what cannot be saved, such as an open file, is that of the new process.

An object that knows better what its state is has the methods ``state_dict()`` and ``load_state_dict(state)``, as PyTorch's
modules and optimisers have. Its attributes are not looked at then.
"""

import importlib
import io
import pickle
import random
from collections.abc import Callable, Collection, Mapping
from enum import Enum
from numbers import Number
from pathlib import PurePath
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.monitor import ResultsWriter

# They belong to the process: code, files, and how something was made
KEPT = (FunctionType, MethodType, BuiltinFunctionType, type, ModuleType, property, io.IOBase, EnvSpec, ResultsWriter)
# They are copied as a whole
DATA = (Number, np.generic, np.ndarray, th.Tensor, str, bytes, dict, list, tuple, set, frozenset, Enum, PurePath)

# What changes in a space: the random numbers of its samples
SPACE_STATE = ("_np_random", "spaces")

# Types of which an object can take the state of another one, so that who refers to it sees the change
_COPY_INTO: dict[type, Callable[[Any, Any], None]] = {
    np.random.Generator: lambda old, new: setattr(old.bit_generator, "state", new.bit_generator.state),
    np.random.RandomState: lambda old, new: old.set_state(new.get_state(legacy=False)),
    random.Random: lambda old, new: old.setstate(new.getstate()),
}


def register_copy(kind: type, copy_into: Callable[[Any, Any], None]) -> None:
    """
    Have the state of a type of objects, which can be pickled, copied into the object that is there.

    :param kind: The type
    :param copy_into: Copies the state into its first argument from its second
    """
    _COPY_INTO[kind] = copy_into


class NotSaved(ValueError):
    """An attribute that a state needs cannot be saved."""


class Attributes(NamedTuple):
    """
    State of an object by its attributes.

    :param number: By which :class:`Same` refers to it
    :param kind: Name of its class
    :param values: By name: pickled data, or the state of another object
    """

    number: int
    kind: str
    values: dict[str, Any]


class Same(NamedTuple):
    """
    The object whose state stands elsewhere in the same state.

    :param number: Number of the other object
    """

    number: int


class StateDict(NamedTuple):
    """
    What ``state_dict()`` returned.

    :param content: Pickled
    """

    content: bytes


class Elsewhere(NamedTuple):
    """
    An object whose state is kept elsewhere.

    :param name: Its name among the known objects
    """

    name: str


def object_state(
    holder: object,
    known: Mapping[str, object] | None = None,
    *,
    skip: Collection[str] = (),
    strict: bool = False,
    left_out: list[str] | None = None,
) -> Attributes:
    """
    :param holder: An object
    :param known: Objects whose state is kept elsewhere, by names that mean the same ones when the state is put back
    :param skip: Names of attributes of the object that are not part of its state
    :param strict: Whether all that the object refers to is part of its state. Otherwise plain data and tensors are, and objects
        whose class comes from a package that a class of the object comes from, such as Stable-Baselines3 for a callback
    :param left_out: Takes the names of what is not part of the state without ``strict``, as ``attribute.attribute``
    :return: Its state, which can be pickled and does not change any more
    :raises NotSaved: With ``strict``, for an attribute that cannot be saved
    """
    return _Reader(known or {}, strict, [] if left_out is None else left_out).attributes(holder, "", skip)


def restore_object(holder: object, state: Attributes, known: Mapping[str, object] | None = None) -> None:
    """
    Put a state back. Attributes that are not part of the state stay as they are.

    :param holder: An object of the same class as the one that the state was read from
    :param state: What :func:`object_state` returned
    :param known: As given to :func:`object_state`
    """
    _Writer(known or {}).fill(holder, state)


class _Reader:
    def __init__(self, known: Mapping[str, object], strict: bool, left_out: list[str]):
        self._known = {id(value): name for name, value in known.items()}
        self._strict, self._left_out = strict, left_out
        self._numbers: dict[int, int] = {}
        self._packages: set[str] = set()

    def attributes(self, holder: object, path: str, skip: Collection[str] = ()) -> Attributes:
        if not path:
            self._packages = {_package(kind) for kind in type(holder).__mro__} - {"builtins"}
        number = self._numbers[id(holder)] = len(self._numbers)
        values = {}
        for name, value in vars(holder).items():
            if name in skip or (isinstance(holder, spaces.Space) and name not in SPACE_STATE):
                continue
            state = self._state(value, f"{path}.{name}" if path else name)
            if state is not None:
                values[name] = state
        return Attributes(number, _class_name(type(holder)), values)

    def _state(self, value: Any, path: str) -> Any:
        if isinstance(value, KEPT):
            return None
        if id(value) in self._known:
            return Elsewhere(self._known[id(value)])
        if id(value) in self._numbers:
            return Same(self._numbers[id(value)])
        if _has_state_dict(value):
            return StateDict(self._pickled(value.state_dict()))
        if self._is_entered(value):
            return self.attributes(value, path)
        try:
            if not self._strict and not _is_data(value):
                raise NotSaved("it is an object of another package")
            return self._pickled(value)
        except Exception as error:  # whatever the object's own code raises
            if self._strict:
                raise NotSaved(f"{path}: {error}") from error
            self._left_out.append(path)
            return None

    def _is_entered(self, value: Any) -> bool:
        if isinstance(value, spaces.Space):
            return True
        return not _is_data(value) and (self._strict or _package(type(value)) in self._packages)

    def _pickled(self, value: Any) -> bytes:
        file = io.BytesIO()
        _Pickler(file, self._known).dump(value)
        return file.getvalue()


class _Writer:
    def __init__(self, known: Mapping[str, object]):
        self._known = known
        self._objects: dict[int, object] = {}

    def fill(self, holder: object, state: Attributes) -> None:
        self._objects[state.number] = holder
        for name, value in state.values.items():
            old = vars(holder).get(name)
            new = self._value(old, value)
            if new is not old:
                vars(holder)[name] = new

    def _value(self, old: Any, state: Any) -> Any:
        if isinstance(state, Elsewhere):
            return self._known[state.name]
        if isinstance(state, Same):
            return self._objects[state.number]
        if isinstance(state, StateDict):
            old.load_state_dict(self._unpickled(state.content))
            return old
        if isinstance(state, Attributes):
            if _class_name(type(old)) != state.kind:
                kind = _find_class(state.kind)
                old = kind.__new__(kind)
            self.fill(old, state)
            return old
        new = self._unpickled(state)
        if type(old) is type(new) and type(new) in _COPY_INTO:
            _COPY_INTO[type(new)](old, new)
            return old
        return new

    def _unpickled(self, content: bytes) -> Any:
        return _Unpickler(io.BytesIO(content), self._known).load()


class _Pickler(pickle.Pickler):
    """Refers to known objects by their names, and saves of a tensor no more than the tensor."""

    def __init__(self, file: io.BytesIO, known: Mapping[int, str]):
        super().__init__(file, protocol=5)
        self._known = known

    def persistent_id(self, value: Any) -> str | None:
        return self._known.get(id(value))

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, th.Tensor) and not value.is_leaf:
            value = value.detach()
        if isinstance(value, th.Tensor) and value.untyped_storage().nbytes() > value.nbytes:
            value = value.clone()
        return value.__reduce_ex__(5) if isinstance(value, th.Tensor) else NotImplemented


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, known: Mapping[str, object]):
        super().__init__(file)
        self._known = known

    def persistent_load(self, name: str) -> object:
        return self._known[name]


def _is_data(value: object) -> bool:
    return isinstance(value, DATA) or type(value) in _COPY_INTO or not hasattr(value, "__dict__")


def _has_state_dict(value: object) -> bool:
    return hasattr(value, "state_dict") and hasattr(value, "load_state_dict")


def _package(kind: type) -> str:
    return kind.__module__.partition(".")[0]


def _class_name(kind: type) -> str:
    return f"{kind.__module__}:{kind.__qualname__}"


def _find_class(name: str) -> Any:
    module, _, qualified = name.partition(":")
    found: Any = importlib.import_module(module)
    for part in qualified.split("."):
        found = getattr(found, part)
    return found
