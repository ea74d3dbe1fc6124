"""RecurrentPPO with churn reduction."""

from sb3_contrib import RecurrentPPO

from sb3_cchain.algorithms.churn_algorithm import ChurnAlgorithm


class CChainRecurrentPPO(ChurnAlgorithm, RecurrentPPO):
    """
    Proximal Policy Optimization (PPO) with recurrent policies with Continual Churn Approximated Reduction (C-CHAIN).

    It is sb3-contrib's :class:`~sb3_contrib.RecurrentPPO`, with all of its arguments and its ``train()`` unchanged,
    plus λ·L_churn in the loss of each update.

    By default the policy is held still, on another minibatch of the rollout: its sequences, with the LSTM states that
    they begin with.

    :param args: Arguments of RecurrentPPO
    :param kwargs: Keyword arguments of RecurrentPPO, and the arguments for churn reduction:
        :class:`~sb3_cchain.algorithms.ChurnAlgorithm`
    """
