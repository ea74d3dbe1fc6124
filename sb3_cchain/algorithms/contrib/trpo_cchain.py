"""TRPO with churn reduction."""

from sb3_contrib import TRPO

from sb3_cchain.algorithms.churn_algorithm import ChurnAlgorithm


class CChainTRPO(ChurnAlgorithm, TRPO):
    """
    Trust Region Policy Optimization (TRPO) with Continual Churn Approximated Reduction (C-CHAIN).

    It is sb3-contrib's :class:`~sb3_contrib.TRPO`, with all of its arguments and its ``train()`` unchanged, plus
    λ·L_churn in the loss of each update of the value function.

    By default the state values are held still, which is all that it can do: TRPO's policy has no optimiser, and the
    step of its line search is bounded in KL divergence already.

    :param args: Arguments of TRPO
    :param kwargs: Keyword arguments of TRPO, and the arguments for churn reduction:
        :class:`~sb3_cchain.algorithms.ChurnAlgorithm`
    """
