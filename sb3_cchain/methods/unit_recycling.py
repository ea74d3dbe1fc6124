"""What methods have in common that recycle hidden units: they differ in which ones, and when."""

from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import torch as th
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import obs_as_tensor
from torch import nn

from sb3_cchain.analysis.reference_batch import sample_batch
from sb3_cchain.analysis.training_interval import TrainingInterval
from sb3_cchain.methods.adam_rel import reset_step_count
from sb3_cchain.methods.churn_reducers import forget_references
from sb3_cchain.methods.fresh_policy import fresh_policy
from sb3_cchain.methods.hidden_units import HiddenUnits, find_hidden_units
from sb3_cchain.methods.plain_networks import check_plain_networks
from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.networks.evaluation_mode import evaluation_mode
from sb3_cchain.networks.spectral_norm import settle_spectral_norms
from sb3_cchain.tasks.callback_tree import require_single
from sb3_cchain.validation import check_number


class UnitRecycling(BaseCallback):
    """
    Base of callbacks that recycle hidden units of on-policy algorithms and DQN: incoming weights and bias are drawn again from
    the initialisation of the network, outgoing weights become 0, and so do Adam's moments of all these weights. Of DQN the
    Q-network is meant; its target network follows by its usual updates. Units with frozen weights are left alone.
    """

    name: ClassVar[str]  # prefix in the log
    reset_steps = False  # whether Adam's step counts become 0, too

    model: OnPolicyAlgorithm | DQN

    def _init_callback(self) -> None:
        check_plain_networks(type(self).__name__, self.model)

    def _on_training_start(self) -> None:
        super()._on_training_start()
        require_single(self)
        self.n_recycled: int = 0
        policy = uncompiled(self.model.policy)
        with evaluation_mode(policy):
            found = self._find_layers(policy, self._forward(_zeros(self.model)))
        self._layers = [layer for layer in found if layer.is_trained(policy)]
        if not self._layers:
            raise ValueError(
                f"{type(self).__name__} finds no hidden unit that is trained and has outgoing weights of its own in {policy}"
            )
        begun_with = (policy, [layer.layer for layer in self._layers])
        if getattr(self, "_begun_with", None) != begun_with:
            self._begun_with = begun_with
            self._begin()

    def _begin(self) -> None:
        """Called when training starts, but not again when the callback goes on with the same layers of the same policy."""

    def _find_layers(self, policy: nn.Module, run: Callable[[], Any]) -> list[HiddenUnits]:
        return find_hidden_units(policy, run)

    def _forward(self, observations: PyTorchObs) -> Callable[[], Any]:
        if isinstance(self.model, DQN):
            return partial(self.model.q_net, observations)
        policy = uncompiled(self.model.policy)
        return lambda: (policy.get_distribution(observations), policy.predict_values(observations))

    def _recycle_units(self, chosen: list[th.Tensor]) -> None:
        """Recycle units, a mask for each layer, if there are any."""
        n_chosen = sum(int(units.sum()) for units in chosen)
        self.n_recycled += n_chosen
        if n_chosen:
            policy, fresh = uncompiled(self.model.policy), fresh_policy(self.model)
            for layer, units in zip(self._layers, chosen, strict=True):
                recycle_units(layer, units, policy, fresh, policy.optimizer, self.reset_steps)
            settle_spectral_norms(policy)


class IntervalRecycling(UnitRecycling, TrainingInterval):
    """
    Base of those that recycle every ``interval``: on-policy after ``train()``, with observations of the rollout that it was
    trained on; DQN with a sample of the replay buffer. C-CHAIN then forgets its reference batch, so that churn reduction does
    not undo the recycling.

    Logged: ``<name>/n_recycled``, the units recycled since ``learn()`` was called; ``<name>/dormant_share``, the share
    of all units that was recycled the last time, and ``<name>/dormant_share/<layer>``, that of each layer (not in the table on
    the screen).

    :param interval: As for ``TrainingInterval``
    :param batch_size: Observations to look at
    :param defaults: The default intervals of on-policy algorithms and of DQN
    """

    changes_network = True  # between rollouts

    model: OnPolicyAlgorithm | DQN

    def __init__(self, interval: int | None, batch_size: int, defaults: tuple[int, int]):
        super().__init__(interval, *defaults)
        check_number("batch_size", batch_size, 1, integer=True)
        self.batch_size = batch_size
        self._observations: PyTorchObs | None = None

    @abstractmethod
    def _choose(self, observations: PyTorchObs) -> list[th.Tensor]:
        """The units to recycle, a mask ``(n_units,)`` for each layer."""

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._observations = None

    def _on_rollout_end(self) -> None:
        # The buffer is emptied between train() and the next rollout's start
        if isinstance(self.model, OnPolicyAlgorithm) and self._is_due():
            self._observations = sample_batch(self.model, self.batch_size)["observations"]

    def _on_rollout_start(self) -> None:
        # train() is over
        self.model.policy.set_training_mode(False)
        if isinstance(self.model, DQN) and self._is_due():
            self._observations = sample_batch(self.model, self.batch_size)["observations"]
        if self._observations is not None:
            self._recycle(self._observations)
            self._observations = None

    def _on_training_end(self) -> None:
        self._on_rollout_start()  # not left to the next `learn()`

    def _recycle(self, observations: PyTorchObs) -> None:
        n_before = self.n_recycled
        chosen = self._choose(observations)
        self._recycle_units(chosen)
        if self.n_recycled > n_before:
            forget_references(self)
        self.logger.record(f"{self.name}/n_recycled", self.n_recycled)
        self.logger.record(f"{self.name}/dormant_share", (self.n_recycled - n_before) / sum(map(len, chosen)))
        for layer, units in zip(self._layers, chosen, strict=True):
            share = units.float().mean().item()
            self.logger.record(f"{self.name}/dormant_share/{layer.layer}", share, exclude=("stdout", "log"))


def recycle_units(
    layer: HiddenUnits,
    units: th.Tensor,
    network: nn.Module,
    fresh: nn.Module,
    optimizer: th.optim.Optimizer,
    reset_steps: bool = False,
) -> None:
    """
    Draw the incoming weights again, and set the outgoing ones and the moments of both to 0.

    :param layer: A hidden layer of the network
    :param units: Which of its units to recycle, ``(n_units,)``, of booleans
    :param network: The network
    :param fresh: The same with fresh parameters
    :param optimizer: Adam or another optimiser that keeps moments of the parameters' shapes in its ``state``
    :param reset_steps: Whether to set its step counts of these parameters to 0, too
    """

    def assign(name: str, index: Any, draw: bool = True) -> None:
        parameter = network.get_parameter(name)
        with th.no_grad():
            parameter[index] = fresh.get_parameter(name)[index] if draw else 0.0
        for moment in optimizer.state.get(parameter, {}).values():
            if th.is_tensor(moment) and moment.shape == parameter.shape:
                moment[index] = 0.0
        if reset_steps:
            reset_step_count(optimizer, [parameter])

    def assign_all(module: str, index: th.Tensor) -> None:
        for name, _ in network.get_submodule(module).named_parameters():
            assign(f"{module}.{name}", index)

    if units.any():
        if layer.has_weights:
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
