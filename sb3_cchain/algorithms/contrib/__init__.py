"""sb3-contrib's algorithms with churn reduction."""

try:
    import sb3_contrib  # noqa: F401
except ImportError as error:
    raise ImportError(f'This algorithm needs sb3-contrib ({error}): pip install "sb3-cchain[contrib]"') from error

from sb3_cchain.algorithms.contrib.crossq_cchain import CChainCrossQ
from sb3_cchain.algorithms.contrib.ppo_lstm_cchain import CChainRecurrentPPO
from sb3_cchain.algorithms.contrib.ppo_mask_cchain import CChainMaskablePPO
from sb3_cchain.algorithms.contrib.qrdqn_cchain import CChainQRDQN
from sb3_cchain.algorithms.contrib.tqc_cchain import CChainTQC
from sb3_cchain.algorithms.contrib.trpo_cchain import CChainTRPO

__all__ = [
    "CChainCrossQ",
    "CChainMaskablePPO",
    "CChainQRDQN",
    "CChainRecurrentPPO",
    "CChainTQC",
    "CChainTRPO",
]
