"""What an algorithm adds by itself when its environment is continual."""

from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.vec_env import VecEnv

from sb3_cchain.callbacks.continual_metrics import ContinualMetrics
from sb3_cchain.tasks.callback_tree import iterate_callbacks
from sb3_cchain.tasks.signal import is_continual
from sb3_cchain.tasks.sync import TaskSync


def with_continual_callbacks(given: list[BaseCallback], env: VecEnv | None) -> list[BaseCallback]:
    """
    :param given: The callbacks of ``learn()``
    :param env: The training environment
    :return: The same, preceded in a continual environment by the callbacks for it that are not yet there
    """
    if not is_continual(env):
        return given
    present = list(iterate_callbacks(CallbackList(given)))
    needed = (TaskSync, ContinualMetrics)
    return [make() for make in needed if not any(isinstance(callback, make) for callback in present)] + given
