"""Double DQN, and C-CHAIN DQN."""

from sb3_cchain.dqn_cchain.double_dqn import DoubleDQN
from sb3_cchain.dqn_cchain.dqn_cchain import CChainDQN

__all__ = ["CChainDQN", "DoubleDQN"]
