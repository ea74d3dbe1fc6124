"""Training that is timed."""

from functools import partial
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from benchmarks.speed.timing import TRAIN, seconds
from sb3_cchain import ContinualMetrics, TaskSync
from sb3_cchain.replaced import replaced


def timed_learn(model: Any, n_steps: int, whole: str) -> dict[str, float]:
    """
    :param model: A model
    :param n_steps: Environment steps
    :param whole: Name of the measure that is all of it
    :return: Seconds of ``train()``, and of all
    """
    train = model.train
    in_train: list[float] = []

    def timed_train(*args: Any, **kwargs: Any) -> None:
        in_train.append(seconds(partial(train, *args, **kwargs)))

    # CChainPPO and CChainDQN would add these callbacks by themselves
    callbacks: list[BaseCallback] = [TaskSync(), ContinualMetrics()]
    with replaced(model, "train", timed_train):
        total = seconds(lambda: model.learn(n_steps, callback=callbacks, reset_num_timesteps=False))
    return {TRAIN: sum(in_train), whole: total}


def iteration(model: OnPolicyAlgorithm) -> dict[str, float]:
    """
    :param model: A model
    :return: Seconds of ``train()`` and of the whole iteration
    """
    return timed_learn(model, model.n_steps * model.n_envs, "iteration (rollout and `train()`)")
