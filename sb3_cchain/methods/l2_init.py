"""L2 Init, and plain L2 regularisation."""

from typing import Any

import torch as th
from torch.optim.optimizer import ParamsT

from sb3_cchain.methods.penalty import Penalty
from sb3_cchain.tensorboard.layout import add_charts
from sb3_cchain.validation import check_bool, check_choice

add_charts(
    "Related methods",
    {
        "L2 Init: penalty": "l2_init/loss(_.+)?",
        "L2 Init: distance": "l2_init/distance(_.+)?",
    },
)


class L2Init(Penalty):
    """
    L2 regularisation towards the initial parameters (Regenerative Regularization): adds c·‖θ − θ₀‖² to the loss. With
    ``towards="zero"`` it is plain L2 regularisation, c·‖θ‖² (in the loss, unlike AdamW's weight decay).

    Paper: https://arxiv.org/abs/2308.11958 (Kumar et al., 2023). Its equation has the sum over all entries, which is the
    default here. Its code (https://github.com/skumar9876/L2_Init) has half of that sum and leaves out the parameters of
    LayerNorm, as ``exclude_norms=True`` does. By default all parameters of the optimiser are included; those of target
    networks are not among them.

    The scale of c: beside a loss that is a mean over the minibatch, the gradient of an entry is 2c(θ − θ₀) with the sum,
    whatever the batch size and the size of the network, and that divided by the number of entries with the mean.

    The C-CHAIN paper takes the best c of 0.1, 1, 10, 100 and 1000. It does not say whether c multiplies a sum or a mean, and
    the code of that comparison is not public. L2 Init's own code tries 1e-5 … 1e-2 of half the sum. With the 270 000 entries
    of the paper's Gym Control networks that is 1.4 … 1400 of the mean, so the grid is likely to be one for
    ``reduction="mean"``.

    θ₀ is the vector of parameters at the first update. It is saved with the model and restored by ``load()``.

    Logged: ``l2_init/loss``, c·‖θ − θ₀‖²; ``l2_init/distance``, ‖θ − θ₀‖₂.

    It costs a few operations per parameter tensor and update, and a copy of the parameters.

    :param params: Parameters or parameter groups
    :param lr: Learning rate
    :param coef: The factor c. The default is in the middle of what L2 Init's own code tries, for the sum.
    :param towards: ``"init"``, or ``"zero"`` for plain L2 regularisation
    :param reduction: ``"sum"`` of the squares over all entries of all parameters, or their ``"mean"``
    :param exclude_norms: Whether weights and biases of normalisations are left out of the sum and the mean. An optimiser knows
        parameters only by their order: they are taken to be the vectors behind a layer's bias, so each layer needs one bias
    :param kwargs: ``base_class`` and ``base_kwargs``, as for :class:`~sb3_cchain.methods.OptimizerWrapper`
    :raises ValueError: Naming the argument that is out of its range
    :raises TypeError: When ``exclude_norms`` is not a boolean
    """

    name = "l2_init"

    def __init__(
        self,
        params: ParamsT,
        lr: float | th.Tensor = 1e-3,
        *,
        coef: float = 1e-3,
        towards: str = "init",
        reduction: str = "sum",
        exclude_norms: bool = False,
        **kwargs: Any,
    ):
        check_choice("towards", towards, ("init", "zero"))
        check_choice("reduction", reduction, ("sum", "mean"))
        check_bool("exclude_norms", exclude_norms)
        self.towards = towards
        self.reduction = reduction
        self.exclude_norms = exclude_norms
        super().__init__(params, lr, coef=coef, **kwargs)

    def _included(self) -> list[bool]:
        """For each parameter, whether it is penalised."""
        if not self.exclude_norms:
            return [True] * len(self.parameters())
        dims = [parameter.dim() for parameter in self.parameters()]
        # Behind a matrix comes its bias, and then what belongs to a normalisation
        return [not (i > 0 and dims[i] == dims[i - 1] == 1 and max(dims[:i]) > 1) for i in range(len(dims))]

    def _penalised(self) -> list[th.Tensor]:
        return [parameter for parameter, is_in in zip(self.parameters(), self._included(), strict=True) if is_in]

    def _differences(self) -> list[th.Tensor]:
        if self.towards == "zero":
            return [parameter.clone() for parameter in self._penalised()]
        initial = [reference for reference, is_in in zip(self.reference(), self._included(), strict=True) if is_in]
        return [parameter - start for parameter, start in zip(self._penalised(), initial, strict=True)]

    def _n_entries(self) -> int:
        return sum(parameter.numel() for parameter in self._penalised()) if self.reduction == "mean" else 1

    def _squared_distance(self) -> th.Tensor:
        return th.stack([difference.square().sum() for difference in self._differences()]).sum()

    def penalty(self) -> th.Tensor:
        """
        :return: ‖θ − θ₀‖², or its mean over the entries
        """
        return self._squared_distance() / self._n_entries()

    def gradients(self) -> list[tuple[th.Tensor, th.Tensor]]:
        """
        :return: 2 (θ − θ₀) for each penalised parameter, divided by the number of entries for the mean
        """
        factor = 2 / self._n_entries()
        return [(p, difference.mul_(factor)) for p, difference in zip(self._penalised(), self._differences(), strict=True)]

    @th.no_grad()
    def metrics(self) -> dict[str, float]:
        """
        :return: ``l2_init/loss`` and ``l2_init/distance``, and the metrics of the wrappers inside
        """
        return {**super().metrics(), "l2_init/distance": self._squared_distance().sqrt().item()}
