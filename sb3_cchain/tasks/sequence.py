"""The task sequence that a model is trained in, and when it began."""

from collections.abc import Mapping
from math import isnan
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_cchain.tasks.clock import TaskClock


def describe_sequence(env: VecEnv) -> dict[str, Any]:
    """
    :param env: A continual environment
    :return: Its tasks, how long they last, and which one is the first: in lists, numbers and strings, which come back from a
        saved model as they were
    """
    return {name: _plain(env.get_attr(name, indices=0)[0]) for name in ("task_sequence", "steps_per_task", "first_task")}


def sequence_start(model: BaseAlgorithm) -> int:
    """
    :param model: A model
    :return: Environment steps of the training at which its task sequence began: 0 unless there was another one before
    """
    past = getattr(model, "trained_sequence", None)
    return 0 if past is None else past["start"]


def other_sequence(model: BaseAlgorithm, env: VecEnv) -> str | None:
    """
    :param model: A model that has been trained in ``model.trained_sequence``
    :param env: A continual environment
    :return: How its task sequence differs from the part that the model has been trained in; None when it does not, also
        where its further tasks are others, or more
    """
    past: Mapping[str, Any] | None = getattr(model, "trained_sequence", None)
    if past is None:
        return None
    present = describe_sequence(env)
    clock = TaskClock(past["steps_per_task"], first_task=past["first_task"])
    clock.set(max(model.num_timesteps - past["start"] - env.num_envs, 0))  # that of the last step
    last_task = clock.due_task
    if past["first_task"] != present["first_task"]:
        return f"its first task is {present['first_task']} instead of {past['first_task']}"
    difference = differing_task(past["task_sequence"][: last_task + 1], present["task_sequence"][: last_task + 1])
    lengths, present_lengths = (sequence["steps_per_task"][:last_task] for sequence in (past, present))
    if difference is None and lengths != present_lengths:
        return f"its tasks have {present_lengths} steps instead of {lengths}"
    return difference


def differing_task(tasks: list[Any], other_tasks: list[Any]) -> str | None:
    """
    :param tasks: The descriptions of tasks
    :param other_tasks: Those of others
    :return: In which way the others differ; None when they do not
    """
    if tasks == other_tasks:
        return None
    if len(tasks) != len(other_tasks):
        return f"it has {len(other_tasks)} tasks instead of {len(tasks)}"
    position = next(i for i, (task, other) in enumerate(zip(tasks, other_tasks, strict=True)) if task != other)
    return f"task {position} differs: {other_tasks[position]} instead of {tasks[position]}"


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):  # NumPy's
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    return "nan" if isinstance(value, float) and isnan(value) else value  # NaN is not equal to itself
