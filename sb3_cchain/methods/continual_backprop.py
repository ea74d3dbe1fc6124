"""Continual backpropagation."""

from dataclasses import dataclass

import torch as th
from torch import nn

from sb3_cchain.analysis.reference_batch import sample_batch
from sb3_cchain.callbacks.training_hooks import TrainingHooks
from sb3_cchain.methods.hidden_units import HiddenUnits, received_activity, sum_of_places
from sb3_cchain.methods.unit_recycling import UnitRecycling
from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.networks.evaluation_mode import evaluation_mode
from sb3_cchain.tensorboard.layout import add_charts
from sb3_cchain.validation import check_choice, check_number

add_charts("Related methods", {"Continual backpropagation: units recycled": "continual_backprop/n_recycled"})

UTILITIES = ("contribution", "adaptable_contribution")


class ContinualBackprop(UnitRecycling):
    r"""
    Recycles, after each gradient update, a small fraction of the hidden units: those of least use (continual backpropagation).

    Paper: "Loss of plasticity in deep continual learning", https://doi.org/10.1038/s41586-024-07711-7 (Dohare et al., Nature
    2024). After each update, for each layer :math:`l` and unit :math:`i`,

    .. math:: u_{l,i} \leftarrow \eta u_{l,i} + (1 - \eta) \, |h_{l,i}| \sum_k |w_{l,i,k}|

    is a running average of what the unit contributes to the next layer, its *contribution utility*: activation times outgoing
    weights (Eq. 1; of a filter, summed over its positions). Units older than the maturity threshold :math:`m` are eligible.
    The replacement rate :math:`\rho` times their number is added to a counter of the layer. When it reaches 1, the eligible
    unit with the least :math:`u_{l,i} / (1 - \eta^{a_{l,i}})`, corrected for its age :math:`a_{l,i}` as in Adam, is recycled,
    its utility and age begin at 0, and the counter decreases by 1.

    ``utility="adaptable_contribution"`` is that of an earlier version (https://arxiv.org/abs/2108.06325, 2021),

    .. math:: |h_{l,i} - \bar h_{l,i}| \sum_k |w_{l,i,k}| \, / \, \sum_j |w_{l-1,j,i}|

    in place of the contribution: without the mean activation :math:`\bar h`, a corrected running average that the bias of the
    next layer can stand for, and divided by the incoming weights, because large ones change slowly. When a unit is recycled,
    its :math:`\bar h` times its outgoing weights is added to the biases of the next layers. With the contribution utility,
    outgoing weights just become 0, as in the paper's text. (The released code, https://github.com/shibhansh/loss-of-plasticity,
    has the correction of the biases for both, but with a mean that it has set to 0 before.) So the outputs change by what the
    least useful unit contributed, or by its deviation from the mean.

    Which units can be recycled, and how, is described at :class:`ReDo`. Activations are measured after each update, on a
    sample of the rollout, or of DQN's replay buffer, in place of the update's minibatch. With C-CHAIN, the recycling counts as
    part of that update, also in its churn.

    It costs one forward pass of the sample per update, and a construction of the policy whenever units are recycled.

    Logged: ``continual_backprop/n_recycled``, the units recycled since ``learn()`` was called.

    Utilities and ages go on when the same callback is given to ``learn()`` again; a new callback begins with units of age 0.

    :param replacement_rate: ρ, share of the eligible units that are recycled per update; 0 for none. The defaults of this and
        the next two are those of the paper's PPO
    :param maturity_threshold: m, updates before a new unit may be recycled
    :param decay_rate: η, of the running averages
    :param utility: ``"contribution"`` or ``"adaptable_contribution"``
    :param batch_size: Observations to measure activations on. The default is the size of the minibatches of the paper's PPO
    :raises ValueError: Naming the argument that is out of its range; when training starts, for a network in which there is no
        unit that can be recycled
    :raises TypeError: When training starts, for an algorithm that is neither on-policy nor DQN, for recurrent networks, and
        for the policies of :class:`PlasticityInjection`
    """

    name = "continual_backprop"

    def __init__(
        self,
        replacement_rate: float = 1e-4,
        maturity_threshold: int = 10_000,
        decay_rate: float = 0.99,
        utility: str = "contribution",
        batch_size: int = 128,
    ):
        super().__init__()
        check_number("replacement_rate", replacement_rate, 0, 1)
        check_number("maturity_threshold", maturity_threshold, 0, integer=True)
        check_number("decay_rate", decay_rate, 0, below=1)
        check_choice("utility", utility, UTILITIES)
        check_number("batch_size", batch_size, 1, integer=True)
        self.replacement_rate = replacement_rate
        self.maturity_threshold = maturity_threshold
        self.decay_rate = decay_rate
        self.utility = utility
        self.batch_size = batch_size
        self._hooks = TrainingHooks()

    def _begin(self) -> None:
        device = self.model.device
        self._usefulness = [Usefulness(th.zeros(layer.n_units, device=device)) for layer in self._layers]

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._hooks.begin(self.model)
        if self.replacement_rate > 0:
            self._hooks.after_step(self.model.policy.optimizer, self._after_update)

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self._hooks.remove()

    def _on_rollout_end(self) -> None:
        self.logger.record("continual_backprop/n_recycled", self.n_recycled)

    def _after_update(self, optimizer: th.optim.Optimizer) -> None:
        policy = uncompiled(self.model.policy)
        observations = sample_batch(self.model, self.batch_size)["observations"]
        with evaluation_mode(policy), th.no_grad():
            activations = received_activity(policy, self._layers, self._forward(observations), measure=lambda matrix: matrix)
            chosen = []
            for layer, usefulness in zip(self._layers, self._usefulness, strict=True):
                usefulness.ages += 1
                contribution = self._contribution(policy, layer, usefulness, activations)
                usefulness.utility.mul_(self.decay_rate).add_(contribution, alpha=1 - self.decay_rate)
                chosen.append(self._choose(usefulness))
            if self.utility == "adaptable_contribution":
                for layer, usefulness, units in zip(self._layers, self._usefulness, chosen, strict=True):
                    hand_over_means(policy, layer, usefulness.means, units)
        self._recycle_units(chosen)
        for usefulness, units in zip(self._usefulness, chosen, strict=True):
            usefulness.utility[units], usefulness.ages[units] = 0, 0

    def _contribution(
        self, policy: nn.Module, layer: HiddenUnits, usefulness: "Usefulness", activations: dict[str, th.Tensor]
    ) -> th.Tensor:
        """Of each unit to the next layers, ``(n_units,)``."""
        contributions = {}
        for name in layer.outgoing:
            activation = activations[name]
            if self.utility == "adaptable_contribution":
                activation = activation - self._update_means(layer, name, usefulness, activation.mean(dim=0))
            outgoing = policy.get_parameter(f"{name}.weight").transpose(0, 1).flatten(start_dim=1).abs().sum(dim=1)
            contributions[name] = activation.abs().mean(dim=0) * outgoing
        contribution = sum_of_places(layer, contributions)
        if self.utility == "adaptable_contribution":
            incoming = policy.get_parameter(f"{layer.layer}.weight").flatten(start_dim=1).abs().sum(dim=1)
            contribution = contribution / incoming.clamp(min=th.finfo(incoming.dtype).tiny)
        return contribution

    def _update_means(self, layer: HiddenUnits, name: str, usefulness: "Usefulness", mean: th.Tensor) -> th.Tensor:
        """The corrected running average of each input channel, which sees its unit for the ``ages``-th time."""
        ages = usefulness.ages[layer.outgoing[name]]
        old = usefulness.means.get(name, th.zeros_like(mean))
        # As Adam's correction: the average of the first n values has weights that sum up to 1
        share = (1 - self.decay_rate) / (1 - self.decay_rate**ages)
        usefulness.means[name] = old + share * (mean - old)
        return usefulness.means[name]

    def _choose(self, usefulness: "Usefulness") -> th.Tensor:
        """The units to recycle, a mask ``(n_units,)``."""
        eligible = usefulness.ages > self.maturity_threshold
        n_eligible = int(eligible.sum())
        usefulness.to_recycle += self.replacement_rate * n_eligible
        n_chosen = min(int(usefulness.to_recycle), n_eligible)
        usefulness.to_recycle -= n_chosen
        corrected = usefulness.utility / (1 - self.decay_rate**usefulness.ages)
        chosen = th.zeros_like(eligible)
        chosen[corrected.masked_fill(~eligible, th.inf).topk(n_chosen, largest=False).indices] = True
        return chosen


@dataclass
class Usefulness:
    """
    What is known about the units of a layer.

    :param utility: Their utilities, before the correction for their ages, ``(n_units,)``
    """

    utility: th.Tensor

    def __post_init__(self) -> None:
        self.ages = th.zeros_like(self.utility, dtype=th.int64)  # in updates
        self.to_recycle = 0.0  # units, a fraction as well
        self.means: dict[str, th.Tensor] = {}  # corrected mean activations of the input channels of the next layers


def hand_over_means(network: nn.Module, layer: HiddenUnits, means: dict[str, th.Tensor], units: th.Tensor) -> None:
    """
    Add to the biases of the next layers what the mean activation of units contributes to them.

    :param network: The network
    :param layer: One of its hidden layers
    :param means: For each layer that the units feed, the mean activation of each input channel
    :param units: Which units, ``(n_units,)``, of booleans
    """
    for name, source in layer.outgoing.items():
        bias = network.get_submodule(name).bias
        if isinstance(bias, th.Tensor):
            weight = network.get_parameter(f"{name}.weight")
            of_channels = weight.flatten(start_dim=2).sum(dim=2) if weight.dim() > 2 else weight
            channels = units[source] & (source >= 0)
            bias.add_(of_channels[:, channels] @ means[name][channels])
