"""What it means that the world changes, and who hears of it."""

from sb3_cchain.tasks.boundary import TaskBoundary
from sb3_cchain.tasks.sync import TaskSync

__all__ = [
    "TaskBoundary",
    "TaskSync",
]
