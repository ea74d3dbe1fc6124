"""
Schedules that know how long training takes, or a task.

Stable-Baselines3's schedules (learning rate, clipping range, exploration rate) are functions of the progress that remains,
from 1 to 0. It counts the progress up to the end of the present ``learn()``, so in training by several calls a schedule comes
to its end in each of them. The callbacks here put in another progress. All schedules of the model follow it. They are given to
the model as always.
"""

import warnings
from collections.abc import Callable
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cchain.callbacks.training_hooks import TrainingHooks
from sb3_cchain.tasks.boundary import TaskBoundary
from sb3_cchain.tasks.callback_tree import iterate_callbacks
from sb3_cchain.validation import check_number


class OverallSchedule(BaseCallback):
    """
    All schedules of the model go to their end once, over all calls of ``learn(..., reset_num_timesteps=False)``.

    Training in several calls is then the same as in one, also when it is saved and resumed, with any algorithm of
    Stable-Baselines3. It warns where a call of ``learn()`` goes on beyond the end; the schedules stay there.

    :param total_timesteps: Environment steps of the whole training
    :raises ValueError: When it is not a positive integer. When training starts, for a second callback that moves schedules
    """

    moves_schedules = True

    def __init__(self, total_timesteps: int):
        super().__init__()
        check_number("total_timesteps", total_timesteps, 1, integer=True)
        self.total_timesteps = int(total_timesteps)
        self._hooks = TrainingHooks()

    def _on_training_start(self) -> None:
        _require_one(self)
        end = self.locals["total_timesteps"]
        if end > self.total_timesteps:
            warnings.warn(
                f"This `learn()` trains up to step {end}, but OverallSchedule has `total_timesteps={self.total_timesteps}`: "
                "schedules stay at their ends from there on, a learning rate that goes to 0 at 0."
            )
        _put_in(self._hooks, self.model, lambda: 1.0 - float(self.model.num_timesteps) / float(self.total_timesteps))

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self._hooks.remove()


class TaskSchedule(TaskBoundary):
    """
    All schedules of the model begin again at each task, and go to their end within it.

    The learning rate, the clipping range and DQN's exploration rate of each task are then those of the first. In a task that
    lasts longer, they stay at their ends. The step at which the task began is kept as ``model.task_schedule_start``.

    :param steps_per_task: Environment steps in which the schedules go to their end
    :raises ValueError: When it is not a positive integer. When training starts, for a second callback that moves schedules
    """

    moves_schedules = True

    def __init__(self, steps_per_task: int):
        super().__init__()
        check_number("steps_per_task", steps_per_task, 1, integer=True)
        self.steps_per_task = int(steps_per_task)
        self._hooks = TrainingHooks()

    def _on_training_start(self) -> None:
        super()._on_training_start()
        _require_one(self)
        model: Any = self.model
        if self.num_timesteps == 0 or not hasattr(model, "task_schedule_start"):
            model.task_schedule_start = self.num_timesteps
        _put_in(
            self._hooks,
            model,
            lambda: 1.0 - float(model.num_timesteps - model.task_schedule_start) / float(self.steps_per_task),
        )

    def _on_task_switch(self) -> None:
        self.model.task_schedule_start = self.num_timesteps  # type: ignore[attr-defined]

    def _on_training_end(self) -> None:
        self._hooks.remove()


def _require_one(callback: BaseCallback) -> None:
    given = iterate_callbacks(callback.locals.get("callback"))
    names = [type(each).__name__ for each in given if getattr(each, "moves_schedules", False)]
    if len(names) > 1:
        raise ValueError(f"`learn()` was given {' and '.join(names)}, which both move schedules: give it one")


def _put_in(hooks: TrainingHooks, model: BaseAlgorithm, progress: Callable[[], float]) -> None:
    def put_in(_: Any) -> None:
        model._current_progress_remaining = max(progress(), 0.0)

    hooks.begin(model)
    hooks.after_call(model, "_update_current_progress_remaining", put_in)
