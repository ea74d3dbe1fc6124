"""Files that one process at a time may write."""

import os
from pathlib import Path
from typing import TextIO
from weakref import WeakValueDictionary

try:
    import fcntl
except ImportError:  # Windows: another process that writes the file is not noticed
    fcntl = None  # type: ignore[assignment]

# The files of this process. One that is still open belongs to training that was interrupted
_open_files: WeakValueDictionary[Path, TextIO] = WeakValueDictionary()


def _leave_to_parent() -> None:
    """In a process that was forked, such as that of an environment: it would hold the locks when its parent has let go."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for file in _open_files.values():
        if not file.closed:
            # It stays open, but what is still in its buffer is written by the parent alone
            os.dup2(nowhere, file.fileno())
    os.close(nowhere)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_to_parent)


def open_locked(path: Path, message: str) -> TextIO:
    """
    Open a file for appending, locked against other processes until it is closed. In this process it is taken from whoever has
    not closed it.

    :param path: The file; it is made if it does not exist
    :param message: What the error says when another process has it
    :return: The file
    :raises ValueError: When another process has it
    """
    interrupted = _open_files.pop(path.resolve(), None)
    if interrupted is not None:
        interrupted.close()
    file = open(path, "a", newline="")
    if fcntl is not None:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            raise ValueError(message) from None
        except OSError:
            pass  # the file system has no locks
    _open_files[path.resolve()] = file
    return file
