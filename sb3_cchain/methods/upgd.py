"""Utility-based perturbed gradient descent."""

from typing import Any

import torch as th
from torch.optim.optimizer import ParamsT

from sb3_cchain.methods.optimizer_wrapper import OptimizerWrapper
from sb3_cchain.tensorboard.layout import add_charts
from sb3_cchain.validation import check_number

add_charts("Related methods", {"UPGD: greatest utility": "upgd/greatest_utility(_.+)?"})


class UPGD(OptimizerWrapper):
    r"""
    Utility-based perturbed gradient descent: useful weights are changed little, which protects what was learned; others are
    changed more and get noise, which keeps them plastic. The utility of a weight :math:`w` with gradient :math:`g` says by how
    much the loss would rise, to first order, if the weight were 0. Its trace is

    .. math:: u \leftarrow \beta u - (1 - \beta) \, g w

    and with the update :math:`\Delta` of the base, the logistic function :math:`\phi`, :math:`t` the count of updates, and
    :math:`\eta` the greatest :math:`u` of all weights ("global" utility),

    .. math:: w \leftarrow (1 - \alpha \lambda) \, w + 2 \left[1 - \phi\left(\frac{u}{(1 - \beta^t) \, \eta}\right)\right]
        (\Delta - \alpha \xi), \quad \xi \sim \mathcal N(0, \sigma^2)

    Around Adam it is the adaptive form of the paper's experiments with PPO, around ``torch.optim.SGD`` the plain form.

    Paper: "Addressing loss of plasticity and catastrophic forgetting in continual learning", https://arxiv.org/abs/2404.00781
    (Elsayed & Mahmood, ICLR 2024). The update and the defaults are those of its code for PPO
    (https://github.com/mohmdelsayed/upgd), Adam's ``eps=1e-5`` excepted: set ``base_kwargs=dict(eps=1e-5)``. As there,

    - the factor 2 makes the update of a weight of utility 0 that of the base;
    - :math:`\eta` is not divided by :math:`1 - \beta^t`, so for the first :math:`1 / (1 - \beta)` updates or so, weights of
      positive utility hardly change;
    - all parameters take part, biases included.

    Where no utility is positive, the update is the base's with noise.

    Logged: ``upgd/greatest_utility``, η.

    It costs a copy of the parameters, a random number per entry, and some operations per parameter tensor and update. One more
    copy of the parameters, the utilities, is kept.

    :param params: Parameters or parameter groups
    :param lr: α, the learning rate of the base
    :param sigma: σ, the standard deviation of the noise
    :param beta: β, the decay rate of the utilities
    :param weight_decay: λ
    :param kwargs: ``base_class`` and ``base_kwargs``, as for :class:`~sb3_cchain.methods.OptimizerWrapper`
    :raises ValueError: Naming the argument that is out of its range
    """

    name = "upgd"

    def __init__(
        self,
        params: ParamsT,
        lr: float | th.Tensor = 1e-3,
        *,
        sigma: float = 0.001,
        beta: float = 0.999,
        weight_decay: float = 0.001,
        **kwargs: Any,
    ):
        check_number("sigma", sigma, minimum=0)
        check_number("beta", beta, minimum=0, maximum=1)
        if beta == 1:
            raise ValueError("`beta` must be less than 1, got 1")
        check_number("weight_decay", weight_decay, minimum=0)
        self.sigma = sigma
        self.beta = beta
        self.weight_decay = weight_decay
        super().__init__(params, lr, **kwargs)

    def _step(self) -> None:
        utilities = self._trace_utilities()
        greatest = self.own_state["greatest_utility"] = th.stack([utility.max() for utility in utilities]).max()
        trained = [
            (parameter, utility, parameter.clone(), group["lr"])
            for (group, parameter), utility in zip(self._grouped(), utilities, strict=True)
            if parameter.grad is not None
        ]
        super()._step()
        correction = 1 - self.beta ** self.own_state["n_updates"]
        for parameter, utility, before, lr in trained:
            scaled = th.where(greatest > 0, utility / (correction * greatest), 0.0)
            gate = 2 * th.sigmoid(-scaled)  # 1 - φ(x) = φ(-x)
            noise = th.randn_like(parameter) * self.sigma
            parameter.copy_((1 - lr * self.weight_decay) * before + gate * (parameter - before - lr * noise))

    def _grouped(self) -> list[tuple[dict[str, Any], th.Tensor]]:
        return [(group, parameter) for group in self.param_groups for parameter in group["params"]]

    def _trace_utilities(self) -> list[th.Tensor]:
        own, parameters = self.own_state, self.parameters()
        known = own.get("utilities", [])
        known = [*known, *map(th.zeros_like, parameters[len(known) :])]
        own["n_updates"] = own.get("n_updates", 0) + 1
        own["utilities"] = [
            utility if p.grad is None else self.beta * utility.to(p.device) - (1 - self.beta) * p.grad * p
            for p, utility in zip(parameters, known, strict=True)
        ]
        return own["utilities"]

    def metrics(self) -> dict[str, float]:
        """
        :return: ``upgd/greatest_utility``, 0 before the first update, and the metrics of the wrappers inside
        """
        return {**super().metrics(), "upgd/greatest_utility": float(self.own_state.get("greatest_utility", 0.0))}
