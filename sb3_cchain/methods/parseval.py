"""Parseval regularisation."""

from typing import Any

import torch as th
from torch.optim.optimizer import ParamsT

from sb3_cchain.methods.penalty import Penalty
from sb3_cchain.tensorboard.layout import add_charts
from sb3_cchain.validation import check_number

add_charts("Related methods", {"Parseval: penalty": "parseval/loss(_.+)?"})


class Parseval(Penalty):
    """
    Parseval regularisation: adds c·Σ ‖W Wᵀ − s·I‖²_F over the weight matrices W to the loss, which keeps the weights of the
    units of a layer (the rows of W) orthogonal to each other and of norm √s.

    Paper: https://arxiv.org/abs/2412.07224 (Chung et al., NeurIPS 2024). As in its code
    (https://github.com/wechu/parseval_reg), it covers all layers but the output layers, and biases are free. It is about rows
    also when there are more rows than columns, so that they cannot all be orthogonal. The paper's networks have no
    convolutions; here these are taken as matrices with a row for each filter.

    An optimiser knows parameters only by their order, so ``n_output_layers`` tells how many matrices at the end are output
    layers: 2 for PPO and A2C (``action_net`` and ``value_net``), 1 for DQN. The ``log_std`` of gSDE is a matrix too
    and would be regularised, so leave ``use_sde=False``.

    Logged: ``parseval/loss``, the penalty times c.

    It costs two matrix products per weight matrix and update.

    :param params: Parameters or parameter groups
    :param lr: Learning rate
    :param n_output_layers: Number of weight matrices at the end that are left alone
    :param coef: The factor c. The paper's code has 1e-3 (Gridworld, MetaWorld) or 1e-4 (Lunar Lander, Quadruped) for layers
        of 64 units, times (64 / units)² for others: 6.25e-5 for 256.
    :param scale: s, the squared norm of the rows. The paper's 2 is that of PPO's orthogonal initialisation with gain √2.
    :param kwargs: ``base_class`` and ``base_kwargs``, as for :class:`~sb3_cchain.methods.OptimizerWrapper`
    :raises ValueError: Naming the argument that is out of its range
    """

    name = "parseval"

    def __init__(
        self,
        params: ParamsT,
        lr: float | th.Tensor = 1e-3,
        *,
        n_output_layers: int,
        coef: float = 1e-3,
        scale: float = 2.0,
        **kwargs: Any,
    ):
        check_number("n_output_layers", n_output_layers, minimum=0, integer=True)
        check_number("scale", scale, minimum=0, exclusive=True)
        self.n_output_layers = n_output_layers
        self.scale = scale
        super().__init__(params, lr, coef=coef, **kwargs)
        if not self.matrices():
            raise ValueError(f"`n_output_layers` must leave a weight matrix to regularise, got {n_output_layers!r}")

    def matrices(self) -> list[th.Tensor]:
        """
        :return: The weights that it regularises
        """
        return self.weights(self.n_output_layers)

    def _deviation(self, matrix: th.Tensor) -> th.Tensor:
        deviation = matrix @ matrix.T
        deviation.diagonal().sub_(self.scale)
        return deviation

    def penalty(self) -> th.Tensor:
        """
        :return: Σ ‖W Wᵀ − s·I‖²_F
        """
        return th.stack([self._deviation(weight.flatten(start_dim=1)).square().sum() for weight in self.matrices()]).sum()

    def gradients(self) -> list[tuple[th.Tensor, th.Tensor]]:
        """
        :return: 4 (W Wᵀ − s·I) W for each weight matrix W
        """
        gradients = []
        for weight in self.matrices():
            matrix = weight.flatten(start_dim=1)
            gradients.append((weight, (4 * self._deviation(matrix) @ matrix).view_as(weight)))
        return gradients
