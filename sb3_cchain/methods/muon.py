"""Muon for the hidden weight matrices, Adam for all else."""

from typing import Any

import torch as th
from torch.optim.optimizer import ParamsT

from sb3_cchain.methods.optimizer_wrapper import OptimizerWrapper
from sb3_cchain.tensorboard.layout import add_charts
from sb3_cchain.validation import check_bool, check_number

add_charts("Related methods", {"Muon: entries that it updates, share": "muon/share(_.+)?"})


class Muon(OptimizerWrapper):
    r"""
    Muon for the hidden weight matrices, and another optimiser, the base, for everything else. The update of a matrix with
    gradient :math:`G` is its momentum with all singular values set to about 1,

    .. math::
        M \leftarrow \mu M + (1 - \mu) G, \quad W \leftarrow W - 0.2 \, \eta \, \sqrt{\max(m, n)} \; U V^\top
        \quad\text{with } U S V^\top = (1 - \mu) G + \mu M

    where :math:`m \times n` is the shape of :math:`W`, and Newton-Schulz iterations in ``bfloat16`` compute :math:`U V^\top`.

    Sources: Jordan et al., "Muon: an optimizer for hidden layers in neural networks" (2024,
    https://kellerjordan.github.io/posts/muon/). The factor :math:`0.2 \sqrt{\max(m, n)}` makes the entries of an update about
    as large as Adam's (Liu et al. 2025, https://arxiv.org/abs/2502.16982), so that SB3's one learning rate :math:`\eta` fits
    both. It is ``torch.optim.Muon`` with ``adjust_lr_fn="match_rms_adamw"``.

    The base updates the output layers, as the source advises, biases, LayerNorms, convolutions, ``log_std``, and matrices of
    one row, which have one singular value.

    An optimiser knows parameters only by their order, so ``n_output_layers`` tells how many matrices at the end are output
    layers: 2 for PPO and A2C (``action_net`` and ``value_net``), 1 for DQN, 2 for SAC (mean and ``log_std`` of the actor; of
    the critic, this leaves the last hidden layer to the base too). The ``log_std`` of gSDE is a matrix too and would be
    given to Muon, so leave ``use_sde=False``.

    Logged: ``muon/share``, the share of all entries that Muon updates.

    It costs 15 matrix products per matrix and update, of which the greatest are :math:`m \times m \times n` for
    :math:`m \le n`.

    :param params: Parameters or parameter groups
    :param lr: Learning rate of both
    :param n_output_layers: Number of weight matrices at the end that the base updates
    :param lr_factor: Learning rate of Muon divided by that of the base
    :param momentum: μ
    :param nesterov: Whether the update is made of :math:`(1 - \mu) G + \mu M`, as above, or of :math:`M`
    :param weight_decay: Share of the matrices that is subtracted in each update, times the learning rate of Muon
    :param kwargs: ``base_class`` and ``base_kwargs``, as for :class:`~sb3_cchain.methods.OptimizerWrapper`
    :raises TypeError: When ``nesterov`` is not a boolean
    :raises ValueError: Naming the argument that is out of its range
    """

    name = "muon"

    def __init__(
        self,
        params: ParamsT,
        lr: float | th.Tensor = 1e-3,
        *,
        n_output_layers: int,
        lr_factor: float = 1.0,
        momentum: float = 0.95,
        nesterov: bool = True,
        weight_decay: float = 0.0,
        **kwargs: Any,
    ):
        check_number("n_output_layers", n_output_layers, minimum=0, integer=True)
        check_number("lr_factor", lr_factor, minimum=0)
        check_number("momentum", momentum, minimum=0, below=1)
        check_bool("nesterov", nesterov)
        check_number("weight_decay", weight_decay, minimum=0)
        self.n_output_layers = n_output_layers
        self.lr_factor = lr_factor
        self.momentum = momentum
        self.nesterov = nesterov
        self.weight_decay = weight_decay
        super().__init__(params, lr, **kwargs)
        if not self.matrices():
            raise ValueError(f"`n_output_layers` must leave a matrix of several rows to Muon, got {n_output_layers!r}")

    def matrices(self) -> list[th.Tensor]:
        """
        :return: The parameters that Muon updates
        """
        hidden = self.weights(self.n_output_layers)
        return [weight for weight in hidden if weight.dim() == 2 and len(weight) > 1]

    def _step(self) -> None:
        matrices = self.matrices()
        gradients = [matrix.grad for matrix in matrices]
        for matrix in matrices:
            matrix.grad = None  # optimisers pass over what has no gradient
        super()._step()
        for matrix, gradient in zip(matrices, gradients, strict=True):
            matrix.grad = gradient
        self._muon().step()
        for matrix in matrices:
            if matrix.grad is not None:
                # Adam looks for a count in each state that it loads, and AdamRel restarts it
                state = self.state[matrix]
                state["step"] = state.get("step", th.zeros(())) + 1

    def _muon(self) -> th.optim.Optimizer:
        """Muon with the learning rates and the state of the base, where its momentum is saved."""
        ids = {id(matrix) for matrix in self.matrices()}
        groups = [
            {"params": [p for p in group["params"] if id(p) in ids], "lr": group["lr"] * self.lr_factor}
            for group in self.param_groups
        ]
        muon = th.optim.Muon(
            groups,
            momentum=self.momentum,
            nesterov=self.nesterov,
            weight_decay=self.weight_decay,
            adjust_lr_fn="match_rms_adamw",
        )
        muon.state = self.state  # type: ignore[assignment]
        return muon

    def metrics(self) -> dict[str, float]:
        """
        :return: ``muon/share``, and the metrics of the wrappers inside
        """
        n_entries = sum(parameter.numel() for parameter in self.parameters())
        share = sum(matrix.numel() for matrix in self.matrices()) / n_entries
        return {**super().metrics(), "muon/share": share}
