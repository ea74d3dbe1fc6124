"""Stable-Baselines3's algorithms with churn reduction, and Double DQN. Those of sb3-contrib are in ``contrib``."""

from sb3_cchain.algorithms.a2c_cchain import CChainA2C
from sb3_cchain.algorithms.cchain_callback import CChainCallback
from sb3_cchain.algorithms.churn_algorithm import ChurnAlgorithm
from sb3_cchain.algorithms.ddpg_cchain import CChainDDPG
from sb3_cchain.algorithms.double_dqn import DoubleDQN
from sb3_cchain.algorithms.dqn_cchain import CChainDQN
from sb3_cchain.algorithms.finite_check import FiniteCheck
from sb3_cchain.algorithms.ppo_cchain import CChainPPO
from sb3_cchain.algorithms.sac_cchain import CChainSAC
from sb3_cchain.algorithms.td3_cchain import CChainTD3

__all__ = [
    "CChainA2C",
    "CChainCallback",
    "CChainDDPG",
    "CChainDQN",
    "CChainPPO",
    "CChainSAC",
    "CChainTD3",
    "ChurnAlgorithm",
    "DoubleDQN",
    "FiniteCheck",
]
