"""Acting between two tasks."""

from abc import abstractmethod

from stable_baselines3.common.callbacks import BaseCallback

from sb3_cchain.tasks.listening import start_listening
from sb3_cchain.tasks.signal import TaskSwitch, episode_task, warn_of_half_told_tasks


class TaskBoundary(BaseCallback):
    """
    Base of callbacks that act when the task has switched: that of a :class:`~sb3_cchain.ContinualEnv`, by the word of a
    :class:`~sb3_cchain.TaskSignal`, or from one call of ``learn(..., reset_num_timesteps=False)`` to the next the environment
    that ``set_env()`` gave.

    They act between rollouts: before the first action of the first rollout that begins in the new task. Where tasks last
    for whole rollouts, as in the paper's experiments, and in DQN with ``train_freq=1``, that is exactly at the switch: no
    sample of the new task was seen by the old network. (``info["task_id"]`` tells of a switch a step later.) Otherwise the
    rollout under way is completed and trained on as if nothing had happened, up to ``n_steps - 1`` (PPO) or
    ``train_freq - 1`` (DQN) steps per environment late; a network that changed in the middle of a rollout would be trained on
    advantages and probabilities that another network computed.

    A subclass has the method ``_on_task_switch()``, which is called then. If it also has ``_on_training_start()`` or
    ``_on_rollout_start()``, these must call ``super()``'s, which listen to the switches. One that changes the network calls
    :func:`~sb3_cchain.methods.forget_references`.

    The task is kept with the model, as ``model.trained_task_id``, so that training that is saved at a switch and resumed
    has it too.
    """

    def _on_training_start(self) -> None:
        start_listening(self)
        # Training that begins at step 0 begins with its first task, not with what the model was trained on before
        known = getattr(self.model, "trained_task_id", None) if self.num_timesteps > 0 else None
        self._switch = TaskSwitch(known)

    def _on_rollout_start(self) -> None:
        if "infos" in self.locals:  # those of the rollout before
            warn_of_half_told_tasks(self.training_env, self.locals["infos"][0])
        switched = self._switch.happened(episode_task(self.model))
        self.model.trained_task_id = self._switch.task_id  # type: ignore[attr-defined]
        if switched:
            self._on_task_switch()

    def _on_step(self) -> bool:
        return True

    @abstractmethod
    def _on_task_switch(self) -> None:
        """Called between the rollouts of two tasks."""
