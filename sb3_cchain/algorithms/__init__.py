"""Stable-Baselines3's algorithms with churn reduction, and Double DQN."""

from sb3_cchain.algorithms.cchain_callback import CChainCallback
from sb3_cchain.algorithms.double_dqn import DoubleDQN
from sb3_cchain.algorithms.dqn_cchain import CChainDQN
from sb3_cchain.algorithms.finite_check import FiniteCheck
from sb3_cchain.algorithms.ppo_cchain import CChainPPO

__all__ = [
    "CChainCallback",
    "CChainDQN",
    "CChainPPO",
    "DoubleDQN",
    "FiniteCheck",
]
