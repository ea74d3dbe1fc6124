"""Writes files that a process which is killed leaves either whole or as they were."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile


@contextmanager
def write_safely(path: str | Path) -> Iterator[Path]:
    """
    Write a file under another name beside it, and put it in its place when it is complete and on the disk. A process that is
    killed in between leaves what was there before.

    :param path: The file; its folder is made if it does not exist
    :return: Yields the path to write to
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Its suffix keeps SB3 from adding one, and hides it from those who look for models
    unfinished = path.with_name(f".{path.name}.unfinished")
    try:
        yield unfinished
        with open(unfinished, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(unfinished, path)
        sync_folder(path.parent)
    finally:
        unfinished.unlink(missing_ok=True)


def sync_files(folder: Path) -> None:
    """
    Have what was written to the files in a folder on the disk.

    :param folder: The folder, which need not exist; what is in folders in it is left out
    """
    for path in folder.glob("*"):
        if path.is_file():
            with open(path, "rb") as file:
                os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """
    Have the names of the files in a folder on the disk.

    :param folder: The folder
    """
    if os.name == "posix":  # elsewhere folders cannot be opened
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            with suppress(OSError):  # some network file systems cannot do it for folders
                os.fsync(descriptor)
        finally:
            os.close(descriptor)


def check_writable(folder: Path) -> None:
    """
    Make a folder, and write to it.

    :param folder: The folder
    :raises OSError: When the folder cannot be made, or nothing can be written there
    """
    folder.mkdir(parents=True, exist_ok=True)
    with TemporaryFile(dir=folder) as file:
        file.write(bytes(4096))
        file.flush()
