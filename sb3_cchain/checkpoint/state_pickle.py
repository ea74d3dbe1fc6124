"""Pickle for states: it refers to objects that are kept elsewhere, and keeps arrays and tensors as they lie in memory."""

import math
import pickle
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
import torch as th
from gymnasium.utils import EzPickle
from numpy.typing import NDArray


class NotSaved(ValueError):
    """An attribute that a state needs cannot be saved."""


class StatePickler(pickle.Pickler):
    """
    Refers to objects whose state is kept elsewhere, saves of a tensor no more than the tensor, and keeps the memory layout of
    arrays.

    :param file: Where it writes
    :param references: How to refer to these objects, by their ids
    :param shared: Ids of arrays, views of which stay views
    :param kwargs: Arguments of ``pickle.Pickler``
    """

    def __init__(
        self,
        file: Any,
        references: Mapping[int, str] | Mapping[int, str | int],
        shared: Collection[int] = (),
        **kwargs: Any,
    ):
        super().__init__(file, protocol=5, **kwargs)
        self._references = references
        self._shared = shared

    def persistent_id(self, value: Any) -> str | int | None:
        """See ``pickle.Pickler``."""
        return self._references.get(id(value))

    def reducer_override(self, value: Any) -> Any:
        """See ``pickle.Pickler``."""
        if type(value) is np.ndarray:
            owner = memory_owner(value)
            if owner is not value and id(owner) in self._shared:
                return np.ndarray, (value.shape, value.dtype, owner, _address(value) - _address(owner), value.strides)
            return _transposed(value) if _is_transposed(value) else NotImplemented
        if isinstance(value, EzPickle):
            # Gymnasium pickles how they were made, not their state
            raise NotSaved(f"it contains {value}, whose state pickle does not save")
        if not isinstance(value, th.Tensor):
            return NotImplemented
        if not value.is_leaf:
            value = value.detach()
        if value.untyped_storage().nbytes() > value.nbytes:
            value = value.clone()
        return value.__reduce_ex__(5)


class StateUnpickler(pickle.Unpickler):
    """
    Reads what :class:`StatePickler` wrote.

    :param file: Where it reads
    :param objects: The objects by how they are referred to
    :param kwargs: Arguments of ``pickle.Unpickler``
    """

    def __init__(self, file: Any, objects: Mapping[Any, object], **kwargs: Any):
        super().__init__(file, **kwargs)
        self._objects = objects

    def persistent_load(self, reference: Any) -> object:
        """See ``pickle.Unpickler``."""
        return self._objects[reference]


def memory_owner(array: NDArray[Any]) -> NDArray[Any]:
    """
    :param array: An array
    :return: The array that its memory belongs to, if it can be asked for a part of it; otherwise itself
    """
    base = array.base
    return base if isinstance(base, np.ndarray) and base.flags.c_contiguous and not base.dtype.hasobject else array


def _address(array: NDArray[Any]) -> int:
    return array.__array_interface__["data"][0]


def _is_transposed(array: NDArray[Any]) -> bool:
    """Whether axes have another order in memory, as those of transposed images. An axis of length 1 has a place there, too."""
    compact = [array.itemsize * math.prod(array.shape[axis + 1 :]) for axis in range(array.ndim)]
    return array.size > 0 and list(array.strides) != compact and not array.flags.fnc


def _transposed(array: NDArray[Any]) -> Any:
    # Pickle would lay it out otherwise, and convolutions round otherwise then
    order = sorted(range(array.ndim), key=lambda axis: (-abs(array.strides[axis]), array.shape[axis] == 1))
    return np.transpose, (np.array(array.transpose(order), order="C"), np.argsort(order).tolist())
