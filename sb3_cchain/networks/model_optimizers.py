"""The optimisers of a Stable-Baselines3 model, by name."""

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm


def model_optimizers(model: BaseAlgorithm) -> dict[str, th.optim.Optimizer]:
    """
    :param model: A model
    :return: Its policy's optimiser under the name ``""`` (PPO, A2C, DQN), or its ``"actor"``'s and ``"critic"``'s (SAC, TD3)
    """
    owners = {"": model.policy, "actor": getattr(model.policy, "actor", None), "critic": getattr(model.policy, "critic", None)}
    optimizers = {name: getattr(owner, "optimizer", None) for name, owner in owners.items()}
    return {name: optimizer for name, optimizer in optimizers.items() if optimizer is not None}
