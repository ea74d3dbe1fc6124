"""Saved training: files that are either whole or absent, and going on from them."""

from sb3_cchain.checkpoint.callbacks import SafeCheckpointCallback, SaveBestModel
from sb3_cchain.checkpoint.files import check_writable, write_safely
from sb3_cchain.checkpoint.model_files import check_model_file, load_statistics, save_model, saved_timesteps
from sb3_cchain.checkpoint.resumable_env import ResumableEnv
from sb3_cchain.checkpoint.resume import load_model, resume
from sb3_cchain.checkpoint.saved_checkpoint import Checkpoint, find_checkpoint, has_checkpoint
from sb3_cchain.checkpoint.training_checkpoint import TrainingCheckpoint

__all__ = [
    "Checkpoint",
    "ResumableEnv",
    "SafeCheckpointCallback",
    "SaveBestModel",
    "TrainingCheckpoint",
    "check_model_file",
    "check_writable",
    "find_checkpoint",
    "has_checkpoint",
    "load_model",
    "load_statistics",
    "resume",
    "save_model",
    "saved_timesteps",
    "write_safely",
]
