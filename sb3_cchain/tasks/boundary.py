"""Acting between two tasks."""

from abc import abstractmethod

from stable_baselines3.common.callbacks import BaseCallback

from sb3_cchain.tasks.sync import require_continual


class TaskBoundary(BaseCallback):
    """
    Base of callbacks that act when the task of a :class:`~sb3_cchain.ContinualEnv` has switched.

    They act between rollouts: before the first action of the first rollout that begins in the new task. Where tasks last
    for whole rollouts, as in the paper's experiments, and in DQN with ``train_freq=1``, that is exactly at the switch: no
    sample of the new task was seen by the old network. (``info["task_id"]`` tells of a switch a step later.) Otherwise the
    rollout under way is completed and trained on as if nothing had happened, up to ``n_steps - 1`` (PPO) or
    ``train_freq - 1`` (DQN) steps per environment late; a network that changed in the middle of a rollout would be trained on
    advantages and probabilities that are not its own.

    The task is kept with the model, as ``model.trained_task_id``, so that training that is saved at a switch and resumed
    has it too.
    """

    def _on_training_start(self) -> None:
        require_continual(self, self.training_env)
        # Whatever a model was trained on before, training that begins at step 0 begins with its first task
        self._task_id: int | None = getattr(self.model, "trained_task_id", None) if self.num_timesteps > 0 else None
        self._may_have_switched = True

    def _on_rollout_start(self) -> None:
        if self._may_have_switched:
            self._may_have_switched = False
            previous, self._task_id = self._task_id, self.training_env.get_attr("task_id", indices=0)[0]
            self.model.trained_task_id = self._task_id  # type: ignore[attr-defined]
            if previous not in (None, self._task_id):
                self._on_task_switch()

    def _on_step(self) -> bool:
        # A switch ends an episode, and the vectorised environment has already begun the next one
        self._may_have_switched |= bool(self.locals["dones"].any())
        return True

    @abstractmethod
    def _on_task_switch(self) -> None:
        """Called between the rollouts of two tasks."""
