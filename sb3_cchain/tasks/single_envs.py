"""The environments within a vectorised one."""

from typing import Any

from stable_baselines3.common.vec_env import VecEnv


def single_envs(env: VecEnv) -> list[Any]:
    """
    :param env: A vectorised environment
    :return: The environments within it, without their wrappers. Where they are in other processes, the vectorised environment
        without its wrappers.
    """
    inner = env.unwrapped
    return [single.unwrapped for single in getattr(inner, "envs", [inner])]


def share_envs(env: VecEnv, other: VecEnv) -> bool:
    """
    :param env: A vectorised environment
    :param other: Another one
    :return: Whether an environment is in both
    """
    return any(single is found for single in single_envs(env) for found in single_envs(other))
