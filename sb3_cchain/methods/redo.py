"""ReDo: recycling dormant neurons."""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch as th
from stable_baselines3 import DQN
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import obs_as_tensor
from torch import nn

from sb3_cchain.analysis.metrics.dormancy import dormant_scores
from sb3_cchain.analysis.training_interval import TrainingInterval
from sb3_cchain.methods.churn_reducers import churn_reducers
from sb3_cchain.methods.fresh_policy import fresh_policy
from sb3_cchain.methods.hidden_units import HiddenUnits, find_hidden_units, hidden_activity
from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.tensorboard.layout import add_charts
from sb3_cchain.validation import check_number

add_charts(
    "Related methods",
    {
        "ReDo: dormant units, share": "redo/dormant_share(/.+)?",
        "ReDo: units recycled": "redo/n_recycled",
    },
)


class ReDo(TrainingInterval):
    r"""
    Recycles dormant neurons (ReDo), Sokar et al. (ICML 2023), https://arxiv.org/abs/2302.12902.

    Every ``interval``, a hidden unit (of a convolution: a filter) whose score

    .. math:: s_i = E_x |h_i(x)| \, / \, \frac{1}{H} \sum_k E_x |h_k(x)|

    on a batch of observations is at most τ is recycled: its incoming weights and bias are drawn again from the initialisation
    of the network, its outgoing weights become 0, and Adam's moments of all these weights become 0 (its step count stays). The
    outputs of the network stay the same, except for the little that the unit contributed.

    On-policy algorithms (PPO, A2C) recycle after ``train()``, on observations of the rollout that it was trained on; DQN on a
    sample of the replay buffer; its target network follows by its usual updates. It works with any chain of linear and
    convolutional layers, with shared or separate networks for policy and value. A unit is recycled only if all of its outgoing
    weights are known. This leaves out the outputs of the network and units whose output is added to a residual stream. In an
    IMPALA network, the first convolution of each residual block and the linear layer are recycled, as in the original code.

    Defaults: τ = 0.025 and 1000 updates are those of the paper's DQN. For on-policy algorithms, 10 iterations and the same τ
    are those of Plasticine's PPO (https://github.com/RLE-Foundation/Plasticine). The batch size 256 is that of the original
    code. The settings in the C-CHAIN paper's comparison have not been published.

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
    :raises ValueError: Naming the argument that is out of its range; when training starts, for a network in which there is no
        unit that can be recycled
    :raises TypeError: When training starts, for an algorithm that is neither on-policy nor DQN, and for recurrent networks
    """

    model: OnPolicyAlgorithm | DQN

    def __init__(self, tau: float = 0.025, interval: int | None = None, batch_size: int = 256):
        super().__init__(interval, default_on_policy=10, default_off_policy=1000)
        check_number("tau", tau, 0)
        check_number("batch_size", batch_size, 1, integer=True)
        self.tau = tau
        self.batch_size = batch_size

    def _init_callback(self) -> None:
        if not isinstance(self.model, (OnPolicyAlgorithm, DQN)):
            raise TypeError(f"ReDo is for on-policy algorithms and DQN, got {type(self.model).__name__}")
        if hasattr(self.model, "_last_lstm_states"):
            raise TypeError(f"ReDo does not know recurrent networks, got {type(self.model).__name__}")

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self.n_recycled = 0
        self._observations: PyTorchObs | None = None
        self.model.policy.set_training_mode(False)
        self._layers = find_hidden_units(uncompiled(self.model.policy), self._forward(_zeros(self.model)))
        if not self._layers:
            raise ValueError(f"ReDo finds no hidden unit with outgoing weights of its own in {self.model.policy}")

    def _on_rollout_end(self) -> None:
        # The buffer is emptied between train() and the next rollout's start
        if isinstance(self.model, OnPolicyAlgorithm) and self._is_due():
            self._observations = self._sample_observations(self.batch_size)

    def _on_rollout_start(self) -> None:
        # train() is over
        self.model.policy.set_training_mode(False)
        if isinstance(self.model, DQN) and self._is_due():
            self._observations = self._sample_observations(self.batch_size)
        if self._observations is not None:
            self._recycle(self._observations)
            self._observations = None

    def _on_training_end(self) -> None:
        self._on_rollout_start()  # not left to the next `learn()`

    def _forward(self, observations: PyTorchObs) -> Callable[[], Any]:
        if isinstance(self.model, DQN):
            return partial(self.model.q_net, observations)
        policy = uncompiled(self.model.policy)
        return lambda: (policy.get_distribution(observations), policy.predict_values(observations))

    def _recycle(self, observations: PyTorchObs) -> None:
        policy = uncompiled(self.model.policy)
        activity = hidden_activity(policy, self._layers, self._forward(observations))
        dormant = [dormant_scores(layer_activity) <= self.tau for layer_activity in activity]
        n_dormant = sum(int(units.sum()) for units in dormant)
        if n_dormant:
            fresh = fresh_policy(self.model)
            for layer, units in zip(self._layers, dormant, strict=True):
                recycle_units(layer, units, policy, fresh, policy.optimizer)
            for reducer in churn_reducers(self):
                reducer.forget_reference()
        self.n_recycled += n_dormant
        self.logger.record("redo/n_recycled", self.n_recycled)
        self.logger.record("redo/dormant_share", n_dormant / sum(map(len, dormant)))
        for layer, units in zip(self._layers, dormant, strict=True):
            share = units.float().mean().item()
            self.logger.record(f"redo/dormant_share/{layer.layer}", share, exclude=("stdout", "log"))


def recycle_units(
    layer: HiddenUnits, units: th.Tensor, network: nn.Module, fresh: nn.Module, optimizer: th.optim.Optimizer
) -> None:
    """
    Draw the incoming weights again, and set the outgoing ones and the moments of both to 0.

    :param layer: A hidden layer of the network
    :param units: Which of its units to recycle, ``(n_units,)``, of booleans
    :param network: The network
    :param fresh: The same with fresh parameters
    :param optimizer: Adam or another optimiser that keeps moments of the parameters' shapes in its ``state``
    """

    def assign(name: str, index: Any, draw: bool = True) -> None:
        parameter = network.get_parameter(name)
        with th.no_grad():
            parameter[index] = fresh.get_parameter(name)[index] if draw else 0.0
        for moment in optimizer.state.get(parameter, {}).values():
            if th.is_tensor(moment) and moment.shape == parameter.shape:
                moment[index] = 0.0

    def assign_all(module: str, index: th.Tensor) -> None:
        for name, _ in network.get_submodule(module).named_parameters():
            assign(f"{module}.{name}", index)

    if units.any():
        assign_all(layer.layer, units)
        for name, source in layer.norms.items():
            index = units[source] & (source >= 0)
            assign_all(name, index.reshape(network.get_parameter(f"{name}.weight").shape))
        for name, source in layer.outgoing.items():
            assign(f"{name}.weight", (slice(None), units[source] & (source >= 0)), draw=False)


def _zeros(model: OnPolicyAlgorithm | DQN) -> PyTorchObs:
    """A batch of one observation of zeros."""
    assert model._last_obs is not None
    tensors = obs_as_tensor(model._last_obs, model.device)
    if isinstance(tensors, dict):
        return {key: th.zeros_like(tensor[:1]) for key, tensor in tensors.items()}
    return th.zeros_like(tensors[:1])
