"""An optimiser that adds a penalty on the parameters to the loss."""

from typing import Any

import torch as th
from torch.optim.optimizer import ParamsT

from sb3_cchain.methods.optimizer_wrapper import OptimizerWrapper
from sb3_cchain.validation import check_number


class Penalty(OptimizerWrapper):
    """
    Minimises the loss plus ``coef`` times :meth:`penalty`.

    Training loops run ``zero_grad → loss.backward → (clip) → step``, and gradients accumulate in PyTorch. Here ``zero_grad()``
    sets the gradients to those of the penalty, so the update follows the gradient of the sum, which is clipped as a whole.

    :param params: As for ``OptimizerWrapper``
    :param lr: As for ``OptimizerWrapper``
    :param coef: Weight of the penalty
    :param kwargs: ``base_class`` and ``base_kwargs`` of ``OptimizerWrapper``
    :raises ValueError: When ``coef`` is negative
    """

    def __init__(self, params: ParamsT, lr: float | th.Tensor = 1e-3, *, coef: float, **kwargs: Any):
        check_number("coef", coef, minimum=0)
        self.coef = coef
        super().__init__(params, lr, **kwargs)

    def penalty(self) -> th.Tensor:
        """
        :return: The penalty, a scalar
        """
        raise NotImplementedError()

    def gradients(self) -> list[tuple[th.Tensor, th.Tensor]]:
        """
        :return: The parameters that the penalty depends on, each with its gradient as a new tensor. Subclasses compute it in
            closed form, because autograd takes several times as long for a sum of squares.
        """
        raise NotImplementedError()

    @th.no_grad()
    def zero_grad(self, set_to_none: bool = True) -> None:
        """
        Set the gradients to those of the penalty.

        :param set_to_none: As for any optimiser
        """
        super().zero_grad(set_to_none)
        for parameter, gradient in self.gradients():
            if parameter.requires_grad:
                gradient.mul_(self.coef)
                parameter.grad = gradient if parameter.grad is None else parameter.grad.add_(gradient)

    @th.no_grad()
    def metrics(self) -> dict[str, float]:
        """
        :return: The metrics of the wrappers inside, and ``<name>/loss``, the penalty times ``coef``
        """
        return {**super().metrics(), f"{self.name}/loss": self.coef * self.penalty().item()}
