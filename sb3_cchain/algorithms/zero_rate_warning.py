"""Training that learns nothing, because a schedule has brought the learning rate to 0, says so."""

import warnings
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback


class ZeroRateWarning(BaseAlgorithm):
    """
    Warns once in a ``learn()`` when a schedule trains with learning rate 0: from the first update on, or before the end of the
    schedule. The last update of a ``learn()``, where SB3's linear schedules come to 0, is no reason to warn.
    """

    # No update of this `learn()` has been made; it has not warned yet
    _is_first_update = True
    _may_warn = True

    def _init_callback(self, *args: Any, **kwargs: Any) -> BaseCallback:
        self._is_first_update = self._may_warn = True
        return super()._init_callback(*args, **kwargs)

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        super()._update_learning_rate(optimizers)
        progress = self._current_progress_remaining
        is_early = self._is_first_update or progress > 0
        if self._may_warn and is_early and self.lr_schedule(progress) == 0 < self.lr_schedule(1.0):
            self._may_warn = False
            when = "the first update of this `learn()`" if self._is_first_update else f"step {self.num_timesteps}"
            warnings.warn(
                f"The learning rate is 0 from {when} on, so nothing is learned. SB3's schedules go to their end within each "
                "`learn()`. Give it `sb3_cchain.callbacks.OverallSchedule(total_timesteps)`, or TaskSchedule, for schedules "
                "that go on from one `learn()` to the next."
            )
        self._is_first_update = False
