"""The churn gradient's part along the base loss's gradient, or the part orthogonal to it (Section 5.2 of the paper)."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch as th

from sb3_cchain.validation import check_choice

COMPONENTS = ("full", "projection", "orthogonal")


def gradient_component(churn: Sequence[th.Tensor], base: Sequence[th.Tensor], component: str) -> list[th.Tensor]:
    r"""
    :math:`\mathrm{proj}_g\, \bar g = \frac{g^\top \bar g}{g^\top g}\, g`, or :math:`\bar g - \mathrm{proj}_g\, \bar g`,
    the inner products being those of the gradients of all parameters together. Where :math:`g = 0`, the projection is 0.

    :param churn: Gradient of the churn loss, :math:`\bar g`: a tensor for each parameter
    :param base: Gradient of the base loss, :math:`g`, of the same shapes
    :param component: ``"projection"``, ``"orthogonal"``, or ``"full"`` for their sum
    :return: The component, a tensor for each parameter
    :raises ValueError: For any other component, and when the gradients are not of the same parameters
    """
    check_choice("component", component, COMPONENTS)
    shapes = [[tuple(gradient.shape) for gradient in gradients] for gradients in (churn, base)]
    if shapes[0] != shapes[1] or not shapes[0]:
        raise ValueError(f"`churn` and `base` must hold a gradient of each parameter, got shapes {shapes[0]} and {shapes[1]}")
    if component == "full":
        return list(churn)
    # In double precision: the square of a small gradient's norm is 0 in single precision. Apple's GPUs have no other.
    dtype = th.float32 if base[0].device.type == "mps" else th.float64
    inner_product = sum((c.to(dtype) * b.to(dtype)).sum() for c, b in zip(churn, base, strict=True))
    squared_norm = th.as_tensor(sum(b.to(dtype).square().sum() for b in base))
    share = th.where(squared_norm == 0, 0.0, inner_product / squared_norm)
    projection = [share * b for b in base]
    if component == "projection":
        return projection
    return [c - p for c, p in zip(churn, projection, strict=True)]


@contextmanager
def component_backward(parameters: Sequence[th.Tensor], component: str) -> Iterator[Callable[[th.Tensor], None]]:
    """
    Stands in for ``churn_loss.backward()`` in a training loop that calls ``base_loss.backward()`` later: during the latter,
    when the base loss's gradient is known and has not been clipped yet, the component is added to the parameters' ``.grad``.

    The projection is one in the space of those parameters that the churn loss depends on: for a policy with networks of its
    own for actor and critic, the actor's, so that the critic's gradient has no part in it.

    :param parameters: The parameters that are trained
    :param component: As for :func:`gradient_component`
    :return: The function ``backward(churn_loss)``
    """
    hook: Any = None

    def backward(churn_loss: th.Tensor) -> None:
        nonlocal hook
        if hook is not None:
            hook.remove()  # of an update that had no backward pass; autograd.grad() cannot run with it
        trained = [parameter for parameter in parameters if parameter.requires_grad]
        gradients = th.autograd.grad(churn_loss, trained, allow_unused=True)
        reached = [
            (parameter, gradient) for parameter, gradient in zip(trained, gradients, strict=True) if gradient is not None
        ]
        if reached:
            reached_parameters, churn = zip(*reached, strict=True)

            def add(base: Sequence[th.Tensor | None]) -> None:
                hook.remove()  # once, however many backward passes the update has
                _add_component(reached_parameters, churn, component, base)

            hook = th.autograd.graph.register_multi_grad_hook(reached_parameters, add)

    try:
        yield backward
    finally:
        if hook is not None:
            hook.remove()


def _add_component(
    parameters: Sequence[th.Tensor], churn: Sequence[th.Tensor], component: str, base: Sequence[th.Tensor | None]
) -> None:
    known = [th.zeros_like(c) if b is None else b for c, b in zip(churn, base, strict=True)]
    for parameter, gradient in zip(parameters, gradient_component(churn, known, component), strict=True):
        parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient
