"""The neural tangent kernels (NTKs) that are kept of a training, at a few times."""

import shutil
from bisect import bisect_left
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.grid.results import Result
from sb3_cchain.analysis import NTKCallback
from sb3_cchain.callbacks.log_folder import log_folder
from sb3_cchain.checkpoint import write_safely

FILE = "ntk.npz"


class NTKSnapshots(NTKCallback):
    """
    NTKCallback that also writes the latest matrix at or before each of some times to ``ntk.npz``, when training ends.

    :param times: Environment steps, ascending
    :param interval: As of NTKCallback
    """

    def __init__(self, times: Sequence[int], interval: int | None = None):
        super().__init__(interval=interval, picture_interval=0)
        self.times = tuple(times)
        # By the number of the time: environment steps, and the matrix
        self.snapshots: dict[int, tuple[int, np.ndarray]] = {}

    def _on_rollout_end(self) -> None:
        n_before = self._n_matrices
        super()._on_rollout_end()
        period = bisect_left(self.times, self.num_timesteps)
        if self._n_matrices > n_before and period < len(self.times):
            self.snapshots[period] = self.num_timesteps, self.matrix.cpu().numpy().astype(np.float32)

    def _on_training_end(self) -> None:
        folder = log_folder(self.model)
        if folder is not None and self.snapshots:
            write_snapshots(dict(self.snapshots.values()), folder / FILE)


def write_snapshots(matrices: dict[int, np.ndarray], path: Path) -> None:
    """
    :param matrices: NTKs by environment steps
    :param path: File
    """
    with write_safely(path) as unfinished, open(unfinished, "wb") as file:
        arrays: dict[str, Any] = {str(steps): matrix for steps, matrix in matrices.items()}
        np.savez_compressed(file, **arrays)


def read_snapshots(result: Result) -> dict[int, np.ndarray]:
    """
    :param result: A finished run
    :return: NTKs by environment steps, nothing where none were kept
    """
    file = result.path / FILE
    if not file.exists():
        return {}
    with np.load(file) as arrays:
        return {int(steps): arrays[steps] for steps in sorted(arrays, key=int)}


def keep_snapshots(result: Result, logs: Path) -> None:
    """
    Put the matrices of a finished run from its logs beside its result, unless they are there.

    :param result: The run
    :param logs: Folder of all logs
    """
    written = sorted(result.path_in(logs).glob(f"attempt_*/tensorboard/*/*/{FILE}"))
    if written and not (result.path / FILE).exists():
        with write_safely(result.path / FILE) as unfinished:
            shutil.copyfile(written[-1], unfinished)
