"""What an algorithm adds by itself when its environment is continual, or a TaskSignal says when it changes."""

from collections.abc import Iterator

from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.vec_env import VecEnv

from sb3_cchain.callbacks.continual_metrics import ContinualMetrics
from sb3_cchain.tasks.callback_tree import iterate_callbacks
from sb3_cchain.tasks.continual import is_continual
from sb3_cchain.tasks.sync import TaskSync
from sb3_cchain.tasks.task_signal import TaskSignal


def with_continual_callbacks(given: list[BaseCallback], env: VecEnv | None) -> list[BaseCallback]:
    """
    :param given: The callbacks of ``learn()``
    :param env: The training environment
    :return: The same, in a continual environment preceded by TaskSync and ContinualMetrics. With a TaskSignal among them,
        ContinualMetrics is right behind it, in any environment. What is already there is not added.
    """

    def has(kind: type[BaseCallback], callbacks: list[BaseCallback]) -> bool:
        return any(isinstance(callback, kind) for callback in iterate_callbacks(CallbackList(callbacks)))

    sync = [TaskSync()] if is_continual(env) and not has(TaskSync, given) else []
    has_signal = has(TaskSignal, given)
    if has_signal:  # which may be inside a CallbackList
        given = list(_unpacked(given))
    metrics = [ContinualMetrics()] if (is_continual(env) or has_signal) and not has(ContinualMetrics, given) else []
    # Callbacks behind it may change what a step has told, as NoBootstrapAtCuts does
    n_before = next((n for n in range(len(given) + 1) if has(TaskSignal, given[:n])), 0)
    return [*sync, *given[:n_before], *metrics, *given[n_before:]]


def _unpacked(callbacks: list[BaseCallback]) -> Iterator[BaseCallback]:
    for callback in callbacks:
        if type(callback) is CallbackList:  # a subclass may do more than call its callbacks
            yield from _unpacked(callback.callbacks)
        else:
            yield callback
