"""A case: algorithms that are compared in an environment."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise


@dataclass(frozen=True)
class Variant:
    """
    An algorithm in a case.

    :param label: Human-readable name
    :param algorithm: Its class
    :param arguments: Arguments beside the settings of the case
    """

    label: str
    algorithm: type[BaseAlgorithm]
    arguments: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Case:
    """
    A comparison.

    :param title: Environment and algorithm, human-readable
    :param source: Where the settings come from
    :param env: Environment id, or what makes the environment
    :param variants: What is compared, by the name of the files of results. C-CHAIN is compared with the first one
    :param steps: Environment steps of a run
    :param eval_freq: Environment steps between two evaluations
    :param seeds: Number of seeds
    :param settings: Arguments of all variants
    :param env_kwargs: Arguments of the environment
    :param n_envs: Environments side by side
    :param n_eval_episodes: Episodes of an evaluation, on the task being trained
    :param n_tasks: Tasks of equal length, one after the other
    :param normalize: Whether ``VecNormalize`` normalises observations and rewards
    :param policy: Policy
    :param score: Column of the results that is compared
    :param solved: Mean return that counts as solved, where the case asks whether what was learned stays
    :param worst: Return of an agent that can do nothing, there
    :param monitor: Arguments of ``ChurnMonitor``, where churn is measured as well
    """

    title: str
    source: str
    env: str | Callable[..., gym.Env]
    variants: Mapping[str, Variant]
    steps: int
    eval_freq: int
    seeds: int = 5
    settings: Mapping[str, Any] = field(default_factory=dict)
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    n_envs: int = 1
    n_eval_episodes: int = 10
    n_tasks: int = 1
    normalize: bool = False
    policy: str = "MlpPolicy"
    score: str = "mean_return"
    solved: float | None = None
    worst: float = 0.0
    monitor: Mapping[str, Any] | None = None


def action_noise(n_actions: int) -> NormalActionNoise:
    """
    :param n_actions: Dimensions of the actions
    :return: Noise with a standard deviation of 0.1 for each
    """
    return NormalActionNoise(np.zeros(n_actions), np.full(n_actions, 0.1))
