"""Callbacks for training: the paper's rollouts, schedules, how well the agent does, and what callbacks share."""

from sb3_cchain.callbacks.continual_metrics import ContinualMetrics, task_averages
from sb3_cchain.callbacks.episodic_rollouts import EpisodicRollouts
from sb3_cchain.callbacks.no_bootstrap_at_cuts import NoBootstrapAtCuts
from sb3_cchain.callbacks.returns_file import read_returns
from sb3_cchain.callbacks.rollout_normalized_advantage import RolloutNormalizedAdvantage
from sb3_cchain.callbacks.schedules import OverallSchedule, TaskSchedule
from sb3_cchain.callbacks.task_learning_starts import TaskLearningStarts
from sb3_cchain.callbacks.task_progress_bar import TaskProgressBar

__all__ = [
    "ContinualMetrics",
    "EpisodicRollouts",
    "NoBootstrapAtCuts",
    "OverallSchedule",
    "RolloutNormalizedAdvantage",
    "TaskLearningStarts",
    "TaskProgressBar",
    "TaskSchedule",
    "read_returns",
    "task_averages",
]
