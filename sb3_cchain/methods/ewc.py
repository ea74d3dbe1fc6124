"""The penalty of elastic weight consolidation."""

from collections.abc import Sequence
from typing import Any

import torch as th
from torch.optim.optimizer import ParamsT

from sb3_cchain.methods.penalty import Penalty
from sb3_cchain.tensorboard.layout import add_charts
from sb3_cchain.validation import check_number

add_charts("Related methods", {"EWC: penalty": "ewc/loss(_.+)?"})


class EWC(Penalty):
    r"""
    Elastic weight consolidation: keeps the parameters near those at the end of the last task, each as firmly as it mattered
    to the outputs in the tasks so far. It adds to the loss

    .. math:: \frac{c}{2} \sum_i F_i \, (\theta_i - \theta^*_i)^2

    Give it together with the callback :class:`EWCConsolidation`, which at each task switch estimates the diagonal
    :math:`F^\text{task}` of the Fisher information, and then sets :math:`F \leftarrow \gamma F + F^\text{task}` and
    :math:`\theta^* \leftarrow \theta`. There is no penalty before the first switch.

    Papers: https://arxiv.org/abs/1612.00796 (Kirkpatrick et al., PNAS 2017). One anchor :math:`\theta^*` for all tasks and the
    decay are those of the online form, https://arxiv.org/abs/1805.06370 (Schwarz et al., ICML 2018). The code of Continual
    World (https://arxiv.org/abs/2105.10919, Wołczyk et al., NeurIPS 2021) has :math:`\gamma = 1`, and raises the policy's
    :math:`F` to at least 1e-5, which is not done here.

    Logged: ``ewc/loss``, the penalty.

    It costs a few operations per parameter tensor and update, and two copies of the parameters, which are saved with the
    model.

    :param params: Parameters or parameter groups
    :param lr: Learning rate
    :param coef: c. The default is not tuned. In Continual World's code, which has no ½, the coefficient is c / 2.
    :param decay: γ, between 0 (the last task counts alone) and 1 (all tasks count alike)
    :param kwargs: ``base_class`` and ``base_kwargs``, as for :class:`~sb3_cchain.methods.OptimizerWrapper`
    :raises ValueError: Naming the argument that is out of its range
    """

    name = "ewc"

    def __init__(
        self, params: ParamsT, lr: float | th.Tensor = 1e-3, *, coef: float = 100.0, decay: float = 1.0, **kwargs: Any
    ):
        check_number("decay", decay, minimum=0, maximum=1)
        self.decay = decay
        super().__init__(params, lr, coef=coef, **kwargs)

    @th.no_grad()
    def consolidate(self, fisher: Sequence[th.Tensor]) -> None:
        """
        :param fisher: Diagonal of the Fisher information in the task that ends, one tensor for each parameter
        """
        own, parameters = self.own_state, self.parameters()
        known = own.get("fisher", list(map(th.zeros_like, parameters)))
        own["fisher"] = [self.decay * old.to(new.device) + new for old, new in zip(known, fisher, strict=True)]
        own["anchor"] = [parameter.clone() for parameter in parameters]

    def _terms(self) -> list[tuple[th.Tensor, th.Tensor, th.Tensor]]:
        """Parameters, with their Fisher information and their distance from the anchor."""
        own = self.own_state
        return [
            (parameter, fisher.to(parameter.device), parameter - anchor.to(parameter.device))
            for parameter, fisher, anchor in zip(self.parameters(), own.get("fisher", []), own.get("anchor", []), strict=False)
        ]

    def penalty(self) -> th.Tensor:
        """
        :return: ½ Σ F (θ − θ*)²
        """
        terms = [(fisher * distance.square()).sum() for _, fisher, distance in self._terms()]
        return th.stack(terms).sum() / 2 if terms else th.zeros(())

    def gradients(self) -> list[tuple[th.Tensor, th.Tensor]]:
        """
        :return: F (θ − θ*) for each parameter
        """
        return [(parameter, fisher * distance) for parameter, fisher, distance in self._terms()]
