"""Normalize-and-project."""

from typing import Any

import torch as th
from torch.optim.optimizer import ParamsT

from sb3_cchain.methods.optimizer_wrapper import OptimizerWrapper
from sb3_cchain.tensorboard.layout import add_charts
from sb3_cchain.validation import check_number

add_charts("Related methods", {"Normalize and project: norm before the projection": "normalize_and_project/norm(_.+)?"})


class NormalizeAndProject(OptimizerWrapper):
    r"""
    Normalize-and-project (NaP): every ``interval`` updates, each weight matrix is scaled back to its initial norm,

    .. math:: W \leftarrow \frac{\|W_0\|_F}{\|W\|_F} W

    Give it to a network with LayerNorm before its activations, such as :class:`~sb3_cchain.networks.LayerNormPolicy`. There
    the scale of a weight matrix has no effect on the outputs, but a large one makes the updates small beside it, as a smaller
    learning rate would.

    Paper: "Normalization and effective learning rates in reinforcement learning", https://arxiv.org/abs/2407.01800 (Lyle et
    al., NeurIPS 2024). Assumed here:

    - The norm is that of the whole matrix (Frobenius); of a convolution, that of all its filters together.
    - Vectors are left alone: biases, and the gains and biases of the LayerNorms, for which the paper names several ways.
    - The output layers are left alone, because no LayerNorm takes their scale away. An optimiser knows parameters only by
      their order, so ``n_output_layers`` tells how many matrices at the end they are, as in :class:`Parseval`.

    The ``log_std`` of gSDE is a matrix too and would be projected, so leave ``use_sde=False``.

    The norms are those at the first update. They are saved with the model and restored by ``load()``. A matrix of norm 0 stays
    as it is.

    Logged: ``normalize_and_project/norm``, the mean of ‖W‖ / ‖W₀‖ over the matrices before the last projection.

    It costs a norm and a product per weight matrix and projection.

    :param params: Parameters or parameter groups
    :param lr: Learning rate
    :param n_output_layers: Number of weight matrices at the end that are left alone: 2 for PPO and A2C (``action_net`` and
        ``value_net``), 1 for DQN
    :param interval: Updates between two projections
    :param kwargs: ``base_class`` and ``base_kwargs``, as for :class:`~sb3_cchain.methods.OptimizerWrapper`
    :raises ValueError: Naming the argument that is out of its range
    """

    name = "normalize_and_project"

    def __init__(
        self,
        params: ParamsT,
        lr: float | th.Tensor = 1e-3,
        *,
        n_output_layers: int,
        interval: int = 1,
        **kwargs: Any,
    ):
        check_number("n_output_layers", n_output_layers, minimum=0, integer=True)
        check_number("interval", interval, minimum=1, integer=True)
        self.n_output_layers = n_output_layers
        self.interval = interval
        super().__init__(params, lr, **kwargs)
        if not self.matrices():
            raise ValueError(f"`n_output_layers` must leave a weight matrix to project, got {n_output_layers!r}")

    def matrices(self) -> list[th.Tensor]:
        """
        :return: The weights that it projects
        """
        return self.weights(self.n_output_layers)

    def _step(self) -> None:
        if "initial_norms" not in self.own_state:
            self.own_state["initial_norms"] = _norms(self.matrices())
        super()._step()
        self.own_state["n_updates"] = self.own_state.get("n_updates", 0) + 1
        if self.own_state["n_updates"] % self.interval == 0:
            self._project()

    def _project(self) -> None:
        weights = self.matrices()
        norms = _norms(weights)
        initial = self.own_state["initial_norms"].to(norms.device)
        for weight, factor in zip(weights, th.where(norms > 0, initial / norms, 1.0), strict=True):
            if weight.requires_grad:
                weight.mul_(factor)
        self.own_state["norm"] = th.where(initial > 0, norms / initial, 1.0).mean()

    def metrics(self) -> dict[str, float]:
        """
        :return: ``normalize_and_project/norm``, 1 before the first projection, and the metrics of the wrappers inside
        """
        return {**super().metrics(), "normalize_and_project/norm": float(self.own_state.get("norm", 1.0))}


def _norms(weights: list[th.Tensor]) -> th.Tensor:
    return th.stack([weight.norm() for weight in weights])
