"""The CSV file of the returns of training."""

import csv
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TextIO

from sb3_cchain.locked_file import open_locked

RETURNS_CSV = "returns.csv"
COLUMNS = ("timesteps", "task_id", "n_episodes", "mean_return")


class ReturnsFile:
    """
    A file of returns that is open for writing, and locked against other processes.

    :param path: The file; its folder is made if needed
    :param rows: The rows that it begins with
    :param keep_old: Whether a file that has rows already is kept beside it, as ``<name>.1``, ``<name>.2``, ...
    :raises ValueError: When the file that is there is not a file of returns, or another process is writing it
    """

    def __init__(self, path: Path, rows: Iterable[Mapping[str, float]], keep_old: bool):
        path.parent.mkdir(parents=True, exist_ok=True)
        has_rows = _check_header(path)
        self._file = _open(path)
        if keep_old and has_rows:
            if os.name != "posix":
                self._file.close()  # Windows does not rename a file that is open
            os.rename(path, _free_name(path))
            self._file = _open(path)  # closes the old file, whose lock has kept other processes away until now
        self._file.truncate(0)
        csv.DictWriter(self._file, COLUMNS).writeheader()
        self.append(rows)

    def append(self, rows: Iterable[Mapping[str, float]]) -> None:
        """
        :param rows: Rows to write
        """
        csv.DictWriter(self._file, COLUMNS).writerows(rows)
        self._file.flush()

    def state_dict(self) -> dict[str, str]:
        """
        :return: What the file holds
        """
        with open(self._file.name, newline="") as file:
            return {"text": file.read()}

    def load_state_dict(self, state: dict[str, str]) -> None:
        """
        :param state: What :meth:`state_dict` returned
        """
        self._file.truncate(0)
        self._file.write(state["text"])
        self._file.flush()

    def close(self) -> None:
        """Close the file, which another process can write then."""
        self._file.close()


def read_returns(path: str | Path) -> list[dict[str, float]]:
    """
    :param path: CSV file written by :class:`~sb3_cchain.ContinualMetrics`
    :return: Its rows
    :raises ValueError: When it is not such a file, or a line of it is damaged
    """
    _check_header(Path(path))
    rows = []
    with open(path, newline="") as file:
        for number, line in enumerate(file, start=1):
            if number == 1:
                continue
            try:
                timesteps, task_id, n_episodes, mean_return = line.split(",")
                rows.append(
                    dict(zip(COLUMNS, (int(timesteps), int(task_id), int(n_episodes), float(mean_return)), strict=True))
                )
            except ValueError:
                raise _damaged(path, number, line) from None
            # A number whose end is missing would be a number, too
            if not line.endswith("\n"):
                raise _damaged(path, number, line)
    return rows


def _damaged(path: str | Path, number: int, line: str) -> ValueError:
    return ValueError(
        f"{path} is damaged: line {number} must be whole and have the columns {', '.join(COLUMNS)}, got {line!r}. "
        "Delete that line if it is the last, or move the file away."
    )


def _check_header(path: Path) -> bool:
    """Whether there are rows. Raises a ValueError when the file is not empty and not a file of returns."""
    if not path.exists():
        return False
    if path.is_dir():
        raise ValueError(f"`path` of ContinualMetrics must be a file, but {path} is a folder")
    with open(path, newline="", errors="replace") as file:
        header = file.readline(1000)
        if header.rstrip("\r\n").split(",") != list(COLUMNS) and header != "":
            raise ValueError(
                f"{path} is not a file of returns: its first line must be {','.join(COLUMNS)!r}, got {header!r}. "
                "Give ContinualMetrics another `path`, or move the file away."
            )
        return file.readline() != ""


def _open(path: Path) -> TextIO:
    message = f"Another process is writing {path}. Give each training a file of its own: ContinualMetrics(path=...)"
    return open_locked(path, message)


def _free_name(path: Path) -> Path:
    number = 1
    while path.with_name(f"{path.name}.{number}").exists():
        number += 1
    return path.with_name(f"{path.name}.{number}")
