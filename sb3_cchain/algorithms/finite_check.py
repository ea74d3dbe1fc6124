"""Stops training at the first NaN or infinite value that an environment gives, before an update is made on it."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv


class FiniteCheck(BaseCallback):
    """
    Checks the rewards and the observations of each step, and the first observations. Integer observations are not checked.

    Torch would raise an error, too, but later, and one that names neither the environment nor the step.
    """

    def _on_rollout_start(self) -> None:
        # These are those of the last step, which were checked, unless the environments have been reset
        if self.model._last_obs is not self.locals.get("new_obs"):
            check_first_observations(self.model)

    def _on_step(self) -> bool:
        check_step(self.model, self.locals)
        return True


def check_first_observations(model: BaseAlgorithm) -> None:
    """
    :param model: A model that is about to collect a rollout
    :raises ValueError: When an observation that it starts from is NaN or infinite
    """
    assert model.env is not None
    _check_observations(model.env, model._last_obs, model.num_timesteps)


def check_step(model: BaseAlgorithm, local_variables: Mapping[str, Any]) -> None:
    """
    :param model: A model that is being trained
    :param local_variables: Of SB3's ``collect_rollouts()``, after a step of the environments
    :raises ValueError: When a reward or an observation is NaN or infinite
    """
    env, rewards = model.env, local_variables["rewards"]
    assert env is not None
    if not np.isfinite(rewards).all():
        _raise(env, "reward", rewards, model.num_timesteps)
    _check_observations(env, local_variables["new_obs"], model.num_timesteps)
    if local_variables["dones"].any():
        for index, info in enumerate(local_variables["infos"]):
            if "terminal_observation" in info:
                last = info["terminal_observation"]
                for key, observation in last.items() if isinstance(last, dict) else [(None, last)]:
                    if _is_bad(np.asarray(observation)):
                        _raise(env, _observation(key), observation, model.num_timesteps, index)


def _check_observations(env: VecEnv, observations: Any, step: int) -> None:
    for key, batch in observations.items() if isinstance(observations, dict) else [(None, observations)]:
        if _is_bad(batch):
            _raise(env, _observation(key), batch, step)


def _is_bad(array: np.ndarray) -> bool:
    return array.dtype.kind == "f" and not np.isfinite(array).all()


def _observation(key: str | None) -> str:
    return "observation" if key is None else f"observation {key!r}"


def _raise(env: VecEnv, kind: str, values: Any, step: int, index: int | None = None) -> None:
    """``values`` are those of all environments, or of the one at ``index``."""
    bad = ~np.isfinite(values)
    if index is None:
        index = int(np.argmax(bad.reshape(len(bad), -1).any(axis=1)))
    value = np.asarray(values)[bad][0]
    raise ValueError(
        f"Environment {index}{_id(env, index)} gave a NaN or infinite {kind} at step {step} of training: it holds {value}. "
        "The network has not been trained on it. Mend the environment; SB3's VecCheckNan shows the action before."
    )


def _id(env: VecEnv, index: int) -> str:
    # Environments that are not Gymnasium's may have no such attribute
    spec = env.get_attr("spec", index)[0] if env.has_attr("spec") else None
    return f" ({spec.id})" if spec is not None else ""
