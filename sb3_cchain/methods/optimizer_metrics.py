"""Logs the metrics of wrapped optimisers."""

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_cchain.methods.optimizer_wrapper import OptimizerWrapper
from sb3_cchain.methods.output_layers import check_output_layers
from sb3_cchain.networks.model_optimizers import model_optimizers
from sb3_cchain.tasks.callback_tree import require_every_rollout


class OptimizerMetrics(BaseCallback):
    """
    Logs the metrics of the model's optimisers, such as ``trac/scale`` and ``l2_init/distance``: at the end of each rollout,
    with off-policy algorithms at the end of each episode. They describe the updates before it.

    With separate optimisers of actor and critic (SAC, TD3) the names end in ``_actor`` and ``_critic``.

    It raises a ``TypeError`` when no optimiser of the model is an :class:`~sb3_cchain.methods.OptimizerWrapper`, and a
    ``ValueError`` when one acts on weights that it is to leave alone: on output layers, as ``n_output_layers`` does not fit
    the policy, or on the ``log_std`` of gSDE.
    """

    def _init_callback(self) -> None:
        optimizers = model_optimizers(self.model)
        if not any(isinstance(optimizer, OptimizerWrapper) for optimizer in optimizers.values()):
            names = ", ".join(type(optimizer).__name__ for optimizer in optimizers.values())
            raise TypeError(
                "OptimizerMetrics needs an optimiser of sb3_cchain.methods, as policy_kwargs=dict(optimizer_class=TRAC); "
                f"{type(self.model).__name__} has {names or 'none'}"
            )
        check_output_layers(self.model)

    def _on_training_start(self) -> None:
        require_every_rollout(self)

    def _on_step(self) -> bool:
        # Off-policy rollouts are a few steps long
        if not isinstance(self.model, OnPolicyAlgorithm) and any(self.locals["dones"]):
            self._log()
        return True

    def _on_rollout_end(self) -> None:
        if isinstance(self.model, OnPolicyAlgorithm):
            self._log()

    def _log(self) -> None:
        for name, optimizer in model_optimizers(self.model).items():
            if isinstance(optimizer, OptimizerWrapper):
                for key, value in optimizer.metrics().items():
                    self.logger.record(f"{key}_{name}" if name else key, value)
