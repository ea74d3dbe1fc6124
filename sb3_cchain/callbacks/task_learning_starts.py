"""Random actions at the beginning of each task."""

from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cchain.tasks.callback_tree import will_be_restored
from sb3_cchain.tasks.listening import start_listening
from sb3_cchain.tasks.signal import TaskSwitch, episode_task, step_task, warn_of_half_told_tasks
from sb3_cchain.validation import check_number


class TaskLearningStarts(BaseCallback):
    """
    ``learning_starts`` of an off-policy algorithm at the beginning of each task: random actions and no updates, as in the
    continual MinAtar experiments of the C-CHAIN paper. SB3 does so only at the beginning of training.

    A switch in the middle of a rollout is followed from the next rollout on, up to ``train_freq - 1`` steps late.

    Everything else goes on over a switch: replay buffer, exploration rate, optimiser. This is the only thing in that protocol
    that needs to know of a switch. Give it after :class:`~sb3_cchain.TaskSync`, which puts the environment on the task that
    is due when training is resumed.

    :param learning_starts: Environment steps at the beginning of each task, the first included. ``model.learning_starts`` is
        set to it, and at each switch to the time of the switch plus it.
    :raises ValueError: When it is not a non-negative integer
    """

    model: OffPolicyAlgorithm

    def __init__(self, learning_starts: int = 10_000):
        super().__init__()
        check_number("learning_starts", learning_starts, 0, integer=True)
        self.learning_starts = learning_starts

    def _init_callback(self) -> None:
        if not isinstance(self.model, OffPolicyAlgorithm):
            raise TypeError(f"TaskLearningStarts is for off-policy algorithms, got {type(self.model).__name__}")

    def _on_training_start(self) -> None:
        start_listening(self)
        if self.num_timesteps == 0:
            self.model.learning_starts = self.learning_starts
            self.model.learning_starts_task_id = None  # type: ignore[attr-defined]
        self._switch = TaskSwitch(getattr(self.model, "learning_starts_task_id", None))
        if self._switch.task_id is not None and not will_be_restored(self):
            # Training may have been saved at a switch, before this callback heard of it
            self._listen(episode_task(self.model))

    def _on_step(self) -> bool:
        warn_of_half_told_tasks(self.training_env, self.locals["infos"][0])
        if self._switch.task_id is None:
            self._listen(step_task(self.model, self.locals["infos"]))
        self._listen(episode_task(self.model))
        return True

    def _listen(self, task_id: Any) -> None:
        if self._switch.happened(task_id):
            self.model.learning_starts = self.num_timesteps + self.learning_starts
        self.model.learning_starts_task_id = task_id  # type: ignore[attr-defined]
