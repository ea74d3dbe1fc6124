"""Spectral regularisation."""

from typing import Any

import torch as th
from torch.nn import functional as F
from torch.optim.optimizer import ParamsT

from sb3_cchain.methods.penalty import Penalty
from sb3_cchain.tensorboard.layout import add_charts
from sb3_cchain.validation import check_number

add_charts("Related methods", {"Spectral regularisation: penalty": "spectral_regularization/loss(_.+)?"})


class SpectralRegularization(Penalty):
    r"""
    Spectral regularisation: adds :math:`c \sum_W (\sigma(W)^k - 1)^2` over the weight matrices to the loss, which keeps the
    greatest singular value :math:`\sigma` of each near 1, as it is in many initialisations.

    Paper: "Learning continually by spectral regularization", https://arxiv.org/abs/2406.06811 (Lewandowski et al., 2024).
    Assumed here: vectors (biases, and gains and biases of LayerNorms) are left alone; convolutions are taken as matrices with
    a row for each filter.

    It covers all layers, output layers included. SB3's orthogonal initialisation (PPO and A2C) has a gain of √2 in hidden
    layers and 0.01 in the actor's output; with ``ortho_init=False`` weights begin nearer to 1. The ``log_std`` of gSDE is a
    matrix too and would be regularised, so leave ``use_sde=False``.

    The singular value is estimated by power iteration, one step per update, from the vector of the last one. The vectors are
    saved with the model.

    Logged: ``spectral_regularization/loss``, the penalty times c.

    It costs two products of each weight matrix with a vector, and one of two vectors, per update.

    :param params: Parameters or parameter groups
    :param lr: Learning rate
    :param coef: c. The default is not tuned.
    :param power: k
    :param kwargs: ``base_class`` and ``base_kwargs``, as for :class:`~sb3_cchain.methods.OptimizerWrapper`
    :raises ValueError: Naming the argument that is out of its range
    """

    name = "spectral_regularization"

    def __init__(self, params: ParamsT, lr: float | th.Tensor = 1e-3, *, coef: float = 1e-3, power: int = 2, **kwargs: Any):
        check_number("power", power, minimum=1, integer=True)
        self.power = power
        super().__init__(params, lr, coef=coef, **kwargs)

    def matrices(self) -> list[th.Tensor]:
        """
        :return: The weights that it regularises
        """
        return self.weights()

    def _singular(self) -> list[tuple[th.Tensor, th.Tensor, th.Tensor]]:
        """Of each weight matrix the greatest singular value, its left and its right vector."""
        matrices = [weight.flatten(start_dim=1) for weight in self.matrices()]
        known, n_iterations = self.own_state.get("vectors", []), 1
        if len(known) < len(matrices):
            n_iterations = 15
            # Always the same numbers, so that training draws those that it would have drawn
            draws = th.Generator().manual_seed(0)
            known = [*known, *(th.randn(len(matrix), generator=draws) for matrix in matrices[len(known) :])]
        found = []
        for matrix, left in zip(matrices, known, strict=True):
            left = left.to(matrix)
            for _ in range(n_iterations):
                right = F.normalize(matrix.T @ left, dim=0)
                product = matrix @ right
                left = F.normalize(product, dim=0)
            found.append((product.norm(), left, right))  # pyright: ignore[reportPossiblyUnboundVariable]
        return found

    def penalty(self) -> th.Tensor:
        """
        :return: Σ (σ^k − 1)²
        """
        return th.stack([(sigma**self.power - 1).square() for sigma, _, _ in self._singular()]).sum()

    def gradients(self) -> list[tuple[th.Tensor, th.Tensor]]:
        """
        :return: 2 k (σ^k − 1) σ^(k − 1) u vᵀ for each weight matrix, with the left and right singular vectors u, v
        """
        k, singular = self.power, self._singular()
        self.own_state["vectors"] = [left for _, left, _ in singular]
        return [
            (weight, (2 * k * (sigma**k - 1) * sigma ** (k - 1) * left.outer(right)).view_as(weight))
            for weight, (sigma, left, right) in zip(self.matrices(), singular, strict=True)
        ]
