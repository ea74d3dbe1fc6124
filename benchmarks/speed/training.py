"""Training that is timed."""

from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from benchmarks.speed.time_inside import TimeInside
from benchmarks.speed.timing import TRAIN, seconds
from sb3_cchain import ContinualMetrics, TaskSync
from sb3_cchain.replaced import replaced


def timed_learn(model: Any, n_steps: int, whole: str, continual: bool = True) -> dict[str, float]:
    """
    :param model: A model
    :param n_steps: Environment steps
    :param whole: Name of the measure that is all of it
    :param continual: Whether its environment is continual
    :return: Seconds of ``train()``, and of all
    """
    # CChainPPO and others would add these callbacks by themselves
    callbacks: list[BaseCallback] = [TaskSync(), ContinualMetrics()] if continual else []
    inside = TimeInside()
    with replaced(model, "train", model.train):  # afterwards, what `watch()` puts there is gone
        inside.watch(model, "train")
        total = seconds(lambda: model.learn(n_steps, callback=callbacks, reset_num_timesteps=False))
    return {TRAIN: inside.seconds, whole: total}


def iteration(model: OnPolicyAlgorithm) -> dict[str, float]:
    """
    :param model: A model
    :return: Seconds of ``train()`` and of the whole iteration
    """
    return timed_learn(model, model.n_steps * model.n_envs, "iteration (rollout and `train()`)")
