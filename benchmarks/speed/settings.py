"""The shipped hyperparameters, as arguments of a model."""

from typing import Any

from rl_zoo3.utils import get_class_by_name
from torch import nn

from benchmarks.grid.run import shipped_hyperparameters

# What RL Zoo takes out of the hyperparameters before it makes the model
NOT_MODEL_ARGUMENTS = {"callback", "env_wrapper", "vec_env_wrapper", "normalize", "monitor_kwargs", "n_timesteps"}


def model_settings(algo: str, env_id: str, **changed: Any) -> dict[str, Any]:
    """
    :param algo: Name of a file of hyperparameters
    :param env_id: Environment id
    :param changed: Arguments that differ
    :return: The model's arguments, from the shipped hyperparameters
    """
    shipped = shipped_hyperparameters(algo, env_id) or {}
    settings = {name: value for name, value in shipped.items() if name not in NOT_MODEL_ARGUMENTS}
    # As RL Zoo reads it
    if "policy_kwargs" in settings:
        settings["policy_kwargs"] = eval(settings["policy_kwargs"], {"nn": nn, "get_class_by_name": get_class_by_name})
    if "." in settings["policy"]:
        settings["policy"] = get_class_by_name(settings["policy"])
    return {**settings, "env": env_id, "seed": 0, "device": "cpu", **changed}
