"""Adds a loss, or a gradient, to every update of a training loop that cannot be changed."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import torch as th

from sb3_cchain.replaced import replaced


@contextmanager
def extra_gradient(optimizer: th.optim.Optimizer, backward: Callable[[], object]) -> Iterator[None]:
    """
    Call ``backward()`` right after each ``optimizer.zero_grad()`` inside the ``with`` block.

    Gradients accumulate in PyTorch, so what ``backward`` puts there is added to the gradient of the loop's own loss
    before the loop clips and steps: the update is the one of ``loss + extra_loss``, without a copy of the loop.
    A hook on ``optimizer.step()`` would come too late, after the clipping.

    The blocks nest, the innermost one running last; nothing stays patched afterwards.

    :param optimizer: The optimiser whose loop runs ``zero_grad → loss.backward → (clip) → step``. Of several optimisers, the
        one whose ``zero_grad()`` comes last: those that follow clear the gradients of their parameters again.
    :param backward: Adds its gradient to the parameters' ``.grad``, for instance ``lambda: extra_loss().backward()``
    """
    zero_grad = optimizer.zero_grad
    n_calls = n_updates = 0

    def zero_grad_and_backward(*args: Any, **kwargs: Any) -> None:
        nonlocal n_calls
        n_calls += 1
        zero_grad(*args, **kwargs)
        backward()

    def count_update(*_: Any) -> None:
        nonlocal n_updates
        n_updates += 1

    with ExitStack() as stack:
        if hasattr(optimizer, "_optimizer_step_post_hooks"):  # not where a class does without PyTorch's constructor
            stack.callback(optimizer.register_step_post_hook(count_update).remove)
        with replaced(optimizer, "zero_grad", zero_grad_and_backward):
            yield
    if n_updates > 0 and n_calls == 0:
        warnings.warn(
            "Updates were made without a call of the optimiser's `zero_grad()`, so churn was not reduced. Call it before each "
            "`backward()`, and not the network's `zero_grad()`."
        )


def carrying(tensor: th.Tensor, loss: th.Tensor, coef: float = 1.0) -> th.Tensor:
    """
    Let a tensor that the loop's loss is computed from carry a further loss: the loop's own ``backward()`` then adds its
    gradient, too.

    :param tensor: What the loop's loss depends on
    :param loss: A scalar
    :param coef: What its gradient is multiplied by
    :return: The tensor, with the same values
    """
    return _Carrying.apply(tensor, loss, coef)


class _Carrying(th.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tensor: th.Tensor, loss: th.Tensor, coef: float) -> th.Tensor:
        ctx.coef = loss.new_tensor(coef)
        return tensor.view_as(tensor)

    @staticmethod
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]  # as in torch's documentation
        ctx: Any, gradient: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor, None]:
        return gradient, ctx.coef, None
