"""CrossQ with churn reduction."""

from sb3_contrib import CrossQ

from sb3_cchain.algorithms.churn_algorithm import ChurnAlgorithm


class CChainCrossQ(ChurnAlgorithm, CrossQ):
    """
    CrossQ with Continual Churn Approximated Reduction (C-CHAIN).

    It is sb3-contrib's :class:`~sb3_contrib.CrossQ`, with all of its arguments and its ``train()`` unchanged, plus
    λ·L_churn in the losses of each update.

    By default the actor's actions without noise are held still (``churn_target="policy"``), by their mean squared
    change on a sample of the replay buffer; ``"value"`` holds still each critic's values of the actions of such a
    sample.

    :param args: Arguments of CrossQ
    :param kwargs: Keyword arguments of CrossQ, and the arguments for churn reduction:
        :class:`~sb3_cchain.algorithms.ChurnAlgorithm`
    """
