"""What TensorBoard shows of a run: charts in groups, and the hyperparameters."""

from sb3_cchain.tensorboard.overview import TensorBoardOverview

__all__ = [
    "TensorBoardOverview",
]
