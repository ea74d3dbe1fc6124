"""What the tasks of a continual environment are called."""

from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from sb3_cchain.tasks.continual import is_continual


def task_names(env: VecEnv) -> list[str]:
    """
    :param env: A vectorised environment
    :return: Name of each task of a continual environment: the words in its description. Empty where all tasks have the same
        words, as where they differ in a number, and where there are no tasks
    """
    if not is_continual(env):
        return []
    names = [_words(description) for description in env.get_attr("task_sequence", indices=0)[0]]
    return names if len(set(names)) > 1 else []


def _words(description: Any) -> str:
    parts = description if isinstance(description, tuple) else (description,)
    return " ".join(part for part in parts if isinstance(part, str))
