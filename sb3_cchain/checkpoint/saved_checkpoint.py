"""
Checkpoints of a training on the disk, to read.

A folder of checkpoints holds ``step_000000010000``, ``step_000000020000`` and so on, each of which is whole or absent, and
``chunks``, the pieces of their big arrays.
"""

import pickle
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_cchain.checkpoint.checkpoint_info import MODEL, STATE, file_hash, package_versions, read_info
from sb3_cchain.checkpoint.chunks import ChunkStore
from sb3_cchain.validation import check_path


class Checkpoint:
    """
    A checkpoint on the disk, which is whole.

    :param path: Its folder
    :raises ValueError: When it is no checkpoint, torn, damaged, or of a format that this version does not read
    """

    def __init__(self, path: str | Path):
        self.path: Path = Path(path)
        self.info: dict[str, Any] = read_info(self.path)
        for name, expected in self.info["files"].items():
            file = self.path / name
            if not file.is_file() or file_hash(file) != expected:
                raise ValueError(f"{self.path} is damaged: {name} is missing, or is not what was written")
        try:
            self.store.check(self.info["chunks"])
        except ValueError as error:
            raise ValueError(f"{self.path} is damaged: {error}") from error

    @property
    def folder(self) -> Path:
        """The folder of checkpoints that it is in."""
        return self.path.parent

    @property
    def store(self) -> ChunkStore:
        """The pieces of the big arrays."""
        return chunk_store(self.folder)

    @property
    def model_path(self) -> Path:
        """The model, as Stable-Baselines3 saves it."""
        return self.path / MODEL

    @property
    def num_timesteps(self) -> int:
        """Environment steps that the model was trained for."""
        return self.info["num_timesteps"]

    @property
    def total_timesteps(self) -> int:
        """Environment steps at which the training was to end."""
        return self.info["total_timesteps"]

    @property
    def seconds(self) -> float:
        """Seconds that the training had taken, interruptions not counted."""
        return self.info["seconds"]

    def read_state(self) -> dict[str, Any]:
        """
        :return: What is not in the model's file. Unpickled, so a checkpoint must come from somebody you trust.
        :raises ValueError: When it was made with other code, whose classes are not here
        """
        try:
            with open(self.path / STATE, "rb") as file:
                state: dict[str, Any] = pickle.load(file)
        except (pickle.UnpicklingError, AttributeError, ImportError, TypeError, EOFError) as error:
            made_with = self.info["versions"].get("sb3-cchain", "unknown")
            raise ValueError(
                f"{self.path / STATE} cannot be read ({error}): it was made with other code, sb3-cchain {made_with}"
            ) from error
        return state

    def device(self, wanted: th.device | str = "auto") -> th.device:
        """
        :param wanted: PyTorch device to continue on; ``"auto"`` for that of the training
        :return: The device of the training
        :raises ValueError: When ``wanted`` is another one, or PyTorch does not find it here: training would not be the same
        """
        saved = th.device(self.info["device"])
        instead = f"To go on from its parameters alone, load {self.model_path} on another device."
        if wanted != "auto" and _place(th.device(wanted)) != _place(saved):
            raise ValueError(f"`device` must be {saved}, on which {self.path} was trained; got {wanted}. {instead}")
        try:
            th.empty(0, device=saved)
        except (RuntimeError, AssertionError) as error:
            raise ValueError(
                f"{self.path} was trained on {saved}, which PyTorch does not find here ({error}). {instead}"
            ) from error
        return saved

    def check_numpy(self) -> None:
        """
        :raises ValueError: When it was made with a later major version of NumPy, whose pickles the installed one cannot read
        """
        made_with = self.info["versions"].get("numpy", "0")
        if _major(made_with) > _major(np.__version__):
            raise ValueError(
                f"{self.path} was made with NumPy {made_with}, whose pickles NumPy {np.__version__} cannot read: "
                f"go on with NumPy {_major(made_with)} or later"
            )

    def warn_of_other_versions(self) -> None:
        """Warn when it was made by other versions than those that are installed: results may differ then."""
        installed = package_versions()
        other = [
            f"{name} {made_with} (now {installed.get(name, 'absent')})"
            for name, made_with in self.info["versions"].items()
            if installed.get(name) != made_with
        ]
        if other:
            warnings.warn(
                f"{self.path} was made with {', '.join(other)}. Training goes on, but perhaps not exactly as it would have."
            )


def find_checkpoint(path: str | Path) -> Checkpoint:
    """
    :param path: A checkpoint, or a folder of checkpoints
    :return: The checkpoint, or the newest whole one in the folder
    :raises TypeError: When it is no path
    :raises ValueError: When there is none, or all are damaged, naming what is wrong with each
    """
    path = check_path("path", path)
    if not path.is_dir():
        reason = "it is a file" if path.exists() else "there is no such folder"
        raise ValueError(f"{path} is not a checkpoint of a training, nor a folder of checkpoints: {reason}")
    candidates = step_folders(path)
    if not candidates:
        try:
            return Checkpoint(path)
        except ValueError as error:
            whole = next(filter(None, map(whole_checkpoint, step_folders(path.parent))), None)
            advice = "" if whole is None else f". The newest whole checkpoint beside it is {whole.path}"
            raise ValueError(f"{error}{advice}") from None
    faults = []
    for candidate in candidates:
        try:
            checkpoint = Checkpoint(candidate)
        except ValueError as error:
            faults.append(str(error))
            continue
        for fault in faults:
            warnings.warn(f"{fault}. An older checkpoint is taken instead.")
        return checkpoint
    raise ValueError(f"{path} holds no whole checkpoint: {'; '.join(faults)}")


def has_checkpoint(path: str | Path) -> bool:
    """
    :param path: A folder of checkpoints, which need not exist
    :return: Whether there is a checkpoint in it, whole or not
    """
    return bool(step_folders(Path(path)))


def whole_checkpoint(path: Path) -> Checkpoint | None:
    """
    :param path: Folder of a checkpoint, perhaps damaged
    :return: The checkpoint, if it is whole
    """
    try:
        return Checkpoint(path)
    except ValueError:
        return None


def step_folders(folder: Path) -> list[Path]:
    """
    :param folder: A folder of checkpoints, which need not exist
    :return: The checkpoints in it, perhaps damaged, the newest first. Another name, such as that of a copy, is somebody else's
    """
    found = [path for path in folder.glob("step_*") if re.fullmatch(r"step_\d{12,}", path.name)]
    return sorted(found, key=step_of, reverse=True)


def step_of(folder: Path) -> int:
    """
    :param folder: Folder of a checkpoint
    :return: Environment steps, by its name
    """
    return int(folder.name.removeprefix("step_"))


def step_name(num_timesteps: int) -> str:
    """
    :param num_timesteps: Environment steps
    :return: Name of the checkpoint's folder
    """
    return f"step_{num_timesteps:012d}"


def chunk_store(folder: Path) -> ChunkStore:
    """
    :param folder: A folder of checkpoints
    :return: The pieces of their big arrays
    """
    return ChunkStore(folder / "chunks")


def _place(device: th.device) -> tuple[str, int]:
    return device.type, device.index or 0


def _major(version_number: str) -> int:
    return int(version_number.partition(".")[0])
