"""Tasks: which one is due, how callbacks hear of a switch, and how environments stay in step with training."""

from sb3_cchain.tasks.boundary import TaskBoundary
from sb3_cchain.tasks.sync import TaskSync

__all__ = [
    "TaskBoundary",
    "TaskSync",
]
