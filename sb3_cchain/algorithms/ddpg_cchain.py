"""DDPG with churn reduction."""

from stable_baselines3 import DDPG

from sb3_cchain.algorithms.churn_algorithm import ChurnAlgorithm


class CChainDDPG(ChurnAlgorithm, DDPG):
    """
    Deep Deterministic Policy Gradient (DDPG) with Continual Churn Approximated Reduction (C-CHAIN).

    It is SB3's :class:`~stable_baselines3.DDPG`, with all of its arguments and its ``train()`` unchanged, plus
    λ·L_churn in the losses of each update.

    By default the actor's actions without noise are held still (``churn_target="policy"``), by their mean squared
    change on a sample of the replay buffer; ``"value"`` holds still each critic's values of the actions of such a
    sample.

    :param args: Arguments of DDPG
    :param kwargs: Keyword arguments of DDPG, and the arguments for churn reduction:
        :class:`~sb3_cchain.algorithms.ChurnAlgorithm`
    """
