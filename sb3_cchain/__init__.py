"""C-CHAIN for Stable-Baselines3. Importing it registers the environments ``Continual/...`` with Gymnasium."""

import sb3_cchain.gym_notice  # noqa: F401  # isort: skip  # before Stable-Baselines3

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sb3_cchain.algorithms import (
    CChainA2C,
    CChainCallback,
    CChainDDPG,
    CChainDQN,
    CChainPPO,
    CChainSAC,
    CChainTD3,
    DoubleDQN,
    FiniteCheck,
)
from sb3_cchain.analysis import ChurnMonitor
from sb3_cchain.callbacks import ContinualMetrics
from sb3_cchain.checkpoint import ResumableEnv, TrainingCheckpoint, resume
from sb3_cchain.envs import ContinualEnv, register_envs
from sb3_cchain.networks import make_lean, transfer
from sb3_cchain.tasks import TaskSignal, TaskSync, task_switched
from sb3_cchain.tensorboard import TensorBoardOverview

__version__ = "0.1.0"
__all__ = [
    "CChainA2C",
    "CChainCallback",
    "CChainDDPG",
    "CChainDQN",
    "CChainPPO",
    "CChainSAC",
    "CChainTD3",
    "ChurnMonitor",
    "ContinualEnv",
    "ContinualMetrics",
    "DoubleDQN",
    "FiniteCheck",
    "ResumableEnv",
    "TaskSignal",
    "TaskSync",
    "TensorBoardOverview",
    "TrainingCheckpoint",
    "make_lean",
    "resume",
    "task_switched",
    "transfer",
]

# Of sb3-contrib, which need not be installed: imported when they are asked for
_CONTRIB = ("CChainCrossQ", "CChainMaskablePPO", "CChainQRDQN", "CChainRecurrentPPO", "CChainTQC", "CChainTRPO")


if TYPE_CHECKING:  # they would take any name that `__getattr__` is there for
    from sb3_cchain.algorithms.contrib import CChainCrossQ as CChainCrossQ
    from sb3_cchain.algorithms.contrib import CChainMaskablePPO as CChainMaskablePPO
    from sb3_cchain.algorithms.contrib import CChainQRDQN as CChainQRDQN
    from sb3_cchain.algorithms.contrib import CChainRecurrentPPO as CChainRecurrentPPO
    from sb3_cchain.algorithms.contrib import CChainTQC as CChainTQC
    from sb3_cchain.algorithms.contrib import CChainTRPO as CChainTRPO
else:

    def __getattr__(name: str) -> Any:
        if name in _CONTRIB:
            return getattr(import_module("sb3_cchain.algorithms.contrib"), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_CONTRIB])


register_envs()
