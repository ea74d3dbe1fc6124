"""A folder of checkpoints that a training writes to. Only one training writes to it at a time."""

import os
import pickle
import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

from sb3_cchain.checkpoint.checkpoint_info import FORMAT, INFO, MODEL, STATE, file_hash, read_info, write_info
from sb3_cchain.checkpoint.chunks import ChunkStore
from sb3_cchain.checkpoint.files import check_writable, sync_folder, write_safely
from sb3_cchain.checkpoint.saved_checkpoint import chunk_store, step_folders, step_name, step_of, whole_checkpoint
from sb3_cchain.locked_file import open_locked

LOCK = ".lock"
# Before the name of a checkpoint in place of which an older one was taken
DAMAGED = "damaged_"


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
        later = [folder for folder in there if newest is not None and step_of(folder) > newest]
        for folder in [folder for folder in later if whole_checkpoint(folder) is None]:
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
            files = {name: file_hash(unfinished / name) for name in (MODEL, STATE)}
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
                    needed.update(read_info(file.parent)["chunks"])
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
