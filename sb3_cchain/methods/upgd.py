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

    Where no utility is positive, the update is the base's with noise. Utilities are kept with the moments of the parameters,
    and begin again with them (:class:`ReDo`, :class:`LayerReset`).

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
        check_number("beta", beta, minimum=0, below=1)
        check_number("weight_decay", weight_decay, minimum=0)
        self.sigma = sigma
        self.beta = beta
        self.weight_decay = weight_decay
        super().__init__(params, lr, **kwargs)

    def _step(self) -> None:
        trained = [(p, group["lr"]) for group in self.param_groups for p in group["params"] if p.grad is not None]
        traces = [self._trace_utility(parameter) for parameter, _ in trained]
        before = [parameter.clone() for parameter, _ in trained]
        super()._step()
        if not trained:
            return
        greatest = self.own_state["greatest_utility"] = th.stack([utility.max() for utility, _ in traces]).max()
        for (parameter, lr), (utility, n_updates), old in zip(trained, traces, before, strict=True):
            # With the moments, so that what resets those resets this; after the base, which makes a state where none is
            self.state[parameter].update(utility=utility, n_utility_updates=n_updates)
            scaled = th.where(greatest > 0, utility / ((1 - self.beta**n_updates) * greatest), 0.0)
            gate = 2 * th.sigmoid(-scaled)  # 1 - φ(x) = φ(-x)
            noise = th.randn_like(parameter) * self.sigma
            parameter.copy_((1 - lr * self.weight_decay) * old + gate * (parameter - old - lr * noise))

    def _trace_utility(self, parameter: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """The utilities after this update's gradient, and the number of gradients in them."""
        assert parameter.grad is not None
        state = self.state.get(parameter, {})
        utility = self.beta * state.get("utility", 0.0) - (1 - self.beta) * parameter.grad * parameter
        return utility, state.get("n_utility_updates", parameter.new_zeros(())) + 1

    def metrics(self) -> dict[str, float]:
        """
        :return: ``upgd/greatest_utility``, 0 before the first update, and the metrics of the wrappers inside
        """
        return {**super().metrics(), "upgd/greatest_utility": float(self.own_state.get("greatest_utility", 0.0))}
