"""Weight clipping."""

import math
from typing import Any

import torch as th
from torch.optim.optimizer import ParamsT

from sb3_cchain.methods.optimizer_wrapper import OptimizerWrapper
from sb3_cchain.tensorboard.layout import add_charts
from sb3_cchain.validation import check_number

add_charts("Related methods", {"Weight clipping: entries at their bound, share": "weight_clipping/share(_.+)?"})


class WeightClipping(OptimizerWrapper):
    """
    Weight clipping: after each update, every parameter is clipped to ± κ·b, where b is the bound of its initialisation.

    Paper: https://arxiv.org/abs/2407.01704 (Elsayed et al., 2024). As in its code (https://github.com/mohmdelsayed/weight-clipping),
    b = 1/√fan_in, the bound of PyTorch's default initialisation, also when the parameters had another initialisation:

    - the fan_in of a linear layer is the number of inputs; that of a convolution is input channels (of a group) times kernel
      size;
    - a vector takes the bound of the weight before it. This holds for the bias of that layer, and also for the gain and bias
      of a LayerNorm. Gains start at 1, so a small κ shrinks them, as in the original;
    - the output layer is clipped like the others.

    A vector with no weight before it, such as the ``log_std`` of SB3's actor-critic policies, is left alone; the original
    fails on it. So are frozen parameters. The ``log_std`` of gSDE is a matrix and would be clipped, so leave
    ``use_sde=False``.

    SB3's orthogonal initialisation (PPO and A2C, gain √2) exceeds b in many of the entries. With κ near 1, set
    ``ortho_init=False``, as the C-CHAIN paper's Gym Control does.

    Logged: ``weight_clipping/share``, the share of all entries that the last update left at their bound.

    It costs one operation per parameter tensor and update.

    :param params: Parameters or parameter groups
    :param lr: Learning rate
    :param clip_ratio: κ. The default is the one of the original code's optimiser (its PPO script has 3); the C-CHAIN paper
        takes the best of 0.1, 0.5, 1 and 10.
    :param kwargs: ``base_class`` and ``base_kwargs``, as for :class:`~sb3_cchain.methods.OptimizerWrapper`
    :raises ValueError: When ``clip_ratio`` is not positive
    """

    name = "weight_clipping"

    def __init__(self, params: ParamsT, lr: float | th.Tensor = 1e-3, *, clip_ratio: float = 1.0, **kwargs: Any):
        check_number("clip_ratio", clip_ratio, minimum=0, exclusive=True)
        self.clip_ratio = clip_ratio
        super().__init__(params, lr, **kwargs)

    def matrices(self) -> list[th.Tensor]:
        """
        :return: The weights that it takes a bound from
        """
        return self.weights()

    def bounds(self) -> list[float]:
        """
        :return: The bound of each parameter, κ included; infinite where there is none
        """
        bounds: list[float] = []
        bound = math.inf
        for parameter in self.parameters():
            if parameter.dim() > 1:
                fan_in = parameter[0].numel()
                bound = self.clip_ratio / math.sqrt(fan_in)
            bounds.append(bound)
        return bounds

    def _step(self) -> None:
        super()._step()
        for parameter, bound in zip(self.parameters(), self.bounds(), strict=True):
            if parameter.requires_grad:
                parameter.clamp_(-bound, bound)

    @th.no_grad()
    def metrics(self) -> dict[str, float]:
        """
        :return: ``weight_clipping/share``, and the metrics of the wrappers inside
        """
        at_bound = [p.abs() >= bound for p, bound in zip(self.parameters(), self.bounds(), strict=True)]
        n_entries = sum(entries.numel() for entries in at_bound)
        return {
            **super().metrics(),
            "weight_clipping/share": th.stack([entries.sum() for entries in at_bound]).sum().item() / n_entries,
        }
