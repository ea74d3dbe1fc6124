"""Advantages that are normalised over the whole rollout."""

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_cchain.tasks.callback_tree import require_every_rollout


class RolloutNormalizedAdvantage(BaseCallback):
    """
    Normalises the advantages once over the whole rollout, to mean 0 and standard deviation 1. SB3's PPO normalises them for
    each minibatch. Use it with ``normalize_advantage=False``.
    """

    model: OnPolicyAlgorithm

    def _init_callback(self) -> None:
        name = type(self).__name__
        if not isinstance(self.model, OnPolicyAlgorithm):
            raise TypeError(f"{name} is for on-policy algorithms, got {type(self.model).__name__}")
        if getattr(self.model, "normalize_advantage", False):
            raise ValueError(f"{name} normalises the advantages itself: set `normalize_advantage=False`, got True")

    def _on_training_start(self) -> None:
        require_every_rollout(self)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        buffer = self.model.rollout_buffer
        buffer.advantages = (buffer.advantages - buffer.advantages.mean()) / (buffer.advantages.std() + 1e-8)
