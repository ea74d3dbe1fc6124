"""Tells sb3-contrib's algorithms apart without importing it, as it need not be installed."""

from stable_baselines3.common.base_class import BaseAlgorithm


def is_trpo(model: BaseAlgorithm) -> bool:
    """
    :param model: A model
    :return: Whether it is of TRPO or of a subclass of it, where the policy's optimiser does not make all changes
    """
    return any(base.__name__ == "TRPO" for base in type(model).__mro__)


def is_recurrent(model: BaseAlgorithm) -> bool:
    """
    :param model: A model
    :return: Whether it is of RecurrentPPO or of a subclass of it, whose networks have a memory
    """
    return hasattr(model, "_last_lstm_states")
