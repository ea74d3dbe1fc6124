"""Files that one process at a time may write."""

from pathlib import Path
from typing import TextIO
from weakref import WeakValueDictionary

try:
    import fcntl
except ImportError:  # Windows: another process that writes the file is not noticed
    fcntl = None  # type: ignore[assignment]

# The files of this process. One that is still open belongs to training that was interrupted
_open_files: WeakValueDictionary[Path, TextIO] = WeakValueDictionary()


def open_locked(path: Path, message: str) -> TextIO:
    """
    Open a file for appending, locked against other processes until it is closed. In this process it is taken from whoever has
    not closed it.

    :param path: The file; it is made if it does not exist
    :param message: Of the error
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
