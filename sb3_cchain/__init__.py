"""C-CHAIN for Stable-Baselines3. Importing it registers the environments ``Continual/...`` with Gymnasium."""

import sb3_cchain.gym_notice  # noqa: F401  # isort: skip  # before Stable-Baselines3

from sb3_cchain.algorithms import CChainCallback, CChainDQN, CChainPPO, DoubleDQN, FiniteCheck
from sb3_cchain.analysis import ChurnMonitor
from sb3_cchain.callbacks import ContinualMetrics
from sb3_cchain.checkpoint import ResumableEnv, TrainingCheckpoint, resume
from sb3_cchain.envs import ContinualEnv, register_envs
from sb3_cchain.networks import make_lean
from sb3_cchain.tasks import TaskSync
from sb3_cchain.tensorboard import TensorBoardOverview

__version__ = "0.1.0"
__all__ = [
    "CChainCallback",
    "CChainDQN",
    "CChainPPO",
    "ChurnMonitor",
    "ContinualEnv",
    "ContinualMetrics",
    "DoubleDQN",
    "FiniteCheck",
    "ResumableEnv",
    "TaskSync",
    "TensorBoardOverview",
    "TrainingCheckpoint",
    "make_lean",
    "resume",
]

register_envs()
