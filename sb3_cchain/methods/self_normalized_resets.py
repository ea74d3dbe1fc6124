"""Self-normalized resets."""

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_cchain.methods.hidden_units import hidden_activity
from sb3_cchain.methods.unit_recycling import IntervalRecycling
from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.tensorboard.layout import add_charts
from sb3_cchain.validation import check_number

add_charts(
    "Related methods",
    {
        "Self-normalized resets: units recycled the last time, share": "self_normalized_resets/dormant_share(/.+)?",
        "Self-normalized resets: units recycled": "self_normalized_resets/n_recycled",
    },
)


class SelfNormalizedResets(IntervalRecycling):
    r"""
    Recycles a hidden unit when it has been silent for longer than it used to be (self-normalized resets, SNR): when

    .. math:: P(A_i \ge a_i) \le \eta

    for the time :math:`a_i` since it last fired and the distribution :math:`A_i` of its own earlier times between firings.

    Paper: "Self-Normalized Resets for Plasticity in Continual Learning", https://arxiv.org/abs/2410.20098 (Farias & Jozefiak,
    ICLR 2025). As in its code (https://github.com/ajozefiak/SelfNormalizedResets):

    - Time is counted in batches of observations, here one every ``interval``. A unit fires when it is above 0 on at least one
      observation of the batch; a filter, at one position of one of them.
    - :math:`\eta` acts by a threshold of each unit: a unit that was silent for as many batches in a row is recycled. At
      first it is ``max_threshold``. Every ``update_interval`` batches it becomes the shortest time that at least the share
      :math:`1 - \eta` of the unit's silences since the last time did not exceed, if that is below the threshold; otherwise
      the threshold doubles, up to ``max_threshold``. Silences that ended with a recycling count, too. For a unit that was
      never silent it becomes 1.

    Which units are recycled, and how, is described at :class:`ReDo`. A unit behind a ReLU that is silent contributes nothing
    to the outputs, so they stay the same on that batch. It is meant for ReLU: SB3's PPO has Tanh by default, whose units fire
    in almost any batch.

    It costs one forward pass of the batch every ``interval``, and a construction of the policy when units are recycled.

    Logged: ``self_normalized_resets/n_recycled``, the units recycled since ``learn()`` was called;
    ``self_normalized_resets/dormant_share``, the share that was recycled the last time, and
    ``self_normalized_resets/dormant_share/<layer>`` of each layer (not in the table on the screen).

    The silences go on when the same callback is given to ``learn()`` again; a new callback begins with none.

    :param eta: η, the rejection threshold. The default is that of the paper's code
    :param max_threshold: First and greatest threshold, in batches; not tuned. The paper's code has 20 000 images in batches of
        100
    :param update_interval: Batches between two updates of the thresholds; not tuned
    :param interval: Between two batches: calls of ``train()`` for on-policy algorithms, gradient updates for DQN; None for
        1 and 100
    :param batch_size: Observations in a batch
    :raises ValueError: Naming the argument that is out of its range; when training starts, for a network in which there is no
        unit that can be recycled
    :raises TypeError: When training starts, for an algorithm that is neither on-policy nor DQN, for recurrent networks, and
        for the policies of :class:`PlasticityInjection`
    """

    name = "self_normalized_resets"

    def __init__(
        self,
        eta: float = 0.01,
        max_threshold: int = 100,
        update_interval: int = 100,
        interval: int | None = None,
        batch_size: int = 256,
    ):
        super().__init__(interval, batch_size, defaults=(1, 100))
        check_number("eta", eta, 0, 1)
        check_number("max_threshold", max_threshold, 1, integer=True)
        check_number("update_interval", update_interval, 1, integer=True)
        self.eta = eta
        self.max_threshold = max_threshold
        self.update_interval = update_interval

    def _begin(self) -> None:
        device = self.model.device
        self._silences = [Silences(layer.n_units, self.max_threshold, device) for layer in self._layers]
        self._n_batches = 0

    def _choose(self, observations: PyTorchObs) -> list[th.Tensor]:
        policy, forward = uncompiled(self.model.policy), self._forward(observations)
        fired = hidden_activity(policy, self._layers, forward, measure=lambda matrix: (matrix > 0).any(dim=0).float())
        self._n_batches += 1
        chosen = []
        for silences, layer_fired in zip(self._silences, fired, strict=True):
            silences.count(layer_fired > 0)
            if self._n_batches % self.update_interval == 0:
                silences.update_thresholds(self.eta)
            chosen.append(silences.end_long_ones())
        return chosen


class Silences:
    """
    How long the units of a layer are silent.

    :param n_units: Number of units
    :param max_threshold: First and greatest threshold, in batches
    :param device: Device of the network
    """

    def __init__(self, n_units: int, max_threshold: int, device: th.device):
        # Batches since each unit last fired; after how many it is recycled; how many silences had which length
        self.ages = th.zeros(n_units, dtype=th.int64, device=device)
        self.thresholds = th.full_like(self.ages, max_threshold)
        self.n_of_length = th.zeros(n_units, max_threshold + 1, dtype=th.int64, device=device)

    @property
    def max_threshold(self) -> int:
        """The greatest threshold. No silence is longer."""
        return self.n_of_length.shape[1] - 1

    def _end(self, units: th.Tensor) -> None:
        self.n_of_length[units, self.ages[units]] += 1
        self.ages[units] = 0

    def count(self, fired: th.Tensor) -> None:
        """
        Count a batch.

        :param fired: Which units fired in it, ``(n_units,)``, of booleans
        """
        self._end(fired)
        self.ages[~fired] += 1

    def update_thresholds(self, eta: float) -> None:
        """
        Fit the thresholds to the silences since the last time.

        :param eta: η
        """
        cumulated = self.n_of_length[:, 1:].cumsum(dim=1)  # a length of 0 is no silence
        enough = cumulated >= (1 - eta) * cumulated[:, -1:]
        percentile = enough.int().argmax(dim=1) + 1
        longer = (2 * self.thresholds).clamp(max=self.max_threshold)
        self.thresholds = th.where(percentile < self.thresholds, percentile, longer)
        self.n_of_length = th.zeros_like(self.n_of_length)

    def end_long_ones(self) -> th.Tensor:
        """
        :return: The units that were silent for as long as their threshold, ``(n_units,)``, of booleans. They begin again.
        """
        chosen = self.ages >= self.thresholds
        self._end(chosen)
        return chosen
