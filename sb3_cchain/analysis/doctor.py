"""Watches over training, and says when it turns ill."""

import math
import warnings

import torch as th
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_cchain.analysis.findings import CHECKS, Finding, diagnose
from sb3_cchain.analysis.model_outputs import ModelOutputs, model_outputs
from sb3_cchain.analysis.reference_batch import sample_batch
from sb3_cchain.analysis.symptoms import (
    Symptoms,
    action_std,
    is_finite,
    note_gradients,
    policy_change,
    symptoms_of,
    value_symptoms,
    weight_matrices,
    weight_symptoms,
)
from sb3_cchain.analysis.training_interval import TrainingInterval
from sb3_cchain.callbacks.training_hooks import TrainingHooks
from sb3_cchain.checkpoint.random_state import unchanged_random_state
from sb3_cchain.networks.batch_outputs import Batch
from sb3_cchain.networks.model_optimizers import model_optimizers
from sb3_cchain.tasks.callback_tree import require_unchanged_network
from sb3_cchain.tensorboard.layout import add_charts
from sb3_cchain.validation import check_number

add_charts("Doctor", {"Findings": "doctor/n_findings"})


class Doctor(TrainingInterval):
    """
    Looks for what goes wrong in training, such as a policy that always acts alike or units that are dead, and warns. The
    findings, their thresholds and what to try are those of ``sb3-cchain inspect``.

    It looks at the first rollout that the model learns from, and then at each in which a multiple of ``interval`` was reached:
    at the data before ``train()``, at the gradients in it, and at the networks after it. A finding that holds at ``patience``
    looks in a row is a ``UserWarning``, once in a training; NaN or infinite parameters are warned of at once. A warning is not
    given again after the training was resumed.

    Logged at each look: ``doctor/n_findings``, how many findings there are, and of each measure the worst one of all parts of
    the network, as ``doctor/<measure>`` (not in the table on the screen).

    Training is not changed, its random numbers included. Each look costs some forward passes of the batch and singular values
    of the features, 8 ms of processor time for PPO's default network; and a norm for each weight matrix in each update of that
    ``train()``.

    :param interval: Calls of ``train()`` for on-policy algorithms, gradient updates for off-policy ones; None for 10 and 1000
    :param batch_size: Observations to look at
    :param patience: Looks in a row at which a finding must hold before there is a warning
    :raises ValueError: Naming the argument that is out of its range
    :raises TypeError: When training starts, for an algorithm that is neither on-policy nor off-policy (ARS)
    """

    # At the latest look
    symptoms: Symptoms
    findings: list[Finding]

    def __init__(self, interval: int | None = None, batch_size: int = 256, patience: int = 2):
        super().__init__(interval, default_on_policy=10, default_off_policy=1000)
        check_number("batch_size", batch_size, 2, integer=True)
        check_number("patience", patience, 1, integer=True)
        self.batch_size = batch_size
        self.patience = patience
        self.symptoms, self.findings = {}, []
        # How often in a row each finding was made, by name; those that there was a warning of
        self._n_in_a_row: dict[str, int] = {}
        self._warned: list[str] = []
        # Before train(): the batch, the outputs, and the standard deviation of actions
        self._before: tuple[Batch, ModelOutputs, th.Tensor | None] | None = None
        self._hooks = TrainingHooks()

    def _on_training_start(self) -> None:
        require_unchanged_network(self)
        super()._on_training_start()
        self._hooks.begin(self.model)
        self._before = None  # may be left from training that was interrupted
        if self.locals["reset_num_timesteps"]:
            self._n_in_a_row, self._warned = {}, []

    def _on_rollout_end(self) -> None:
        if not self._is_due_to_look():
            return
        with unchanged_random_state():
            batch = sample_batch(self.model, self.batch_size)
            self._before = (batch, *self._outputs(batch))
            self.symptoms = {**symptoms_of(self.model, batch), **value_symptoms(self.model, self.batch_size)}
        weights = weight_matrices(self.model)
        for optimizer in model_optimizers(self.model).values():
            self._hooks.before_step(optimizer, lambda optimizer: note_gradients(self.symptoms, weights, optimizer))

    def _outputs(self, batch: Batch) -> tuple[ModelOutputs, th.Tensor | None]:
        is_continuous = isinstance(self.model, OnPolicyAlgorithm) and hasattr(self.model.policy, "log_std")
        return model_outputs(self.model, batch), action_std(self.model, batch) if is_continuous else None

    def _on_rollout_start(self) -> None:
        # train() is over
        self._hooks.remove()
        if self._before is None:
            return
        (batch, old, old_std), self._before = self._before, None
        self.symptoms |= weight_symptoms(self.model)
        if isinstance(self.model, OnPolicyAlgorithm) and is_finite(self.model):
            with unchanged_random_state():
                new, new_std = self._outputs(batch)
            change = policy_change(old, new, old_std, new_std)
            if change is not None:
                self.symptoms["policy_change"] = change
        self.findings = diagnose(self.symptoms, self.model)
        self._log()
        self._warn()

    def _on_training_end(self) -> None:
        self._on_rollout_start()

    def _log(self) -> None:
        self.logger.record("doctor/n_findings", len(self.findings))
        for check in CHECKS:
            worst = check.worst(self.symptoms)
            if worst is not None:
                # The screen has no place for them
                self.logger.record(f"doctor/{check.measure}", worst[1], exclude=("stdout", "log"))

    def _warn(self) -> None:
        self._n_in_a_row = {f.check.name: self._n_in_a_row.get(f.check.name, 0) + 1 for f in self.findings}
        for finding in self.findings:
            name = finding.check.name
            # Where parameters are not finite there may be no other look
            is_sure = self._n_in_a_row[name] >= self.patience or math.isinf(finding.value)
            if is_sure and name not in self._warned:
                self._warned.append(name)
                advice = "; ".join(remedy.title for remedy in finding.remedies)
                warnings.warn(f"At step {self.num_timesteps}: {finding.sentence()}{f' Try: {advice}.' if advice else ''}")
