"""
The attempts at a run: a folder each, in which an attempt leaves its checkpoints. The next attempt goes on from the newest.

    <logs>/<experiment>/<suite>/<environment>/<method or variant>/seed_<seed>/attempt_<time>_<number>/
"""

import json
import shutil
import uuid
from collections.abc import Iterator
from datetime import datetime, timezone
from importlib.metadata import version
from pathlib import Path
from platform import python_version
from typing import Any, NamedTuple

from benchmarks.grid.run import Run
from sb3_cchain.checkpoint import write_safely
from sb3_cchain.checkpoint.checkpoint_folder import is_being_written
from sb3_cchain.checkpoint.saved_checkpoint import Checkpoint, step_folders

# Packages whose versions are recorded
PACKAGES = ("sb3-cchain", "stable-baselines3", "gymnasium", "torch")

ABOUT = "attempt.json"
# Where `sb3-cchain train` has the checkpoints, in the attempt's folder
CHECKPOINTS = "*/*/checkpoints"


class Origin(NamedTuple):
    """
    The checkpoint that an attempt goes on from.

    :param attempt: Name of the attempt that made it
    :param checkpoint: Its path in that attempt's folder
    :param num_timesteps: Environment steps at it
    :param seconds: Seconds trained up to it
    """

    attempt: str
    checkpoint: str
    num_timesteps: int
    seconds: float


class Attempt:
    """
    One attempt at a run.

    :param folder: Its folder
    :raises ValueError: When nothing is known about it
    """

    def __init__(self, folder: Path):
        self.folder = folder
        try:
            about = json.loads((folder / ABOUT).read_text())
            self.settings: dict[str, Any] = about["settings"]
            self.started: str = about["started"]
            self.versions: dict[str, str] = about["versions"]
            self.git_commit: str | None = about["git_commit"]
            # Ended by an error before anything was trained
            self.is_broken: bool = about["is_broken"]
            self.origin = None if about["origin"] is None else Origin(**about["origin"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{folder} is no attempt at a run: {error}") from error

    def chain(self) -> list["Attempt"]:
        """
        :return: The attempts that led to this one, each of which goes on from a checkpoint of the one before, and this one
        :raises ValueError: When one of them is not there any more
        """
        before = [] if self.origin is None else Attempt(self.folder.parent / self.origin.attempt).chain()
        return [*before, self]

    def checkpoints(self) -> list[Path]:
        """
        :return: Its checkpoints, perhaps damaged
        """
        return [path for folder in self.folder.glob(CHECKPOINTS) for path in step_folders(folder)]

    def mark_broken(self) -> None:
        """Note that it was ended by an error before anything was trained."""
        about = json.loads((self.folder / ABOUT).read_text())
        _write(self.folder, {**about, "is_broken": True})


def new_attempt(run: Run, logs: Path, git_commit: str | None) -> tuple[Attempt, Path | None]:
    """
    :param run: A run
    :param logs: Folder of all logs
    :param git_commit: Commit of the checkout
    :return: A new attempt at it, and the checkpoint that it is to go on from, None where there is none
    """
    started = datetime.now(timezone.utc)
    origin, path = newest_checkpoint(run, logs)
    folder = run.path_in(logs) / f"attempt_{started:%Y%m%dT%H%M%S_%f}_{uuid.uuid4().hex[:8]}"
    folder.mkdir(parents=True)
    about = {
        "settings": run.settings,
        "started": started.isoformat(timespec="seconds"),
        "versions": {**{name: version(name) for name in (*PACKAGES, "numpy")}, "python": python_version()},
        "git_commit": git_commit,
        "origin": None if origin is None else origin._asdict(),
        "is_broken": False,
    }
    _write(folder, about)
    return Attempt(folder), path


def remove_checkpoints(run: Run, logs: Path) -> None:
    """
    Remove the checkpoints of all attempts at a run, which has a result now, but those of an attempt that another command makes
    at the same time.

    :param run: The run
    :param logs: Folder of all logs
    """
    for attempt in _attempts(run, logs):
        for folder in attempt.folder.glob(CHECKPOINTS):
            if not is_being_written(folder):
                shutil.rmtree(folder, ignore_errors=True)


def _attempts(run: Run, logs: Path) -> Iterator[Attempt]:
    """The attempts with the settings of a run."""
    for folder in sorted(run.path_in(logs).glob("attempt_*")):
        try:
            attempt = Attempt(folder)
        except ValueError:
            continue
        if attempt.settings == run.settings:
            yield attempt


def newest_checkpoint(run: Run, logs: Path) -> tuple[Origin | None, Path | None]:
    """
    :param run: A run
    :param logs: Folder of all logs
    :return: The newest whole checkpoint of all attempts at it, without those that an attempt could not go on from, and its
        path; None where there is none
    """
    attempts = list(_attempts(run, logs))
    refused = {(a.origin.attempt, a.origin.checkpoint) for a in attempts if a.is_broken and a.origin is not None}
    found = [(path.name, attempt.folder.name, path, attempt) for attempt in attempts for path in attempt.checkpoints()]
    for _, name, path, attempt in sorted(found, key=lambda entry: entry[:2], reverse=True):
        inside = path.relative_to(attempt.folder).as_posix()
        if (name, inside) in refused:
            continue
        try:
            attempt.chain()  # the result is also made from what those before have logged
            checkpoint = Checkpoint(path)
        except (ValueError, OSError):  # damaged, or removed meanwhile
            continue
        return Origin(name, inside, checkpoint.num_timesteps, checkpoint.seconds), path
    return None, None


def _write(folder: Path, about: dict[str, Any]) -> None:
    with write_safely(folder / ABOUT) as path:
        path.write_text(json.dumps(about, indent=1) + "\n")
