"""
The one signal that the task has switched.

Callbacks, methods, metrics and the reset of λ all listen to it: each of them keeps a :class:`TaskSwitch` and shows it the
present task, as :func:`step_task` or :func:`episode_task` tell it. Both ask the same sources, in this order:

1. The environment, which numbers its tasks in ``info["task_id"]``, as :class:`~sb3_cchain.ContinualEnv` does.
2. The model's ``set_env()``: where the environment gives no number, the next task begins when the model is trained in another
   environment than before. An environment that comes again is a new task, too.

Another source of switches (a call by the user, a test that detects them) belongs here, in ``step_task``.
"""

from typing import Any
from weakref import WeakKeyDictionary, ref

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv


class TaskSwitch:
    """
    What one listener last heard of the task.

    :param task_id: The last task that the listener knows of; None for a listener that has not heard of any
    """

    def __init__(self, task_id: Any = None):
        self.task_id = task_id

    def happened(self, task_id: Any) -> bool:
        """
        :param task_id: The present task
        :return: Whether it is another task than the last time
        """
        previous, self.task_id = self.task_id, task_id
        # An environment may number its tasks by arrays
        return previous is not None and previous is not task_id and not np.array_equal(previous, task_id)


def step_task(model: BaseAlgorithm, infos: list[dict[str, Any]]) -> Any:
    """
    :param model: A model during ``learn()``
    :param infos: The infos of a step
    :return: The task that the step was made in. It tells of a switch one step after the switch.
    """
    info = infos[0]
    return info["task_id"] if "task_id" in info else _env_number(model)


def episode_task(model: BaseAlgorithm) -> Any:
    """
    :param model: A model during ``learn()``
    :return: The task that the next step will be made in. It tells of a switch at once: the step that ends a task ends an
        episode, and the vectorised environment has already begun the next episode.
    """
    assert model.env is not None
    return step_task(model, [first_reset_info(model.env)])


def first_reset_info(env: VecEnv) -> dict[str, Any]:
    """
    :param env: A vectorised environment
    :return: The info with which the present episode of its first environment began; environments side by side switch together
    """
    return env.unwrapped.reset_infos[0]


# The environment that each model was last trained in. It is not saved with the model: where training is resumed, the same
# environment is another object.
_last_envs: WeakKeyDictionary[BaseAlgorithm, ref[Any]] = WeakKeyDictionary()


def _env_number(model: BaseAlgorithm) -> int:
    """How often the model has changed to another environment. The number is kept as ``model.env_number``."""
    assert model.env is not None
    env = model.env.unwrapped
    # set_env() wraps the same environment again
    env = env.envs[0].unwrapped if hasattr(env, "envs") else env
    if model.num_timesteps == 0:
        model.env_number = 0  # type: ignore[attr-defined]
    elif model in _last_envs and _last_envs[model]() is not env:
        model.env_number = getattr(model, "env_number", 0) + 1  # type: ignore[attr-defined]
    _last_envs[model] = ref(env)
    return getattr(model, "env_number", 0)


def is_continual(env: VecEnv | None) -> bool:
    """
    :param env: A vectorised environment
    :return: Whether it consists of :class:`~sb3_cchain.ContinualEnv`
    """
    return env is not None and env.has_attr("task_sequence") and env.has_attr("set_clock")


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


def require_tasks(callback: BaseCallback) -> None:
    """
    :param callback: A callback that acts when the task switches, when training starts
    :raises TypeError: When there cannot be a switch: the environment is not continual, and this call of ``learn()`` neither
        continues training nor says that it is one of several
    """
    if callback.locals.get("reset_num_timesteps", True):
        try:
            require_continual(callback)
        except TypeError as error:
            raise TypeError(
                f"{error} Or train in one environment after the other, each given by `model.set_env()` and "
                "trained in by `model.learn(..., reset_num_timesteps=False)`."
            ) from None
