"""MaskablePPO with churn reduction."""

from sb3_contrib import MaskablePPO

from sb3_cchain.algorithms.churn_algorithm import ChurnAlgorithm


class CChainMaskablePPO(ChurnAlgorithm, MaskablePPO):
    """
    Proximal Policy Optimization (PPO) with invalid action masking with Continual Churn Approximated Reduction (C-CHAIN).

    It is sb3-contrib's :class:`~sb3_contrib.MaskablePPO`, with all of its arguments and its ``train()`` unchanged,
    plus λ·L_churn in the loss of each update.

    By default the policy is held still: the probabilities of the actions under the masks of the reference batch, which
    is another minibatch of the rollout.

    :param args: Arguments of MaskablePPO
    :param kwargs: Keyword arguments of MaskablePPO, and the arguments for churn reduction:
        :class:`~sb3_cchain.algorithms.ChurnAlgorithm`
    """
