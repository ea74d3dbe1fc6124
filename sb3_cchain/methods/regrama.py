"""ReGraMa: recycling units that hardly get a gradient."""

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_cchain.analysis.metrics.dormancy import dormant_scores
from sb3_cchain.callbacks.training_hooks import TrainingHooks
from sb3_cchain.methods.unit_recycling import IntervalRecycling
from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.tensorboard.layout import add_charts
from sb3_cchain.validation import check_number

add_charts(
    "Related methods",
    {
        "ReGraMa: units with little gradient, share": "regrama/dormant_share(/.+)?",
        "ReGraMa: units recycled": "regrama/n_recycled",
    },
)


class ReGraMa(IntervalRecycling):
    r"""
    Recycles the hidden units that hardly learn any more (ReGraMa): as :class:`ReDo`, but a unit's score is the magnitude of
    its gradients (GraMa) instead of its activations,

    .. math:: s_i = E |\nabla_{W_i} L| \, / \, \frac{1}{H} \sum_k E |\nabla_{W_k} L|,

    with the mean absolute gradient of the unit's incoming weights :math:`W_i` (of a convolution: of the filter's). It also
    finds units that are active but saturated, and does not depend on the activation function.

    Paper: "Measure gradients, not activations! Enhancing neuronal activity in deep reinforcement learning",
    https://arxiv.org/abs/2505.24061 (Liu et al., NeurIPS 2025). Its code, whose τ = 0.01 and 1000 updates are the defaults,
    looks at the gradient of one minibatch. Here the mean is over the minibatches since the last recycling, because those of
    PPO are small. The default interval of on-policy algorithms, 10 iterations, is that of :class:`ReDo`. A layer without any
    gradient is left alone.

    The gradient is the one that the optimiser steps along: clipped, and with those of C-CHAIN, L2 Init or Parseval, which may
    keep a unit's score above τ. Which units are recycled, and how, is described at :class:`ReDo`. The outputs of the network
    change by what the units contributed, which may be much where they are saturated.

    It costs a mean over the gradients of each layer per update, and what :class:`ReDo` costs.

    Logged: ``regrama/n_recycled``, the units recycled since ``learn()`` was called; ``regrama/dormant_share``, the share of
    units with a score of at most τ the last time, and ``regrama/dormant_share/<layer>`` of each layer (not in the table on the
    screen).

    :param tau: τ, the greatest score of a unit that is recycled
    :param interval: Between two recyclings: calls of ``train()`` for on-policy algorithms, gradient updates for DQN; None for
        10 and 1000
    :raises ValueError: Naming the argument that is out of its range; when training starts, for a network in which there is no
        unit that can be recycled
    :raises TypeError: When training starts, for an algorithm that is neither on-policy nor DQN, for recurrent networks, and
        for the policies of :class:`PlasticityInjection`
    """

    name = "regrama"

    def __init__(self, tau: float = 0.01, interval: int | None = None):
        super().__init__(interval, batch_size=1, defaults=(10, 1000))
        check_number("tau", tau, 0)
        self.tau = tau
        self._hooks = TrainingHooks()

    def _begin(self) -> None:
        # Of each layer, the sum over the updates since the last recycling
        self._gradients = [th.zeros(layer.n_units, device=self.model.device) for layer in self._layers]

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._hooks.begin(self.model)
        self._hooks.before_step(self.model.policy.optimizer, self._before_update)

    def _on_training_end(self) -> None:
        super()._on_training_end()
        self._hooks.remove()

    def _before_update(self, optimizer: th.optim.Optimizer) -> None:
        policy = uncompiled(self.model.policy)
        for layer, gradients in zip(self._layers, self._gradients, strict=True):
            gradients += gradient_magnitude(policy.get_parameter(f"{layer.layer}.weight"))

    def _choose(self, observations: PyTorchObs) -> list[th.Tensor]:
        chosen = [(dormant_scores(gradients) <= self.tau) & gradients.any() for gradients in self._gradients]
        for gradients in self._gradients:
            gradients.zero_()
        return chosen


def gradient_magnitude(weight: th.Tensor) -> th.Tensor:
    """
    :param weight: Of a linear or convolutional layer, ``(n_units, ...)``
    :return: Mean absolute gradient of each unit's weights, ``(n_units,)``; zeros where there is no gradient
    """
    if weight.grad is None:
        return weight.new_zeros(len(weight))
    return weight.grad.abs().flatten(start_dim=1).mean(dim=1)
