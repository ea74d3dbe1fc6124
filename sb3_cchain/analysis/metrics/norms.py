"""Norms of the parameters, or gradients, of groups of layers."""

import math
from collections.abc import Iterable, Mapping

import torch as th


def group_norms(name: str, tensors: Mapping[str, Iterable[th.Tensor]]) -> dict[str, float]:
    """
    :param name: What it is the norm of
    :param tensors: For each group, its tensors
    :return: The L2 norm of all of them together under ``name``, that of each group under ``name/group``
    """
    squares = {
        group: math.fsum(th.linalg.vector_norm(tensor.detach()).item() ** 2 for tensor in group_tensors)
        for group, group_tensors in tensors.items()
    }
    norms = {f"{name}/{group}": math.sqrt(square) for group, square in squares.items()}
    return {name: math.sqrt(math.fsum(squares.values())), **norms}
