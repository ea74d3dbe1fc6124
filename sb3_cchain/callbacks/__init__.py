"""Callbacks for training in continual environments, and for seeing what it does."""

from sb3_cchain.callbacks.continual_metrics import ContinualMetrics, read_returns
from sb3_cchain.callbacks.episodic_rollouts import EpisodicRollouts
from sb3_cchain.callbacks.rollout_normalized_advantage import RolloutNormalizedAdvantage
from sb3_cchain.callbacks.task_learning_starts import TaskLearningStarts
from sb3_cchain.callbacks.task_sync import TaskSync
from sb3_cchain.callbacks.tensorboard_overview import TensorBoardOverview

__all__ = [
    "ContinualMetrics",
    "EpisodicRollouts",
    "RolloutNormalizedAdvantage",
    "TaskLearningStarts",
    "TaskSync",
    "TensorBoardOverview",
    "read_returns",
]
