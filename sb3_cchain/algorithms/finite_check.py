"""Stops training at NaN and infinite values, of the environment or of an actor-critic policy, and says where they are."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv
from torch.nn.parameter import is_lazy

from sb3_cchain.networks.batch_outputs import policy_kind
from sb3_cchain.networks.compiled import uncompiled

# Up to about as many values of a step, adding Python's numbers takes less time than NumPy's functions
FEW_VALUES = 100


class FiniteCheck(BaseCallback):
    """
    Checks the rewards and the observations of each step, and the first observations. Integer observations are not checked. NaN
    in observations is allowed where the policy's outputs are finite all the same, as with a features extractor that puts
    numbers in the place of missing values. Of an on-policy algorithm it checks the parameters of the policy that are trained,
    before each rollout and at the end of training, and what the policy gave after each rollout.

    Torch would raise an error, too, but later, and one that names neither the environment nor the step nor the parameter.
    """

    def _on_rollout_start(self) -> None:
        if isinstance(self.model, OnPolicyAlgorithm):
            self._check_parameters()
        # Those of the last step were checked then. Others are here where the environments have been reset since
        if self.model._last_obs is not self.locals.get("new_obs"):
            self._check_observations(self.model._last_obs)

    def _on_step(self) -> bool:
        # An algorithm of one's own may have other names, or lists
        rewards, observations = np.asarray(self.locals.get("rewards", 0)), self.locals.get("new_obs", ())
        if not _surely_finite(rewards):
            self._check("reward", rewards)
        if isinstance(observations, dict) or not _surely_finite(np.asarray(observations)):
            self._check_observations(observations)
        if any(np.asarray(self.locals.get("dones", ())).tolist()):
            for index, info in enumerate(self.locals.get("infos", ())):
                if "terminal_observation" in info:
                    self._check_observations(info["terminal_observation"], index)
        return True

    def _on_rollout_end(self) -> None:
        if isinstance(self.model, OnPolicyAlgorithm):
            for name in ("actions", "log_probs", "values"):
                self._check_outputs(name, getattr(self.model.rollout_buffer, name))

    def _on_training_end(self) -> None:
        if isinstance(self.model, OnPolicyAlgorithm):
            self._check_parameters()

    def _check_parameters(self) -> None:
        for name, parameter in uncompiled(self.model.policy).named_parameters():
            # Parameters that are not trained may be infinite on purpose, as a mask
            if parameter.requires_grad and not is_lazy(parameter) and not parameter.isfinite().all():
                raise ValueError(
                    f"The policy's parameter {name} holds NaN or infinite values at step {self.num_timesteps} of training. "
                    "Lower the learning rate, set `max_grad_norm`, or scale the rewards."
                )

    def _check_outputs(self, name: str, outputs: NDArray[Any]) -> None:
        if not np.isfinite(outputs).all():
            raise ValueError(
                f"The policy gave NaN or infinite {name} in the rollout that ended at step {self.num_timesteps} of training, "
                "though its parameters are finite: they, or the observations, are too large. The network has not been trained "
                "on this rollout. Normalise the observations, or lower the learning rate."
            )

    def _check_observations(self, observations: Any, index: int | None = None) -> None:
        takes_nan = partial(_takes_nan, self.model, observations)
        if isinstance(observations, dict):
            for key, values in observations.items():
                self._check(f"observation {key!r}", values, index, takes_nan)
        else:
            self._check("observation", observations, index, takes_nan)

    def _check(self, kind: str, values: Any, index: int | None = None, takes_nan: Callable[[], bool] = lambda: False) -> None:
        """``values`` are those of all environments, or of the one at ``index``."""
        values = np.asarray(values)
        if values.dtype.kind != "f" or np.isfinite(values).all():
            return
        if not np.isinf(values).any() and takes_nan():
            return
        bad = ~np.isfinite(values)
        if index is None:
            index = int(np.argmax(bad.reshape(len(bad), -1).any(axis=1)))
        name = f"Environment {index}{_id(self.training_env, index)}"
        raise ValueError(
            f"{name} gave a NaN or infinite {kind} at step {self.num_timesteps} of training: it holds {values[bad][0]}. "
            "The network has not been trained on it. Fix the environment; SB3's VecCheckNan shows the action before."
        )


def _surely_finite(values: NDArray[Any]) -> bool:
    """All that most steps need: a sum is NaN or infinite if a value is. It may also be too large for finite values."""
    if values.dtype.kind != "f":
        return True
    return values.size <= FEW_VALUES and math.isfinite(sum(values.ravel().tolist()))


def _takes_nan(model: Any, observations: Any) -> bool:
    """Whether the policy's outputs are finite, as with a features extractor that puts numbers in the place of NaN."""
    policy = uncompiled(model.policy)
    kind = policy_kind(policy)
    if kind is None or model.get_vec_normalize_env() is not None:  # whose running mean becomes NaN for good
        return False
    try:
        with th.no_grad():
            batch = {"observations": policy.obs_to_tensor(observations)[0]}
            # Values of actions need actions: those algorithms do not take NaN
            return all(
                outputs(policy, batch).isfinite().all() for outputs in (kind.actions, kind.values) if outputs is not None
            )
    except Exception:  # as of torch's distributions; what is wrong with the observations must be said in any case
        return False


def _id(env: VecEnv, index: int) -> str:
    try:
        return f" ({env.get_attr('spec', index)[0].id})"
    except Exception:  # as of environments that are not Gymnasium's; what is wrong must be said in any case
        return ""
