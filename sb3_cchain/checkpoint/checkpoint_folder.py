"""
Checkpoints of a training on the disk.

A folder of checkpoints holds ``step_000000010000``, ``step_000000020000`` and so on, each of which is whole or absent, and
``chunks``, the pieces of their big arrays. Only one training writes to it at a time.
"""

import hashlib
import json
import os
import pickle
import re
import shutil
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from platform import python_version
from typing import Any, TextIO

import numpy as np
import torch as th

from sb3_cchain.checkpoint.chunks import ChunkStore
from sb3_cchain.checkpoint.files import check_writable, sync_folder, write_safely
from sb3_cchain.locked_file import open_locked
from sb3_cchain.validation import check_path

# Of the files. A later version of the package reads it, or says that it does not
FORMAT = 3
INFO, MODEL, STATE = "checkpoint.json", "model.zip", "training.pkl"
LOCK = ".lock"
# Before the name of a checkpoint in place of which an older one was taken
DAMAGED = "damaged_"
PACKAGES = ("sb3-cchain", "stable-baselines3", "sb3-contrib", "torch", "gymnasium", "numpy")


class Checkpoint:
    """
    A checkpoint on the disk, which is whole.

    :param path: Its folder
    :raises ValueError: When it is no checkpoint, torn, damaged, or of a format that this version does not read
    """

    def __init__(self, path: str | Path):
        self.path: Path = Path(path)
        self.info: dict[str, Any] = _read_info(self.path)
        for name, expected in self.info["files"].items():
            file = self.path / name
            if not file.is_file() or _hash(file) != expected:
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
            whole = next(filter(None, map(_whole, step_folders(path.parent))), None)
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


def is_being_written(path: Path) -> bool:
    """
    :param path: A folder of checkpoints, which need not exist
    :return: Whether the training of another process writes to it
    """
    try:
        open_locked(path / LOCK, "").close()
    except ValueError:
        return True
    except OSError:  # there is no such folder, or nobody may write to it
        return False
    return False


def _whole(path: Path) -> Checkpoint | None:
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
    return sorted(found, key=_step, reverse=True)


def _step(folder: Path) -> int:
    return int(folder.name.removeprefix("step_"))


def chunk_store(folder: Path) -> ChunkStore:
    """
    :param folder: A folder of checkpoints
    :return: The pieces of their big arrays
    """
    return ChunkStore(folder / "chunks")


class CheckpointFolder:
    """
    A folder of checkpoints to write to, locked against other trainings until it is closed.

    :param path: The folder; it is made if it does not exist
    :param keep: How many checkpoints stay
    :param newest: Step of the newest checkpoint that may be there; None when there must be none
    :raises ValueError: When nothing can be written to it, another training writes to it, or there are later checkpoints in it
    """

    def __init__(self, path: Path, keep: int, newest: int | None = None):
        self.path, self.keep = path, keep
        try:
            check_writable(path)
        except OSError as error:
            raise ValueError(f"`path` must be a folder that can be written to, got {str(path)!r}: {error}") from error
        message = f"Another process is writing checkpoints to {path}. Give each training a `path` of its own."
        self._lock: TextIO = open_locked(path / LOCK, message)
        try:
            self._check_newest(newest)
        except ValueError:
            self.close()
            raise
        for unfinished in path.glob(".step_*"):
            shutil.rmtree(unfinished)
        # A damaged piece would pass for one that is there already, when training comes to the same content again
        self.remove_useless_chunks()

    def _check_newest(self, newest: int | None) -> None:
        there = step_folders(self.path)
        if newest is None and there:
            raise ValueError(
                f"`path` holds checkpoints of another training already, the newest of which is {there[0]}. Go on from it by "
                "resume(), or with the same model by learn(..., reset_num_timesteps=False), give another path, or move them "
                "away."
            )
        later = [folder for folder in there if newest is not None and _step(folder) > newest]
        for folder in [folder for folder in later if _whole(folder) is None]:
            aside = folder.with_name(f"{DAMAGED}{folder.name}")
            shutil.rmtree(aside, ignore_errors=True)
            os.rename(folder, aside)
            later.remove(folder)
        if later:
            raise ValueError(
                f"Training goes on from step {newest}, but `path` holds later checkpoints, the newest of which is {later[0]}. "
                "Give another path, or move them away."
            )

    @property
    def store(self) -> ChunkStore:
        """The pieces of the big arrays."""
        return chunk_store(self.path)

    def write(self, info: Mapping[str, Any], save_model: Callable[[Path], None], state: Mapping[str, Any]) -> Path:
        """
        Write a checkpoint, and remove those that are too many.

        :param info: What is known about it
        :param save_model: Writes the model's file
        :param state: What is not in the model's file
        :return: Its folder
        """
        target = self.path / step_name(info["num_timesteps"])
        if target.exists():  # stopped before anything was trained
            return target
        unfinished = self.path / f".{target.name}"
        unfinished.mkdir()
        try:
            with write_safely(unfinished / MODEL) as path:
                save_model(path)
            with write_safely(unfinished / STATE) as path, open(path, "wb") as file:
                pickle.dump(state, file, protocol=5)
            files = {name: _hash(unfinished / name) for name in (MODEL, STATE)}
            write_info(unfinished, {"format": FORMAT, **info, "files": files})
            os.rename(unfinished, target)
        except BaseException:  # it would fill a disk that is full already
            shutil.rmtree(unfinished, ignore_errors=True)
            raise
        sync_folder(self.path)
        self._remove_old()
        return target

    def remove_useless_chunks(self) -> None:
        """Remove the pieces of big arrays that no checkpoint needs, as of one that could not be written."""
        needed: set[str] = set()
        for file in self.path.glob(f"*/{INFO}"):  # copies by other names, too
            if not file.parent.name.startswith(DAMAGED):
                with suppress(ValueError):  # a damaged one, which is of no use any more
                    needed.update(_read_info(file.parent)["chunks"])
        self.store.remove_all_but(needed)

    def _remove_old(self) -> None:
        folders = step_folders(self.path)
        for folder in folders[self.keep :]:
            # By a hidden name first, so that one that is half removed does not pass for a damaged one
            hidden = folder.with_name(f".{folder.name}")
            os.rename(folder, hidden)
            shutil.rmtree(hidden)
        self.remove_useless_chunks()

    def close(self) -> None:
        """Let others write to it."""
        self._lock.close()


def step_name(num_timesteps: int) -> str:
    """
    :param num_timesteps: Environment steps
    :return: Name of the checkpoint's folder
    """
    return f"step_{num_timesteps:012d}"


def _place(device: th.device) -> tuple[str, int]:
    return device.type, device.index or 0


def _major(version_number: str) -> int:
    return int(version_number.partition(".")[0])


@cache
def package_versions() -> Mapping[str, str]:
    """
    :return: The versions that a checkpoint names. They are looked up once, for reading the metadata of a package takes longer
        than writing a small checkpoint
    """
    found = {"python": python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _read_info(path: Path) -> dict[str, Any]:
    file = path / INFO
    if not file.is_file():
        raise ValueError(f"{path} is not a checkpoint of a training: it has no {INFO}")
    try:
        text = file.read_text()
        info: dict[str, Any] = json.loads(text)
        found = info["format"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{file} is damaged: {error}") from error
    if found != FORMAT:
        made_with = info.get("versions", {}).get("sb3-cchain", "an unknown version")
        raise ValueError(
            f"{path} has the format {found} of sb3-cchain {made_with}; this version reads the format {FORMAT}. "
            f"To go on from its parameters alone, load {path / MODEL}"
        )
    info.pop("checksum", None)
    if text != _info_text(info):
        raise ValueError(f"{file} is damaged: it is not what was written")
    return info


def write_info(path: Path, info: Mapping[str, Any]) -> None:
    """
    :param path: Folder of a checkpoint
    :param info: What is known about it
    """
    with write_safely(path / INFO) as file:
        file.write_text(_info_text(info))


def _info_text(info: Mapping[str, Any]) -> str:
    """The file's content, with a checksum of the rest."""
    checksum = hashlib.sha256(json.dumps(info, default=_plain).encode()).hexdigest()
    return json.dumps({**info, "checksum": checksum}, indent=1, default=_plain) + "\n"


def _plain(value: Any) -> Any:
    """NumPy's numbers, and paths, that were given as arguments."""
    return value.item() if isinstance(value, np.generic) else os.fspath(value)


def _hash(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
