"""
The state of objects: what their attributes hold, to be put back into objects made in the same way in another process.

Objects, lists, dicts and sets that attributes refer to stay the objects that they are, and only their content is put back. So
whoever else refers to them, such as hooks and closures, refers to the right one afterwards, and what belongs to the process,
such as a window, is that of the new process. All contents are pickled at once, so that what several of them refer to is still
one object afterwards.

An object that knows better what its state is has the methods ``state_dict()`` and ``load_state_dict(state)``, as PyTorch's
modules and optimisers have. Its attributes are not looked at then.
"""

import io
import pickle
import random
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from enum import Enum
from numbers import Number
from pathlib import PurePath
from types import BuiltinFunctionType, FunctionType, GeneratorType, MethodType, ModuleType
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.monitor import ResultsWriter

from sb3_cchain.checkpoint.named_code import find_named, name_in_module, stock_class
from sb3_cchain.checkpoint.state_pickle import NotSaved, StatePickler, StateUnpickler, memory_owner

# They belong to the process: how something was made, and what writes files
KEPT = (ModuleType, property, EnvSpec, ResultsWriter)
# Saved by their names
CODE = (FunctionType, MethodType, BuiltinFunctionType, type)
# They are copied as a whole
DATA = (Number, np.generic, np.ndarray, th.Tensor, str, bytes, dict, list, tuple, set, frozenset, Enum)

# Packages of windows and pictures, which belong to the process, too
DISPLAYS = frozenset({"pygame", "glfw", "OpenGL", "matplotlib"})

# What changes in a space: the random numbers of its samples
SPACE_STATE = ("_np_random", "spaces")


class Entry(NamedTuple):
    """
    An object that stays where it is: a holder, or what an attribute of an earlier entry refers to.

    :param owner: Number of the entry whose attribute refers to it; None for a holder
    :param name: Name of the attribute, or of the holder
    :param kind: Name of its class, by which it is made where it is not there; None where it cannot be made
    :param is_needed: Whether it has to be there to take its state
    :param is_whole: Whether its state is all that it refers to
    """

    owner: int | None
    name: str
    kind: str | None
    is_needed: bool = False
    is_whole: bool = False


class ObjectStates(NamedTuple):
    """
    States of objects. It can be pickled, and does not change any more.

    :param entries: The objects
    :param content: Pickled: for each of them its attributes, or what ``state_dict()`` returned. It refers to the entries by
        their numbers, and to known objects by their names
    """

    entries: list[Entry]
    content: bytes

    @property
    def holders(self) -> list[str]:
        """Names of the holders."""
        return [entry.name for entry in self.entries if entry.owner is None]


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


_GENERATORS = (
    _OwnState(
        np.random.Generator,
        lambda rng: rng.bit_generator.state,
        lambda rng, state: setattr(rng.bit_generator, "state", state),
    ),
    _OwnState(np.random.RandomState, lambda rng: rng.get_state(legacy=False), np.random.RandomState.set_state),
    _OwnState(random.Random, random.Random.getstate, random.Random.setstate),
)
_CONTAINERS = (
    _OwnState(list, list.copy, lambda old, new: old.__setitem__(slice(None), new)),
    _OwnState(dict, dict.copy, lambda old, new: _replace(old, new)),
    _OwnState(set, set.copy, lambda old, new: _replace(old, new)),
)
_OWN_STATES.extend(_GENERATORS)


def object_states(
    holders: Mapping[str, object],
    known: Mapping[str, object] | None = None,
    *,
    skip: Mapping[str, Collection[str]] | None = None,
    strict: Collection[str] = (),
    left_out: list[str] | None = None,
) -> ObjectStates:
    """
    :param holders: Objects by names. What several of them refer to is still one object when their states are put back
    :param known: Objects whose state is kept elsewhere, by names that mean the same ones when the states are put back
    :param skip: For each holder the names of its attributes that are not part of its state
    :param strict: Names of the holders whose state is all that they refer to, with code, as far as it can be found by its
        name. That of the others is plain data, tensors, and objects whose class comes from this package, or from a package of
        the holder's class or of its bases
    :param left_out: Takes the names of what is not part of the states of the others, as ``holder.attribute.attribute``
    :return: The state of each
    :raises NotSaved: For an attribute of a ``strict`` holder that cannot be saved
    """
    reader = _Reader(holders, known or {}, strict, [] if left_out is None else left_out)
    for number, (name, holder) in enumerate(holders.items()):
        reader.read_holder(number, holder, (skip or {}).get(name, ()))
    return ObjectStates(reader.entries, reader.pickled())


def restore_objects(holders: Mapping[str, object], states: ObjectStates, known: Mapping[str, object] | None = None) -> None:
    """
    Put states back. Attributes that are not part of a state stay as they are.

    :param holders: Objects of the same classes as those that the states were read from
    :param states: What :func:`object_states` returned
    :param known: As given to :func:`object_states`
    :raises ValueError: Naming the object that does not take its state, or that is not there to take it
    """
    found: list[Any] = []
    taken: set[int] = set()
    for entry in states.entries:
        there = holders[entry.name] if entry.owner is None else vars(found[entry.owner]).get(entry.name)
        # Two objects may have been one in this process until now
        if entry.kind is not None and (_kind_name(there) != entry.kind or id(there) in taken):
            there = _make(find_named(entry.kind))
        if there is None and entry.is_needed:
            raise ValueError(
                f"{entry.name}: training made this object, and there is none here that could take its state. Make it in the "
                "constructor or in _on_training_start()"
            )
        found.append(there)
        taken.add(id(there))
    contents = StateUnpickler(io.BytesIO(states.content), {**(known or {}), **dict(enumerate(found))}).load()
    for number, content in contents.items():
        entry, value, own = states.entries[number], found[number], _own_state(found[number])
        if own is not None:
            try:
                own.restore(value, content)
            except ValueError as error:
                raise ValueError(f"{entry.name}: {error}") from error
        elif entry.owner is None or entry.kind is not None:  # not an object that this process does without, such as a file
            _fill(value, content, entry.is_whole)


def _replace(old: Any, new: Any) -> None:
    old.clear()
    old.update(new)


def _make(kind: Any) -> Any:
    """An object without content."""
    if issubclass(kind, np.random.BitGenerator):
        return np.random.Generator(kind())
    return kind() if issubclass(kind, np.random.RandomState | random.Random) else kind.__new__(kind)


def _fill(value: Any, attributes: Mapping[str, Any], is_whole: bool) -> None:
    for name, new in attributes.items():
        if not _is_kept(vars(value).get(name), is_whole):
            vars(value)[name] = new


class _Reader:
    """Walks over attributes first, so that all entries are known when the data is pickled that may refer to them."""

    def __init__(
        self, holders: Mapping[str, object], known: Mapping[str, object], strict: Collection[str], left_out: list[str]
    ):
        self._left_out = left_out
        # How data refers to an object: by the name of a known one, or the number of an entry
        self._references: dict[int, str | int] = {id(value): name for name, value in known.items()}
        self._references.update({id(holder): number for number, holder in enumerate(holders.values())})
        self.entries = [Entry(None, name, None, is_whole=name in strict) for name in holders]
        # Of each entry: its attributes or own state, and the way to it
        self._contents: dict[int, Any] = {}
        self._paths = list(holders)
        self._with_attributes: list[int] = []
        # How many attributes are arrays in the same memory, by the id of the array that it belongs to
        self._n_arrays: Counter[int] = Counter()
        self._packages: set[str] = set()

    def read_holder(self, number: int, holder: object, skip: Collection[str]) -> None:
        self._packages = {"sb3_cchain", *map(_package, type(holder).__mro__)} - {"builtins"}
        self._read(number, holder, skip)

    def _read(self, number: int, value: Any, skip: Collection[str] = ()) -> None:
        own = _own_state(value)
        if own is not None:
            self._contents[number] = own.read(value)
            return
        self._with_attributes.append(number)
        attributes = self._contents[number] = {}
        for name, attribute in vars(value).items():
            if name in skip or (isinstance(value, spaces.Space) and name not in SPACE_STATE):
                continue
            if self._is_saved(number, name, attribute):
                attributes[name] = attribute

    def _is_saved(self, owner: int, name: str, value: Any) -> bool:
        """Whether an attribute is part of the state. An object that is met for the first time is read, too."""
        is_whole = self.entries[owner].is_whole
        if _is_kept(value, is_whole):
            return False
        if id(value) in self._references:
            return True
        own = _own_state(value)
        if own is not None:
            self._enter(owner, name, value, _kind_name(value) if own in (*_GENERATORS, *_CONTAINERS) else None)
        elif isinstance(value, spaces.Space) or (not _is_data(value) and self._is_of_state(owner, value)):
            self._enter(owner, name, value, _kind_name(value))
        elif isinstance(value, np.ndarray):
            self._n_arrays[id(memory_owner(value))] += 1
        elif not is_whole and not _is_data(value):
            self._left_out.append(self._path(owner, name))
            return False
        return True

    def _is_of_state(self, owner: int, value: object) -> bool:
        return self.entries[owner].is_whole or _package(type(value)) in self._packages

    def _enter(self, owner: int, name: str, value: object, kind: str | None) -> None:
        number = self._references[id(value)] = len(self.entries)
        # This package's own, such as an open file of returns, are there where they are needed
        is_needed = has_state_dict(type(value)) and _package(type(value)) != "sb3_cchain"
        self.entries.append(Entry(owner, name, kind, is_needed, self.entries[owner].is_whole))
        self._paths.append(self._path(owner, name))
        self._read(number, value)

    def _path(self, owner: int, name: str) -> str:
        return f"{self._paths[owner]}.{name}" if self._paths[owner] else name

    def pickled(self) -> bytes:
        """All contents. What they refer to has to be there until then."""
        self._filter(lambda number, name, value: not isinstance(value, CODE) or self._can_refer_to(value))
        try:
            return self._pickle(self._contents)
        except Exception:  # whatever the code of an object raises
            self._filter(lambda number, name, value: self._can_pickle(number, value, self._path(number, name)))
            for number in self._contents.keys() - self._with_attributes:
                if not self._can_pickle(number, self._contents[number], self._paths[number]):
                    del self._contents[number]
            return self._pickle(self._contents)

    def _filter(self, is_kept: Callable[[int, str, Any], bool]) -> None:
        """Keep some of the attributes."""
        for number in self._with_attributes:
            content = self._contents[number]
            self._contents[number] = {name: value for name, value in content.items() if is_kept(number, name, value)}

    def _can_refer_to(self, code: Any) -> bool:
        owner = getattr(code, "__self__", None)
        if owner is not None and not isinstance(owner, ModuleType):  # a method
            is_found = isinstance(owner, type) or id(owner) in self._references
            return is_found and getattr(owner, code.__name__, None) == code
        try:
            self._pickle(code)
            return True
        except (AttributeError, pickle.PicklingError):  # made by other code
            return False

    def _can_pickle(self, number: int, value: Any, path: str) -> bool:
        try:
            self._pickle(value)
            return True
        except Exception as error:
            if self.entries[number].is_whole:
                raise NotSaved(f"{path}: {error}") from error
            self._left_out.append(path)
            return False

    def _pickle(self, value: Any) -> bytes:
        file = io.BytesIO()
        shared = {owner for owner, n_arrays in self._n_arrays.items() if n_arrays > 1}
        StatePickler(file, self._references, shared).dump(value)
        return file.getvalue()


def _is_data(value: object) -> bool:
    return isinstance(value, (*DATA, *CODE, io.IOBase)) or not hasattr(value, "__dict__")


def _is_kept(value: object, is_whole: bool) -> bool:
    """Whether an attribute stays that of the process, as it was made there."""
    if isinstance(value, io.IOBase):
        return not is_whole or not is_stream(value)
    if isinstance(value, (*CODE, PurePath)):
        return not is_whole
    return isinstance(value, KEPT) or _package(type(value)) in DISPLAYS


def is_stream(value: object) -> bool:
    """
    :param value: Any
    :return: Whether it is a generator, or a file that is read. Nothing comes back from one that is only written
    """
    if isinstance(value, io.IOBase):
        return not value.closed and value.readable()
    return isinstance(value, GeneratorType)


def _own_state(value: Any) -> _OwnState | None:
    kind = type(value)
    if has_state_dict(kind):
        return _OwnState(kind, kind.state_dict, kind.load_state_dict)
    for own in _CONTAINERS:
        if kind is own.kind:
            return own
    return next((own for own in _OWN_STATES if isinstance(value, own.kind)), None)


def has_state_dict(kind: type) -> bool:
    """
    :param kind: A class
    :return: Whether its objects know their state. Asked of the class, because wrappers pass on what they are asked for
    """
    return hasattr(kind, "state_dict") and hasattr(kind, "load_state_dict")


def _package(kind: type) -> str:
    return str(getattr(kind, "__module__", "")).partition(".")[0]  # some classes of C extensions have none


def _kind_name(value: object) -> str:
    # A generator can take the state of another one with the same algorithm
    return name_in_module(stock_class(type(value.bit_generator if isinstance(value, np.random.Generator) else value)))
