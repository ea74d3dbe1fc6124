"""Which algorithm saved a model. Stable-Baselines3 does not save it, so it is told from the data that it saves."""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import stable_baselines3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_cchain import algorithms

# Name of the policy's class, or of one of its bases → names of algorithms, each with what its data has. The first match counts
_SIGNS: dict[str, dict[str, Callable[[dict[str, Any]], bool]]] = {
    "MaskableActorCriticPolicy": {"MaskablePPO": lambda data: True},
    "RecurrentActorCriticPolicy": {"RecurrentPPO": lambda data: True},
    "ActorCriticPolicy": {
        "PPO": lambda data: "clip_range" in data,
        "TRPO": lambda data: "cg_max_steps" in data,
        "A2C": lambda data: "vf_coef" in data,
    },
    "DQNPolicy": {"DoubleDQN": lambda data: "double_q" in data, "DQN": lambda data: True},
    "QRDQNPolicy": {"QRDQN": lambda data: True},
    "SACPolicy": {"SAC": lambda data: True},
    # DDPG is TD3 with these settings
    "TD3Policy": {
        "DDPG": lambda data: data.get("policy_delay") == 1 and data.get("target_noise_clip") == 0,
        "TD3": lambda data: True,
    },
    "TQCPolicy": {"TQC": lambda data: True},
    "CrossQPolicy": {"CrossQ": lambda data: True},
    "ARSPolicy": {"ARS": lambda data: True},
}


def algorithm_of(path: str | Path) -> type[BaseAlgorithm]:
    """
    :param path: A model that was saved by an algorithm of Stable-Baselines3, sb3-contrib or this package
    :return: The algorithm's class
    :raises ValueError: When it is of another algorithm, or no model
    :raises ImportError: When it is of sb3-contrib, which is not installed
    """
    data, *_ = load_from_zip_file(path, device="cpu")
    policy_class = (data or {}).get("policy_class")
    if data is None or not inspect.isclass(policy_class):
        raise ValueError(f"{path} is not a model saved by Stable-Baselines3: it does not name its policy")
    for base in policy_class.__mro__:
        for name, has_signs in _SIGNS.get(base.__name__, {}).items():
            if has_signs(data):
                return _find_class(name, has_churn_reduction="churn_coef" in data)
    raise ValueError(
        f"{path} was saved by an algorithm not known here (its policy is a {policy_class.__name__}): give its --algo"
    )


def _find_class(name: str, has_churn_reduction: bool) -> type[BaseAlgorithm]:
    if has_churn_reduction:
        name = f"CChain{name.removeprefix('Double')}"
    for module in (stable_baselines3, algorithms):
        if hasattr(module, name):
            return getattr(module, name)
    if has_churn_reduction:
        from sb3_cchain.algorithms import contrib

        return getattr(contrib, name)
    import sb3_contrib

    return getattr(sb3_contrib, name)
