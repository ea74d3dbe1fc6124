"""QRDQN with churn reduction."""

from sb3_contrib import QRDQN

from sb3_cchain.algorithms.churn_algorithm import ChurnAlgorithm


class CChainQRDQN(ChurnAlgorithm, QRDQN):
    """
    Quantile Regression DQN (QR-DQN) with Continual Churn Approximated Reduction (C-CHAIN).

    It is sb3-contrib's :class:`~sb3_contrib.QRDQN`, with all of its arguments and its ``train()`` unchanged, plus
    λ·L_churn in the loss of each update.

    By default all quantiles of the values of all actions are held still, by their mean squared change on a sample of
    the replay buffer. QR-DQN has no policy of its own to hold still.

    :param args: Arguments of QRDQN
    :param kwargs: Keyword arguments of QRDQN, and the arguments for churn reduction:
        :class:`~sb3_cchain.algorithms.ChurnAlgorithm`
    """
