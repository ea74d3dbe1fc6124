"""What a callback that follows the tasks checks when training starts."""

import warnings

from stable_baselines3.common.callbacks import BaseCallback

from sb3_cchain.tasks.callback_tree import iterate_callbacks, require_every_rollout, require_single, will_be_restored
from sb3_cchain.tasks.continual import require_continual
from sb3_cchain.tasks.signal import active_signal, episode_task
from sb3_cchain.tasks.sync import warn_without_sync
from sb3_cchain.tasks.task_signal import TaskSignal


def start_listening(callback: BaseCallback, needs_switches: bool = True) -> None:
    """
    :param callback: A callback that follows the tasks, when training starts
    :param needs_switches: Whether it is of no use where the task cannot switch
    :raises TypeError: With ``needs_switches``, when there cannot be a switch: there is no :class:`~sb3_cchain.TaskSignal`, the
        environment is not continual, and this call of ``learn()`` begins training anew
    :raises ValueError: When ``learn()`` was given several callbacks of its class, or a TaskSignal behind it, or when
        another callback holds it, see :func:`~sb3_cchain.tasks.callback_tree.require_every_rollout`
    """
    require_every_rollout(callback)
    given = list(iterate_callbacks(callback.locals.get("callback")))
    has_signal = any(isinstance(other, TaskSignal) for other in given)
    if needs_switches and not has_signal:
        _require_tasks(callback)
    require_single(callback)
    warn_without_sync(callback)
    if has_signal and active_signal(callback.training_env) is None:
        name = type(callback).__name__
        raise ValueError(f"TaskSignal must come before {name}, which hears of switches from it: give it to `learn()` first")
    if not any(getattr(other, "moves_schedules", False) for other in given):
        _warn_of_ending_schedule(callback)
    episode_task(callback.model)  # counts from now on


def _warn_of_ending_schedule(callback: BaseCallback) -> None:
    schedule = getattr(callback.model, "lr_schedule", None)
    goes_on = callback.num_timesteps > 0 and not callback.locals.get("reset_num_timesteps", True)
    if goes_on and schedule is not None and schedule(0.0) == 0 < schedule(1.0) and not will_be_restored(callback):
        warnings.warn(
            "The learning rate goes to 0 within each `learn()`, as all of SB3's schedules do. Give each of them "
            "sb3_cchain.callbacks.OverallSchedule(total_timesteps), or TaskSchedule, for schedules that go on from one "
            "`learn()` to the next."
        )


def _require_tasks(callback: BaseCallback) -> None:
    if callback.locals.get("reset_num_timesteps", True):
        try:
            require_continual(callback)
        except TypeError as error:
            raise TypeError(
                f"{error} Or say when the world changes, by a sb3_cchain.TaskSignal before it. Or train in one environment "
                "after the other, each given by `model.set_env()` and trained in by `model.learn(..., "
                "reset_num_timesteps=False)`."
            ) from None
