"""ReDo: recycling dormant neurons."""

from collections.abc import Callable
from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_cchain.analysis.metrics.dormancy import dormant_scores
from sb3_cchain.methods.hidden_units import HiddenUnits, find_flattened_units, hidden_activity
from sb3_cchain.methods.unit_recycling import IntervalRecycling
from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.tensorboard.layout import add_charts
from sb3_cchain.validation import check_bool, check_number

add_charts(
    "Related methods",
    {
        "ReDo: dormant units, share": "redo/dormant_share(/.+)?",
        "ReDo: units recycled": "redo/n_recycled",
    },
)


class ReDo(IntervalRecycling):
    r"""
    Recycles dormant neurons (ReDo), Sokar et al. (ICML 2023), https://arxiv.org/abs/2302.12902.

    Every ``interval``, a hidden unit (of a convolution: a filter) whose score

    .. math:: s_i = E_x |h_i(x)| \, / \, \frac{1}{H} \sum_k E_x |h_k(x)|

    on a batch of observations is at most τ is recycled: its incoming weights and bias are drawn again from the initialisation
    of the network, its outgoing weights become 0, and Adam's moments of all these weights become 0. The outputs of the network
    stay the same, except for the little that the unit contributed.

    On-policy algorithms (PPO, A2C) recycle after ``train()``, on observations of the rollout that it was trained on; DQN on a
    sample of the replay buffer; its target network follows by its usual updates. It works with any chain of linear and
    convolutional layers, with shared or separate networks for policy and value. A unit is recycled only if all of its outgoing
    weights are known. This leaves out the outputs of the network and units whose output is added to a residual stream. In an
    IMPALA network, the first convolution of each residual block and the linear layer are recycled, as in the original code.

    Defaults: τ = 0.025 and 1000 updates are those of the paper's DQN. For on-policy algorithms, 10 iterations and the same τ
    are those of Plasticine's PPO (https://github.com/RLE-Foundation/Plasticine). The batch size 256 is that of the original
    code. The settings in the C-CHAIN paper's comparison have not been published. ``score_flattened`` and ``reset_steps`` are
    not in the original code; other implementations have the one or the other.

    Differences from the original code: incoming weights and bias have the initialisation of the policy at hand (orthogonal,
    Xavier, PyTorch's); the original draws the weights after Xavier and sets the bias to 0. The activation is measured as the
    next layer receives it, so behind a pooling. The original's networks have no LayerNorm; here a LayerNorm between a layer
    and its activation is re-initialised at the unit's place. Because it normalises over all units, the outputs of the others
    then move too. With gSDE the noise, which reads the last hidden layer, is not touched.

    It costs one forward pass of the batch per recycling, and a construction of the policy when there are units to recycle.
    With C-CHAIN, the reference batch is then forgotten, so that churn reduction does not undo the recycling.

    Logged: ``redo/n_recycled``, the units recycled since ``learn()`` was called; ``redo/dormant_share``, the share of units
    that were τ-dormant the last time, and ``redo/dormant_share/<layer>`` of each layer (not in the table on the screen).

    :param tau: τ, the greatest score of a unit that is dormant
    :param interval: Between two recyclings: calls of ``train()`` for on-policy algorithms, gradient updates for DQN; None for
        10 and 1000
    :param batch_size: Observations that the scores are computed on
    :param score_flattened: Whether the flattened output of the convolutions, the input of the first linear layer behind them,
        is scored as one more layer, each of its entries as a unit. A position of a filter has no incoming weights of its own,
        so of such units the outgoing weights and their moments alone become 0
    :param reset_steps: Whether Adam's step counts of the parameters concerned become 0, too. Adam has one count for all units
        of a layer, so the others take larger or smaller steps for a while, as with :class:`AdamRel`
    :raises ValueError: Naming the argument that is out of its range; when training starts, for a network in which there is no
        unit that can be recycled
    :raises TypeError: When an argument is not a boolean; when training starts, for an algorithm that is neither on-policy nor
        DQN, for recurrent networks, and for the policies of :class:`PlasticityInjection`
    """

    name = "redo"

    def __init__(
        self,
        tau: float = 0.025,
        interval: int | None = None,
        batch_size: int = 256,
        score_flattened: bool = False,
        reset_steps: bool = False,
    ):
        super().__init__(interval, batch_size, defaults=(10, 1000))
        check_number("tau", tau, 0)
        check_bool("score_flattened", score_flattened)
        check_bool("reset_steps", reset_steps)
        self.tau = tau
        self.score_flattened = score_flattened
        self.reset_steps = reset_steps

    def _find_layers(self, policy: nn.Module, run: Callable[[], Any]) -> list[HiddenUnits]:
        layers = super()._find_layers(policy, run)
        return [*layers, *find_flattened_units(policy, run)] if self.score_flattened else layers

    def _choose(self, observations: PyTorchObs) -> list[th.Tensor]:
        activity = hidden_activity(uncompiled(self.model.policy), self._layers, self._forward(observations))
        return [dormant_scores(layer_activity) <= self.tau for layer_activity in activity]
