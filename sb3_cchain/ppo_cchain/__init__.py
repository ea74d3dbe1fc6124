"""C-CHAIN PPO."""

from sb3_cchain.ppo_cchain.callback import CChainCallback
from sb3_cchain.ppo_cchain.ppo_cchain import CChainPPO

__all__ = ["CChainCallback", "CChainPPO"]
