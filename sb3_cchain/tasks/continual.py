"""Whether an environment is a continual one, made of :class:`~sb3_cchain.ContinualEnv`."""

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv


def is_continual(env: VecEnv | None) -> bool:
    """
    :param env: A vectorised environment
    :return: Whether it consists of :class:`~sb3_cchain.ContinualEnv`
    """
    if env is None:
        return False
    try:
        return env.has_attr("set_clock") and env.get_attr("task_sequence", indices=0)[0] is not None
    except Exception:  # vectorised environments that have no attributes to give may raise any error
        return False


def require_continual(callback: BaseCallback) -> None:
    """
    :param callback: A callback for continual environments, when training starts
    :raises TypeError: When the training environment is not continual
    """
    if not is_continual(callback.training_env):
        raise TypeError(
            f"{type(callback).__name__} is for continual environments, but the training environment is not one. "
            'Make it with gymnasium.make("Continual/...") or sb3_cchain.ContinualEnv.'
        )
