"""TD3 with churn reduction."""

from stable_baselines3 import TD3

from sb3_cchain.algorithms.churn_algorithm import ChurnAlgorithm


class CChainTD3(ChurnAlgorithm, TD3):
    """
    Twin Delayed DDPG (TD3) with Continual Churn Approximated Reduction (C-CHAIN).

    It is SB3's :class:`~stable_baselines3.TD3`, with all of its arguments and its ``train()`` unchanged, plus
    λ·L_churn in the losses of each update.

    By default the actor's actions without noise are held still (``churn_target="policy"``), by their mean squared
    change on a sample of the replay buffer; ``"value"`` holds still each critic's values of the actions of such a
    sample.

    :param args: Arguments of TD3
    :param kwargs: Keyword arguments of TD3, and the arguments for churn reduction:
        :class:`~sb3_cchain.algorithms.ChurnAlgorithm`
    """
