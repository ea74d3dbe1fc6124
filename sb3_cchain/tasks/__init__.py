"""Tasks: which one is due, how callbacks hear of a switch, and how environments stay in step with training."""

from sb3_cchain.tasks.boundary import TaskBoundary
from sb3_cchain.tasks.signal import task_switched
from sb3_cchain.tasks.sync import TaskSync
from sb3_cchain.tasks.task_signal import TaskSignal

__all__ = [
    "TaskBoundary",
    "TaskSignal",
    "TaskSync",
    "task_switched",
]
