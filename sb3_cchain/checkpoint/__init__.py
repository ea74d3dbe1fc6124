"""Saved training: files that are either whole or absent, and going on from them."""

from sb3_cchain.checkpoint.callbacks import SafeCheckpointCallback, SaveBestModel
from sb3_cchain.checkpoint.files import (
    check_model_file,
    check_writable,
    load_statistics,
    save_model,
    saved_timesteps,
    write_safely,
)

__all__ = [
    "SafeCheckpointCallback",
    "SaveBestModel",
    "check_model_file",
    "check_writable",
    "load_statistics",
    "save_model",
    "saved_timesteps",
    "write_safely",
]
