"""The gradients of many minibatches, one for each."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch as th
from torch import nn
from torch.func import functional_call, grad, vmap
from torch.utils._pytree import tree_leaves, tree_map

# Maps a minibatch (a tensor, or tensors in tuples and dictionaries) to a scalar that depends on the network's parameters
Objective = Callable[[Any], th.Tensor]


def minibatch_gradients(network: nn.Module, objective: Objective, minibatches: Any, vectorize: bool = True) -> list[th.Tensor]:
    """
    Gradient of an objective with respect to the network's parameters, for each minibatch.

    :param network: The network
    :param objective: Called with one minibatch
    :param minibatches: Like one minibatch, with a further dimension in front: ``(n_minibatches, batch_size, ...)``
    :param vectorize: Whether to compute them together (``torch.func.vmap``) when the objective allows it. It does not when
        Python decides by the numbers (``if x > 0``) or tensors are changed in place; the gradients are then computed one after
        the other. The results are equal up to rounding.
    :return: For each parameter that the objective depends on, ``(n_minibatches, *parameter.shape)``
    """
    trained = {name: parameter for name, parameter in network.named_parameters() if parameter.requires_grad}
    with th.enable_grad():
        first = th.autograd.grad(objective(_minibatch(minibatches, 0)), list(trained.values()), allow_unused=True)
    reached = [name for name, gradient in zip(trained, first, strict=True) if gradient is not None]
    if vectorize:
        try:
            return _together(network, objective, minibatches, {name: trained[name] for name in reached})
        except RuntimeError:
            pass  # an error of the objective itself is raised below
    return _one_by_one(objective, minibatches, [trained[name] for name in reached])


class _Objective(nn.Module):
    """The objective as a module's ``forward``, as ``functional_call`` wants it."""

    def __init__(self, network: nn.Module, objective: Objective):
        super().__init__()
        self.network = network
        self.forward = objective


def _together(
    network: nn.Module, objective: Objective, minibatches: Any, parameters: dict[str, nn.Parameter]
) -> list[th.Tensor]:
    module = _Objective(network, objective)
    names = {parameter: name for name, parameter in parameters.items()}
    # Each place that holds one of them, once. Left to find the places by itself, `functional_call` does not put the parameters
    # back into a module of several names, such as SB3's shared features extractor.
    places = {
        f"{path}.{place}": names[parameter]
        for path, child in module.named_modules()
        for place, parameter in child.named_parameters(recurse=False, remove_duplicate=False)
        if parameter in names
    }

    def value(tensors: dict[str, th.Tensor], minibatch: Any) -> th.Tensor:
        placed = {place: tensors[name] for place, name in places.items()}
        return functional_call(module, placed, (minibatch,), tie_weights=False)

    with _unvalidated_distributions():
        detached = {name: parameter.detach() for name, parameter in parameters.items()}
        gradients = vmap(grad(value), in_dims=(None, 0))(detached, minibatches)
    return list(gradients.values())


def _one_by_one(objective: Objective, minibatches: Any, parameters: list[nn.Parameter]) -> list[th.Tensor]:
    n_minibatches = len(tree_leaves(minibatches)[0])
    gradients = [parameter.new_empty(n_minibatches, *parameter.shape) for parameter in parameters]
    for index in range(n_minibatches):
        with th.enable_grad():
            value = objective(_minibatch(minibatches, index))
        for stacked, gradient in zip(gradients, th.autograd.grad(value, parameters), strict=True):
            stacked[index] = gradient
    return gradients


def _minibatch(minibatches: Any, index: int) -> Any:
    return tree_map(lambda tensor: tensor[index], minibatches)


@contextmanager
def _unvalidated_distributions() -> Iterator[None]:
    """``torch.distributions`` looks at its arguments with an ``if``, which ``vmap`` does not allow."""
    validate = th.distributions.Distribution._validate_args
    th.distributions.Distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        th.distributions.Distribution.set_default_validate_args(validate)
