"""The CSV files of returns: of training, and of evaluations."""

import csv
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TextIO

from sb3_cchain.locked_file import open_locked

RETURNS_CSV = "returns.csv"
COLUMNS: tuple[str, ...] = ("timesteps", "task_id", "n_episodes", "mean_return")


class ReturnsFile:
    """
    A file of returns that is open for writing, and locked against other processes.

    :param path: The file; its folder is made if needed
    :param rows: The rows that it begins with
    :param keep_old: Whether a file that has rows already is kept beside it, as ``<name>.1``, ``<name>.2``, ...
    :param columns: Its columns
    :raises ValueError: When the file that is there has other columns, or another process is writing it
    """

    def __init__(self, path: Path, rows: Iterable[Mapping[str, float]], keep_old: bool, columns: Sequence[str] = COLUMNS):
        self._columns = columns
        path.parent.mkdir(parents=True, exist_ok=True)
        has_rows = _check_header(path, columns)
        self._file = _open(path)
        if keep_old and has_rows:
            if os.name != "posix":
                self._file.close()  # Windows does not rename a file that is open
            os.rename(path, _free_name(path))
            self._file = _open(path)  # closes the old file, whose lock has kept other processes away until now
        self._file.truncate(0)
        csv.DictWriter(self._file, columns).writeheader()
        self.append(rows)

    def append(self, rows: Iterable[Mapping[str, float]]) -> None:
        """
        :param rows: Rows to write
        """
        csv.DictWriter(self._file, self._columns).writerows(rows)
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


def read_returns(path: str | Path, columns: Sequence[str] = COLUMNS) -> list[dict[str, float]]:
    """
    :param path: CSV file written by :class:`~sb3_cchain.ContinualMetrics`
    :param columns: Its columns: integers, and the return as the last
    :return: Its rows
    :raises ValueError: When it is not such a file, or a line of it is damaged
    """
    _check_header(Path(path), columns)
    rows = []
    with open(path, newline="") as file:
        for number, line in enumerate(file, start=1):
            if number == 1:
                continue
            try:
                *counts, mean_return = line.split(",")
                rows.append(dict(zip(columns, (*map(int, counts), float(mean_return)), strict=True)))
            except ValueError:
                raise _damaged(path, number, line, columns) from None
            # A number whose end is missing would be a number, too
            if not line.endswith("\n"):
                raise _damaged(path, number, line, columns)
    return rows


def _damaged(path: str | Path, number: int, line: str, columns: Sequence[str]) -> ValueError:
    return ValueError(
        f"{path} is damaged: line {number} must be whole and have the columns {', '.join(columns)}, got {line!r}. "
        "Delete that line if it is the last, or move the file away."
    )


def _check_header(path: Path, columns: Sequence[str]) -> bool:
    """Whether there are rows. Raises a ValueError when the file is not empty and has other columns."""
    if not path.exists():
        return False
    if path.is_dir():
        raise ValueError(f"`path` of the returns must be a file, but {path} is a folder")
    with open(path, newline="", errors="replace") as file:
        header = file.readline(1000)
        if header.rstrip("\r\n").split(",") != list(columns) and header != "":
            raise ValueError(
                f"{path} is not a file of returns: its first line must be {','.join(columns)!r}, got {header!r}. "
                "Give the callback another `path`, or move the file away."
            )
        return file.readline() != ""


def _open(path: Path) -> TextIO:
    message = f"Another process is writing {path}. Give each training a file of its own by the callback's `path`"
    return open_locked(path, message)


def _free_name(path: Path) -> Path:
    number = 1
    while path.with_name(f"{path.name}.{number}").exists():
        number += 1
    return path.with_name(f"{path.name}.{number}")
