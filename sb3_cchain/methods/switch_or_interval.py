"""Resetting a network between two tasks, or every so many steps."""

from abc import abstractmethod
from typing import ClassVar

from sb3_cchain.methods.churn_reducers import forget_references
from sb3_cchain.tasks.boundary import TaskBoundary
from sb3_cchain.tasks.callback_tree import require_every_rollout
from sb3_cchain.validation import check_number


class SwitchOrInterval(TaskBoundary):
    """
    Base of callbacks that change the network every ``interval`` environment steps, or at each task switch. They act between
    rollouts, so up to a rollout late. C-CHAIN then forgets its reference batch, so that churn reduction does not undo the
    change. The step at which they last looked is kept with the model, as ``model.<name>_timesteps``.

    Logged: ``<name>/n_resets``, how often it was done since ``learn()`` was called.

    :param interval: Environment steps, in all environments together, counted from the start of the training; None for the
        switches
    :raises ValueError: When it is neither None nor a positive integer
    """

    name: ClassVar[str]
    changes_network = True  # between rollouts

    def __init__(self, interval: int | None):
        super().__init__()
        if interval is not None:
            check_number("interval", interval, 1, integer=True)
        self.interval = interval

    def _on_training_start(self) -> None:
        require_every_rollout(self)
        self.n_resets: int = 0
        if self.interval is None:
            super()._on_training_start()
        # As long as nobody looked, the step that training goes on from
        known = getattr(self.model, f"{self.name}_timesteps", self.num_timesteps)
        self._timesteps = min(known, self.num_timesteps)

    def _on_rollout_start(self) -> None:
        if self.interval is None:
            super()._on_rollout_start()
            return
        before, self._timesteps = self._timesteps, self.num_timesteps
        setattr(self.model, f"{self.name}_timesteps", self._timesteps)
        if self._timesteps // self.interval > before // self.interval:
            self._on_task_switch()

    def _on_task_switch(self) -> None:
        self._act()
        forget_references(self)
        self.n_resets += 1

    def _on_rollout_end(self) -> None:
        self.logger.record(f"{self.name}/n_resets", self.n_resets)

    @abstractmethod
    def _act(self) -> None:
        """Change the network."""
