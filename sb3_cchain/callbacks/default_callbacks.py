"""What an algorithm adds by itself when its environment is continual, or a TaskSignal says when it changes."""

from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.vec_env import VecEnv

from sb3_cchain.callbacks.continual_metrics import ContinualMetrics
from sb3_cchain.tasks.callback_tree import iterate_callbacks
from sb3_cchain.tasks.signal import is_continual
from sb3_cchain.tasks.sync import TaskSync
from sb3_cchain.tasks.task_signal import TaskSignal


def with_continual_callbacks(given: list[BaseCallback], env: VecEnv | None) -> list[BaseCallback]:
    """
    :param given: The callbacks of ``learn()``
    :param env: The training environment
    :return: The same, in a continual environment preceded by TaskSync and ContinualMetrics; with a TaskSignal among them,
        followed by ContinualMetrics in any environment. What is already there is not added.
    """
    present = list(iterate_callbacks(CallbackList(given)))

    def has(kind: type[BaseCallback]) -> bool:
        return any(isinstance(callback, kind) for callback in present)

    sync = [TaskSync()] if is_continual(env) and not has(TaskSync) else []
    metrics = [ContinualMetrics()] if (is_continual(env) or has(TaskSignal)) and not has(ContinualMetrics) else []
    return [*sync, *given, *metrics] if has(TaskSignal) else [*sync, *metrics, *given]
