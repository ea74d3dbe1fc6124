"""Random actions at the beginning of each task."""

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_cchain.tasks.sync import require_continual
from sb3_cchain.validation import check_number


class TaskLearningStarts(BaseCallback):
    """
    ``learning_starts`` of an off-policy algorithm at the beginning of each task: random actions and no updates, as in the
    continual MinAtar experiments of the C-CHAIN paper. SB3 does so at the beginning of training alone.

    A switch in the middle of a rollout is followed from the next rollout on, up to ``train_freq - 1`` steps late.

    All else goes on over a switch: replay buffer, exploration rate, optimiser. It is the one thing in that protocol
    that needs to know of a switch.

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
        require_continual(self, self.training_env)
        if self.num_timesteps == 0:
            self.model.learning_starts = self.learning_starts
        self._task_id: int | None = None

    def _on_step(self) -> bool:
        if self._task_id is None:
            self._task_id = self.locals["infos"][0]["task_id"]
        if self.locals["dones"].any():
            # A switch ends an episode, and the vectorised environment has already begun the next one
            task_id = self.training_env.get_attr("task_id", indices=0)[0]
            if task_id != self._task_id:
                self._task_id = task_id
                self.model.learning_starts = self.num_timesteps + self.learning_starts
        return True
