"""A2C with churn reduction."""

from stable_baselines3 import A2C

from sb3_cchain.algorithms.churn_algorithm import ChurnAlgorithm


class CChainA2C(ChurnAlgorithm, A2C):
    """
    Advantage Actor-Critic (A2C) with Continual Churn Approximated Reduction (C-CHAIN).

    It is SB3's :class:`~stable_baselines3.A2C`, with all of its arguments and its ``train()`` unchanged, plus
    λ·L_churn in the loss of each update.

    By default the policy is held still, on the observations of the rollout before the one that an update was made on;
    A2C trains on a rollout as a whole, so there is no other data in it.

    :param args: Arguments of A2C
    :param kwargs: Keyword arguments of A2C, and the arguments for churn reduction:
        :class:`~sb3_cchain.algorithms.ChurnAlgorithm`
    """
