"""Logs how healthy a model's networks are while it learns."""

import torch as th

from sb3_cchain.analysis.health_figures import network_health, remember_initial_parameters, trained_groups
from sb3_cchain.analysis.metrics.norms import group_norms
from sb3_cchain.analysis.reference_batch import sample_batch
from sb3_cchain.analysis.training_interval import TrainingInterval
from sb3_cchain.callbacks.training_hooks import TrainingHooks
from sb3_cchain.checkpoint.random_state import unchanged_random_state
from sb3_cchain.networks.model_optimizers import model_optimizers
from sb3_cchain.validation import check_number


class NetworkHealth(TrainingInterval):
    r"""
    Logs, under ``health/``, figures that are known to go along with the loss of plasticity. For formulas and sources see
    :func:`~sb3_cchain.analysis.health_figures.network_health`, which computes

    - ``dormant_share``: share of the hidden units that are τ-dormant
    - ``active_share``: share of the pairs of unit and observation with a positive activation, for ReLU, ReLU6 and CReLU
    - ``feature_srank``, ``feature_effective_rank``: ranks of the features, the outputs of a group's last activation function
    - ``weight_norm``: :math:`\|\theta\|_2`
    - ``distance_from_init``: :math:`\|\theta - \theta_0\|_2`. :math:`\theta_0` is what the parameters were when training with
      this callback first started. It is kept as ``model.initial_parameters``, and so saved and loaded with the model, whose
      file grows by the size of the parameters.

    and to which this callback adds

    - ``gradient_norm``: :math:`\|g\|_2` of the latest update of each parameter, as its optimiser got it: with churn reduction
      and other extra gradients, after clipping. Absent before ``learn()`` has made an update, and for TRPO's policy, which
      no optimiser steps.

    Each is logged over the whole model, except for the ranks, which belong to one matrix; and as ``health/<name>/<group>`` of
    each group of layers, such as ``mlp_extractor.policy_net`` (not in the table on the screen).

    It acts at the end of the first rollout after which the model learns, before that update; then at the end of each rollout
    in which a multiple of ``interval`` was reached. The observations are of that rollout, or, off-policy, of the replay
    buffer. Training is not changed, its random numbers included.

    Works with the on-policy and off-policy algorithms of SB3 and sb3-contrib. Recurrent networks see each observation as an
    episode's first.

    Each time costs a forward pass of the batch, and the singular values of the features of each group: on one CPU core, with
    256 observations, 1 ms for 64 features, 8 ms for 256, 0.1 s for 2048. Each update costs one norm for each parameter tensor,
    in all 0.03 ms for PPO's default network.

    :param interval: Calls of ``train()`` for on-policy algorithms, gradient updates for off-policy ones; None for 10 and
        1000, at which it costs little
    :param batch_size: Observations to look at, and the greatest rank that features can show. The default is that of the code
        of Sokar et al. (2023) for dormant units.
    :param tau: τ, the greatest score of a unit that is dormant. The default is that of Sokar et al. (2023).
    :raises ValueError: Naming the argument that is out of its range
    :raises TypeError: When training starts, for an algorithm that is neither on-policy nor off-policy (ARS)
    """

    def __init__(self, interval: int | None = None, batch_size: int = 256, tau: float = 0.025):
        super().__init__(interval, default_on_policy=10, default_off_policy=1000)
        check_number("batch_size", batch_size, 1, integer=True)
        check_number("tau", tau, 0)
        self.batch_size = batch_size
        self.tau = tau
        self._hooks = TrainingHooks()

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._hooks.begin(self.model)
        remember_initial_parameters(self.model)
        self._gradient_norms: dict[th.Tensor, th.Tensor] = {}
        # After train(), gradients are not what they were at the step: SAC's actor loss adds its own to the critic's
        for optimizer in model_optimizers(self.model).values():
            self._hooks.before_step(optimizer, self._before_step)

    def _on_training_end(self) -> None:
        self._hooks.remove()

    def _before_step(self, optimizer: th.optim.Optimizer) -> None:
        for group in optimizer.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    self._gradient_norms[parameter] = th.linalg.vector_norm(parameter.grad)

    def _on_rollout_end(self) -> None:
        if self._is_due_to_look():
            self._log()

    def gradient_norms(self) -> dict[str, float]:
        """
        :return: ``gradient_norm`` and ``gradient_norm/<group>`` of the latest update; nothing before the first
        """
        norms = {
            group: [self._gradient_norms[parameter] for parameter in parameters.values() if parameter in self._gradient_norms]
            for group, parameters in trained_groups(self.model).items()
        }
        known = {group: latest for group, latest in norms.items() if latest}
        return group_norms("gradient_norm", known) if known else {}

    def _log(self) -> None:
        with unchanged_random_state():
            batch = sample_batch(self.model, self.batch_size)
            health = network_health(self.model, batch["observations"], self.tau)
        for name, value in {**health, **self.gradient_norms()}.items():
            # The screen has no place for long names
            self.logger.record(f"health/{name}", value, exclude=("stdout", "log") if "/" in name else None)
