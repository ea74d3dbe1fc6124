"""Callbacks that act at intervals of the training."""

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_cchain.tasks.callback_tree import require_every_rollout
from sb3_cchain.tensorboard.overview import add_overview
from sb3_cchain.validation import check_number


class TrainingInterval(BaseCallback):
    """
    Base of callbacks that act every ``interval``, on the data of the training.

    :param interval: Calls of ``train()`` for on-policy algorithms, gradient updates for off-policy ones; None for the
        defaults
    :param default_on_policy: Default for on-policy algorithms
    :param default_off_policy: Default for off-policy algorithms
    :raises ValueError: When the interval is not a positive integer
    """

    model: OnPolicyAlgorithm | OffPolicyAlgorithm

    def __init__(self, interval: int | None, default_on_policy: int, default_off_policy: int):
        super().__init__()
        if interval is not None:
            check_number("interval", interval, 1, integer=True)
        self.interval = interval
        self._defaults = default_on_policy, default_off_policy
        # Goes on when `learn()` is called again
        self._has_looked = False

    def _init_callback(self) -> None:
        if not isinstance(self.model, (OnPolicyAlgorithm, OffPolicyAlgorithm)):
            name, algorithm = type(self).__name__, type(self.model).__name__
            raise TypeError(f"{name} is for on-policy and off-policy algorithms, got {algorithm}")

    def _on_training_start(self) -> None:
        require_every_rollout(self)
        add_overview(self.model)
        on_policy = isinstance(self.model, OnPolicyAlgorithm)
        self._interval = self.interval or self._defaults[0 if on_policy else 1]
        self._n_trained = self._count()

    def _on_step(self) -> bool:
        return True

    def _count(self) -> int:
        """Calls of ``train()``, with the one that is due at the end of a rollout; off-policy, the updates."""
        if isinstance(self.model, OnPolicyAlgorithm):
            return self.model.num_timesteps // (self.model.n_steps * self.model.n_envs)
        return self.model._n_updates

    def _is_due(self) -> bool:
        """Whether a multiple of the interval was reached since the last call."""
        before, self._n_trained = self._n_trained, self._count()
        return self._n_trained // self._interval > before // self._interval

    def _is_due_to_look(self) -> bool:
        """At a rollout's end, for callbacks that log: as ``_is_due()``, and at the first one that the model learns from."""
        if isinstance(self.model, OffPolicyAlgorithm) and self.model.num_timesteps <= self.model.learning_starts:
            return False
        is_first, self._has_looked = not self._has_looked, True
        return self._is_due() or is_first
