"""
The one signal that the task has switched.

Callbacks, methods, metrics and the reset of λ all listen to it. Each of them keeps a :class:`TaskSwitch` and shows it the
present task, as :func:`step_task` (after a step) or :func:`episode_task` (before the next one) tells it. Both ask in this
order, and the first that knows the task decides:

1. The :class:`~sb3_cchain.TaskSignal` that ``learn()`` was given, which counts the switches that its source reports.
2. The environment, where it numbers its tasks in ``info["task_id"]`` of steps and resets, as
   :class:`~sb3_cchain.ContinualEnv` does.
3. The model's count of the environments that ``set_env()`` gave and of the calls of :func:`task_switched`.
"""

import warnings
from numbers import Integral
from typing import Any
from weakref import WeakKeyDictionary, WeakSet, ref

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_cchain.tasks.single_envs import single_envs

# Where an environment that numbers its tasks does so
TASK_KEY = "task_id"


class TaskSwitch:
    """
    What one listener last heard of the task.

    :param task_id: The last task that the listener knows of; None for a listener that has not heard of any
    """

    def __init__(self, task_id: Any = None):
        self.task_id: Any = task_id

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
    assert model.env is not None
    signal = active_signal(model.env)
    return _known_task(model, infos[0]) if signal is None else signal.step_task


def episode_task(model: BaseAlgorithm) -> Any:
    """
    :param model: A model during ``learn()``
    :return: The task that the next step will be made in. Where an environment without numbered tasks is another one than
        before, this counts it as a further task. It tells of a switch at once: where the environment numbers its
        tasks, the step that ends a task ends an episode, and the vectorised environment has already begun the next one.
    """
    assert model.env is not None
    signal = active_signal(model.env)
    return _known_task(model, first_reset_info(model.env)) if signal is None else signal.next_task


def displayed_task(model: BaseAlgorithm) -> Any:
    """
    :param model: A model during ``learn()``
    :return: The task of :func:`episode_task`, for a display. Unlike that it does not count a new environment as a task; None
        where environments do not number their tasks and there has been no switch
    """
    assert model.env is not None
    signal = active_signal(model.env)
    if signal is not None:
        return signal.next_task
    n_switches = getattr(model, "task_count", 0)
    return first_reset_info(model.env).get(TASK_KEY, n_switches if n_switches > 0 else None)


def _known_task(model: BaseAlgorithm, info: dict[str, Any]) -> Any:
    return info[TASK_KEY] if TASK_KEY in info else task_count(model)


def first_reset_info(env: VecEnv) -> dict[str, Any]:
    """
    :param env: A vectorised environment
    :return: The info with which the present episode of its first environment began; environments side by side switch together
    """
    return env.unwrapped.reset_infos[0]


# Environments that were warned of
_half_told: WeakSet[VecEnv] = WeakSet()


def warn_of_half_told_tasks(env: VecEnv, info: dict[str, Any]) -> None:
    """
    Warn, once, when an environment numbers its tasks in the infos of steps, but not in those of resets, which
    :func:`episode_task` reads, and there is no :class:`~sb3_cchain.TaskSignal`.

    :param env: A vectorised environment
    :param info: The info of its first environment's last step
    """
    if TASK_KEY not in info or TASK_KEY in first_reset_info(env) or env.unwrapped in _half_told:
        return
    if active_signal(env) is None:
        _half_told.add(env.unwrapped)
        warnings.warn(
            f"The environment has {TASK_KEY!r} in the infos of step(), but not in those of reset(), so that not all that "
            "follows the tasks hears of a switch. Let reset() return it, too, or give `learn()` a TaskSignal."
        )


# The info with which the episode of each model's last step began
_last_reset_infos: WeakKeyDictionary[BaseAlgorithm, dict[str, Any]] = WeakKeyDictionary()


def remember_episode(model: BaseAlgorithm) -> None:
    """
    :param model: A model after a step, whose environment's episode :func:`episode_goes_on` is to recognise
    """
    assert model.env is not None
    _last_reset_infos[model] = first_reset_info(model.env)


def episode_goes_on(model: BaseAlgorithm) -> bool:
    """
    :param model: A model when training starts
    :return: Whether its environment has not been reset since :func:`remember_episode`, as between two calls of
        ``learn(..., reset_num_timesteps=False)``
    """
    assert model.env is not None
    return model in _last_reset_infos and _last_reset_infos[model] is first_reset_info(model.env)


# The TaskSignal that was given to learn(), by the vectorised environment that is trained in
_signals: WeakKeyDictionary[VecEnv, ref[Any]] = WeakKeyDictionary()


def register_signal(signal: Any) -> None:
    """
    :param signal: A :class:`~sb3_cchain.TaskSignal`, when training starts. Its ``learn()`` hears of switches from it alone.
    """
    _signals[signal.training_env.unwrapped] = ref(signal)


def active_signal(env: VecEnv) -> Any:
    """
    :param env: A vectorised environment
    :return: The :class:`~sb3_cchain.TaskSignal` of the ``learn()`` that trains in it; None where there is none
    """
    found = _signals.get(env.unwrapped)
    signal = None if found is None else found()
    return signal if signal is not None and signal.is_active else None


# The environment that each model was last trained in. It is not saved with the model: where training is resumed, the same
# environment is another object.
_last_envs: WeakKeyDictionary[BaseAlgorithm, ref[Any]] = WeakKeyDictionary()


def task_count(model: BaseAlgorithm) -> int:
    """
    :param model: A model during ``learn()``
    :return: How often it has changed to another environment, plus the calls of :func:`task_switched`. An environment that
        comes again is a new task, too. The number is kept as ``model.task_count``.
    """
    if model.num_timesteps == 0:
        model.task_count = 0  # type: ignore[attr-defined]
        _counts_before.pop(model, None)
    elif has_other_env(model):
        _count_one_more(model)
    elif not hasattr(model, "task_count"):  # it was trained before without anybody who counts
        model.task_count = 0  # type: ignore[attr-defined]
    _last_envs[model] = ref(_single_env(model))
    return model.task_count  # type: ignore[attr-defined]


def count_before_step(model: BaseAlgorithm) -> int:
    """
    :param model: A model during ``learn()``
    :return: :func:`task_count`, without what was counted since the last step
    """
    step, count = _counts_before.get(model, (None, 0))
    return count if step == model.num_timesteps else task_count(model)


def count_other_sequence(model: BaseAlgorithm) -> None:
    """
    :param model: A model whose environment has another task sequence than before, which :func:`task_count` then has counted,
        also where the model was loaded in the meantime
    """
    if not has_other_env(model):
        _count_one_more(model)


def known_numbers(model: BaseAlgorithm) -> list[int]:
    """
    :param model: A model when training starts
    :return: The numbers of the task, as the listeners that keep it with the model last heard them; none at step 0
    """
    if model.num_timesteps == 0:
        return []
    state = getattr(model, "continual_state", None) or {}
    known = [state.get("task_id"), *(getattr(model, name, None) for name in ("trained_task_id", "learning_starts_task_id"))]
    return [int(task) for task in known if isinstance(task, Integral)]


def has_other_env(model: BaseAlgorithm) -> bool:
    """
    :param model: A model during ``learn()``
    :return: Whether its environment is another one than at the last :func:`task_count`
    """
    return model in _last_envs and _last_envs[model]() is not _single_env(model)


def _single_env(model: BaseAlgorithm) -> Any:
    assert model.env is not None
    return single_envs(model.env)[0]  # set_env() wraps the same environment again


def task_switched(model: BaseAlgorithm) -> None:
    """
    Say that the world has changed: the next step of training is in a new task. Call it between two calls of
    ``learn(..., reset_num_timesteps=False)``, or in a callback during training.

    :param model: A model of Stable-Baselines3, sb3-contrib or this package
    :raises ValueError: When the environment numbers its tasks itself, in ``info["task_id"]``, and no
        :class:`~sb3_cchain.TaskSignal` is given to ``learn()``
    """
    if model.env is not None and active_signal(model.env) is None and TASK_KEY in first_reset_info(model.env):
        raise ValueError(
            f"`task_switched()` is not heard where the environment numbers its tasks itself, in info[{TASK_KEY!r}]. Leave it "
            "out, or have both count by giving `learn()` a TaskSignal."
        )
    _count_one_more(model)


# For each model the step at which it was last counted, and the count before that
_counts_before: WeakKeyDictionary[BaseAlgorithm, tuple[int, int]] = WeakKeyDictionary()


def _count_one_more(model: BaseAlgorithm) -> None:
    count = getattr(model, "task_count", 0)
    if _counts_before.get(model, (None, 0))[0] != model.num_timesteps:
        _counts_before[model] = model.num_timesteps, count
    model.task_count = count + 1  # type: ignore[attr-defined]
