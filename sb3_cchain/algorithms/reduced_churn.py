"""Churn reduction of any algorithm's unmodified ``train()``."""

from contextlib import AbstractContextManager, nullcontext

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_cchain.algorithms.off_policy import reduced_off_policy
from sb3_cchain.algorithms.on_policy import PolicyChurnOptions, reduced_on_policy
from sb3_cchain.churn import ChurnReducers


def reduced_churn(model: BaseAlgorithm, reducers: ChurnReducers, options: PolicyChurnOptions) -> AbstractContextManager[None]:
    """
    Run ``model``'s own ``train()`` in this block to train it with churn reduction; without, where each λ is and stays 0.

    :param model: A model
    :param reducers: Its churn reducers by the name of the target
    :param options: How churn is measured and reduced on-policy
    :return: A context manager
    """
    active = reducers.active()
    if not active:
        return nullcontext()
    if isinstance(model, OnPolicyAlgorithm):
        return reduced_on_policy(model, active, options)
    return reduced_off_policy(model, active)
