"""
The state of an object: what its attributes hold, to be put back into one that was made in the same way in another process.

Objects stay the objects that they are, and only data is put back. So whoever else refers to them, such as hooks and closures,
refers to the right one afterwards, and what cannot be saved, such as an open file, is that of the new process.

An object that knows better what its state is has the methods ``state_dict()`` and ``load_state_dict(state)``, as PyTorch's
modules and optimisers have. Its attributes are not looked at then.
"""

import importlib
import io
import math
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
from gymnasium.utils import EzPickle
from stable_baselines3.common.monitor import ResultsWriter

# They belong to the process: code, files and their places, and how something was made
KEPT = (FunctionType, MethodType, BuiltinFunctionType, type, ModuleType, property, io.IOBase, PurePath, EnvSpec, ResultsWriter)
# They are copied as a whole
DATA = (Number, np.generic, np.ndarray, th.Tensor, str, bytes, dict, list, tuple, set, frozenset, Enum)

# They may consist of numbers and strings
PLAIN = (Number, str, bytes, list, tuple, set, frozenset, dict)

# Packages of windows and pictures, which belong to the process, too
DISPLAYS = frozenset({"pygame", "glfw", "OpenGL", "matplotlib"})

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


class _OwnState(NamedTuple):
    kind: type
    read: Callable[[Any], Any]
    restore: Callable[[Any, Any], None]


# Types whose objects cannot have `state_dict()`, because their code is not ours
_OWN_STATES: list[_OwnState] = []


def register_state(kind: type, read: Callable[[Any], Any], restore: Callable[[Any, Any], None]) -> None:
    """
    Say what the state of a type of objects is, as ``state_dict()`` and ``load_state_dict()`` do where they can be written.

    :param kind: The type; its subclasses are meant, too
    :param read: Returns the state of an object, which can be pickled
    :param restore: Puts into its first argument the state that is its second
    """
    if all(own.kind is not kind for own in _OWN_STATES):
        _OWN_STATES.append(_OwnState(kind, read, restore))


class NotSaved(ValueError):
    """An attribute that a state needs cannot be saved."""


class SharedObject(NotSaved):
    """An object is reached by several ways, one of them through a container, and would be several when it is put back."""


class Data(NamedTuple):
    """
    A value that is copied as a whole.

    :param number: By which :class:`Same` refers to it
    :param content: Pickled
    :param parts: Pickled random generators that it contains, such as those of the players in a list, by their numbers
    """

    number: int
    content: bytes
    parts: dict[int, bytes]


class Attributes(NamedTuple):
    """
    State of an object by its attributes.

    :param number: By which :class:`Same` refers to it
    :param kind: Name of its class
    :param values: State of each attribute
    """

    number: int
    kind: str
    values: dict[str, Any]


class StateDict(NamedTuple):
    """
    What ``state_dict()`` of an object returned.

    :param number: By which :class:`Same` refers to the object
    :param content: Pickled
    """

    number: int
    content: bytes


class Same(NamedTuple):
    """
    A value whose state stands elsewhere in the same state.

    :param number: Its number
    """

    number: int


class Known(NamedTuple):
    """
    An object whose state is kept elsewhere.

    :param name: Its name
    """

    name: str


def object_states(
    holders: Mapping[str, object],
    known: Mapping[str, object] | None = None,
    *,
    skip: Mapping[str, Collection[str]] | None = None,
    strict: bool = False,
    left_out: list[str] | None = None,
) -> dict[str, Any]:
    """
    :param holders: Objects by names. What several of them refer to is still one object when their states are put back
    :param known: Objects whose state is kept elsewhere, by names that mean the same ones when the states are put back
    :param skip: For each holder the names of its attributes that are not part of its state
    :param strict: Whether all that a holder refers to is part of its state. Otherwise plain data and tensors are, and objects
        whose class comes from this package, or from one that a class of the holder comes from
    :param left_out: Takes the names of what is not part of the state without ``strict``, as ``holder.attribute.attribute``
    :return: The state of each, which can be pickled and does not change any more
    :raises NotSaved: With ``strict``, for an attribute that cannot be saved
    """
    reader = _Reader({**(known or {}), **holders}, strict, [] if left_out is None else left_out)
    return {name: reader.holder(holder, name, (skip or {}).get(name, ())) for name, holder in holders.items()}


def restore_objects(
    holders: Mapping[str, object], states: Mapping[str, Any], known: Mapping[str, object] | None = None
) -> None:
    """
    Put states back. Attributes that are not part of a state stay as they are.

    :param holders: Objects of the same classes as those that the states were read from
    :param states: What :func:`object_states` returned
    :param known: As given to :func:`object_states`
    """
    writer = _Writer({**(known or {}), **holders})
    for name, state in states.items():
        writer.fill_holder(holders[name], state)


def object_state(
    holder: object, known: Mapping[str, object] | None = None, *, skip: Collection[str] = (), strict: bool = False
) -> Any:
    """
    :func:`object_states` of a single object.

    :param holder: An object
    :param known: See :func:`object_states`
    :param skip: Names of its attributes that are not part of its state
    :param strict: See :func:`object_states`
    :return: Its state
    """
    return object_states({"": holder}, known, skip={"": skip}, strict=strict)[""]


def restore_object(holder: object, state: Any, known: Mapping[str, object] | None = None) -> None:
    """
    :param holder: An object of the same class as the one that the state was read from
    :param state: What :func:`object_state` returned
    :param known: As given to :func:`object_state`
    """
    restore_objects({"": holder}, {"": state}, known)


class _Reader:
    def __init__(self, known: Mapping[str, object], strict: bool, left_out: list[str]):
        self._known = {id(value): name for name, value in known.items()}
        self._strict, self._left_out = strict, left_out
        # Numbers of the values that have been met, by id; and these values, so that no other gets the id of one of them
        self._numbers: dict[int, int] = {}
        self._met: list[object] = []
        self._packages: set[str] = set()
        # With `strict`, the objects that were met inside of containers, by id
        self._inside: dict[int, object] = {}

    def holder(self, holder: object, name: str, skip: Collection[str]) -> Any:
        self._packages = {"sb3_cchain", *map(_package, type(holder).__mro__)} - {"builtins"}
        own = _own_state(holder)
        if own is not None:
            return StateDict(self._number(holder), self._pickled(own.read(holder)))
        return self._attributes(holder, name, skip)

    def _attributes(self, holder: object, path: str, skip: Collection[str] = ()) -> Attributes:
        number = self._number(holder)
        values = {}
        for name, value in vars(holder).items():
            if name in skip or (isinstance(holder, spaces.Space) and name not in SPACE_STATE):
                continue
            state = self._state(value, f"{path}.{name}" if path else name)
            if state is not None:
                values[name] = state
        return Attributes(number, _class_name(type(holder)), values)

    def _state(self, value: Any, path: str) -> Any:
        if _is_kept(value):
            return None
        if id(value) in self._known:
            return Known(self._known[id(value)])
        if id(value) in self._numbers:
            return Same(self._numbers[id(value)])
        if id(value) in self._inside:
            raise SharedObject(f"{path}: a container that another attribute refers to holds this object, too")
        own = _own_state(value)
        if own is not None:
            return StateDict(self._number(value), self._pickled(own.read(value)))
        if self._is_entered(value):
            return self._attributes(value, path)
        try:
            if not self._strict and not _is_data(value):
                raise NotSaved("an object of another package")
            return self._data(value)
        except Exception as error:  # whatever the object's own code raises
            if self._strict:
                kind = SharedObject if isinstance(error, SharedObject) else NotSaved
                raise kind(f"{path}: {error}") from error
            self._left_out.append(path)
            return None

    def _is_entered(self, value: Any) -> bool:
        if isinstance(value, spaces.Space):
            return True
        return not _is_data(value) and (self._strict or _package(type(value)) in self._packages)

    def _data(self, value: Any) -> Data:
        if value is None or isinstance(value, PLAIN):
            plain = pickle.dumps(value, protocol=5)
            if pickle.STACK_GLOBAL not in plain:
                # Numbers and strings only. To look at each of them for known objects takes ten times as long
                return Data(self._number(value), plain, {})
        file, parts = io.BytesIO(), dict[int, bytes]()

        def refer(part: Any) -> int | None:
            if part is value:
                return None
            # One generator stays one, whether it is met here, in another container or in an attribute
            if id(part) not in self._numbers:
                content = self._pickled(part)
                parts[self._number(part)] = content
            return self._numbers[id(part)]

        def meet(part: Any) -> None:
            if part is not value and _is_shareable(part):
                if id(part) in self._numbers:
                    raise SharedObject("it holds an object that another attribute refers to, too")
                self._inside[id(part)] = part

        _DataPickler(file, self._known, refer, meet if self._strict else None).dump(value)
        return Data(self._number(value), file.getvalue(), parts)

    def _number(self, value: Any) -> int:
        self._met.append(value)
        return self._numbers.setdefault(id(value), len(self._numbers))

    def _pickled(self, value: Any) -> bytes:
        file = io.BytesIO()
        KnownPickler(file, self._known).dump(value)
        return file.getvalue()


class _Writer:
    def __init__(self, known: Mapping[str, object]):
        self._known = known
        self._values: dict[int, Any] = {}

    def fill_holder(self, holder: object, state: Any) -> None:
        self._value(holder, state)

    def _fill(self, holder: object, state: Attributes) -> None:
        for name, value in state.values.items():
            old = vars(holder).get(name)
            new = self._value(old, value)
            # The value is needed even if this process keeps its own: others may be the same one
            if new is not old and not _is_kept(old):
                vars(holder)[name] = new

    def _value(self, old: Any, state: Any) -> Any:
        if isinstance(state, Known):
            return self._known[state.name]
        if isinstance(state, Same):
            return self._values[state.number]
        if isinstance(state, Attributes):
            if _class_name(type(old)) != state.kind:
                kind = _find_class(state.kind)
                old = kind.__new__(kind)
            self._values[state.number] = old
            self._fill(old, state)
            return old
        if isinstance(state, StateDict):
            self._values[state.number] = old
            own = _own_state(old)
            if own is not None:  # not an object that this process does without, such as a file
                own.restore(old, self._unpickled(state.content))
            return old
        for number, content in state.parts.items():
            self._values[number] = self._unpickled(content)
        new = self._unpickled(state.content)
        if type(old) is type(new) and type(new) in _COPY_INTO:
            _COPY_INTO[type(new)](old, new)
            new = old
        self._values[state.number] = new
        return new

    def _unpickled(self, content: bytes) -> Any:
        return _DataUnpickler(io.BytesIO(content), self._known, self._values).load()


class KnownPickler(pickle.Pickler):
    """
    Refers to known objects by their names, and saves of a tensor no more than the tensor.

    :param file: Where it writes
    :param known: Names of the known objects, by their ids
    :param kwargs: Arguments of ``pickle.Pickler``
    """

    def __init__(self, file: Any, known: Mapping[int, str], **kwargs: Any):
        super().__init__(file, protocol=5, **kwargs)
        self._known = known

    def persistent_id(self, value: Any) -> str | None:
        """See ``pickle.Pickler``."""
        return self._known.get(id(value))

    def reducer_override(self, value: Any) -> Any:
        """See ``pickle.Pickler``."""
        if type(value) is np.ndarray and _is_transposed(value):
            # Pickle would lay it out otherwise, and convolutions round otherwise then
            order = sorted(range(value.ndim), key=lambda axis: (-abs(value.strides[axis]), value.shape[axis] == 1))
            return np.transpose, (np.array(value.transpose(order), order="C"), np.argsort(order).tolist())
        if not isinstance(value, th.Tensor):
            return NotImplemented
        if not value.is_leaf:
            value = value.detach()
        if value.untyped_storage().nbytes() > value.nbytes:
            value = value.clone()
        return value.__reduce_ex__(5)


class KnownUnpickler(pickle.Unpickler):
    """
    Reads what :class:`KnownPickler` wrote.

    :param file: Where it reads
    :param known: The known objects by their names
    :param kwargs: Arguments of ``pickle.Unpickler``
    """

    def __init__(self, file: Any, known: Mapping[str, object], **kwargs: Any):
        super().__init__(file, **kwargs)
        self._known = known

    def persistent_load(self, name: str) -> object:
        """See ``pickle.Unpickler``."""
        return self._known[name]


class _DataPickler(KnownPickler):
    def __init__(
        self, file: Any, known: Mapping[int, str], refer: Callable[[Any], int | None], meet: Callable[[Any], None] | None
    ):
        super().__init__(file, known)
        self._refer = refer
        self._meet = meet

    def persistent_id(self, value: Any) -> Any:
        # Called for every number in it
        name = self._known.get(id(value))
        if name is None and self._meet is not None:
            self._meet(value)
        return self._refer(value) if name is None and type(value) in _COPY_INTO else name

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, EzPickle):
            # Gymnasium pickles how they were made, not their state
            raise NotSaved(f"it contains {value}, whose state pickle does not save")
        return super().reducer_override(value)


class _DataUnpickler(KnownUnpickler):
    def __init__(self, file: Any, known: Mapping[str, object], values: Mapping[int, object]):
        super().__init__(file, known)
        self._values = values

    def persistent_load(self, name: Any) -> object:
        return self._values[name] if isinstance(name, int) else super().persistent_load(name)


def _is_transposed(array: np.ndarray) -> bool:
    """Whether axes have another order in memory, as those of transposed images. An axis of length 1 has a place there, too."""
    compact = [array.itemsize * math.prod(array.shape[axis + 1 :]) for axis in range(array.ndim)]
    return array.size > 0 and list(array.strides) != compact and not array.flags.fnc


def _is_data(value: object) -> bool:
    return isinstance(value, DATA) or type(value) in _COPY_INTO or not hasattr(value, "__dict__")


def _is_kept(value: object) -> bool:
    return isinstance(value, KEPT) or _package(type(value)) in DISPLAYS


def _own_state(value: object) -> _OwnState | None:
    kind = type(value)
    # Of the class, because wrappers may pass on what their objects are asked for
    if hasattr(kind, "state_dict") and hasattr(kind, "load_state_dict"):
        return _OwnState(kind, kind.state_dict, kind.load_state_dict)
    return next((own for own in _OWN_STATES if isinstance(value, own.kind)), None)


def _is_shareable(value: object) -> bool:
    """Whether it matters that a value stays one where several refer to it: it can change, and its type has no rule."""
    if type(value) in _COPY_INTO or isinstance(value, (*KEPT, Enum, spaces.Space)):
        return False
    return isinstance(value, (list, dict, set, np.ndarray)) or hasattr(value, "__dict__")


def _package(kind: type) -> str:
    return str(getattr(kind, "__module__", "")).partition(".")[0]  # some classes of C extensions have none


def stock_class(kind: type) -> type:
    """
    :param kind: A class
    :return: It, or Gymnasium's ``TimeLimit`` for the one that RL Zoo puts in its place as soon as it is imported
    """
    return kind.__mro__[1] if kind.__module__ == "rl_zoo3.gym_patches" else kind


def _class_name(kind: type) -> str:
    kind = stock_class(kind)
    return f"{kind.__module__}:{kind.__qualname__}"


def _find_class(name: str) -> Any:
    module, _, qualified = name.partition(":")
    found: Any = importlib.import_module(module)
    for part in qualified.split("."):
        found = getattr(found, part)
    return found
