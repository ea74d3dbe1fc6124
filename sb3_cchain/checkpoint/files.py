"""Files of saved training, which a process that is killed leaves either whole or as they were."""

import json
import os
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize


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


def save_model(model: BaseAlgorithm, path: str | Path) -> None:
    """
    ``model.save(path)`` by :func:`write_safely`.

    :param model: A model
    :param path: The zip file; as in SB3, a path without a suffix gets ``.zip``
    """
    path = Path(path)
    with write_safely(path if path.suffix else path.with_suffix(".zip")) as unfinished:
        model.save(unfinished)


def save_statistics(model: BaseAlgorithm, path: str | Path) -> None:
    """
    Save the ``VecNormalize`` of a model's environment, if there is one, by :func:`write_safely`.

    :param model: A model
    :param path: The pickle file
    """
    normalize = model.get_vec_normalize_env()
    if normalize is not None:
        with write_safely(path) as unfinished:
            normalize.save(str(unfinished))


def check_model_file(path: str | Path) -> None:
    """
    :param path: A saved model
    :raises ValueError: When the file is torn, as a kill during ``model.save()`` leaves it, or no saved model; the message
        names the newest whole model in the same folder
    """
    path = Path(path)
    fault = _fault(path)
    if fault is None:
        return
    others = sorted((other for other in path.parent.glob("*.zip") if other != path), key=os.path.getmtime, reverse=True)
    whole = next((other for other in others if _fault(other) is None), None)
    found = "There is no whole model beside it" if whole is None else f"The newest whole model beside it is {whole}"
    raise ValueError(f"{path} {fault}. {found}")


def _fault(path: Path) -> str | None:
    """What is wrong with a saved model, if anything."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist() if archive.testzip() is None else []
    except (zipfile.BadZipFile, zlib.error, EOFError):
        names = []
    if "data" in names:
        return None
    # PyTorch's files in it are zip files, too, so that a torn file may pass for one of those
    if "_stable_baselines3_version" in names:
        return "holds parameters without the model's settings (no entry `data`): save it by the model's save()"
    return "is torn or not a saved model: perhaps training was killed while it was written"


def saved_timesteps(path: str | Path) -> int:
    """
    :param path: A saved model
    :return: Environment steps that it was trained for. The rest of the file is not unpickled
    """
    with zipfile.ZipFile(path) as archive:
        return int(json.loads(archive.read("data"))["num_timesteps"])


def load_statistics(normalize: VecNormalize, path: str | Path) -> None:
    """
    Give a ``VecNormalize`` the statistics of a saved one. Its settings stay as they are.

    :param normalize: The wrapper, or one of its subclasses
    :param path: What ``VecNormalize.save()`` wrote
    :raises ValueError: When one of both normalises observations and the other does not
    """
    saved = VecNormalize.load(str(path), normalize.venv)  # pyright: ignore[reportArgumentType]
    if saved.norm_obs != normalize.norm_obs:
        raise ValueError(
            f"The statistics in {path} are of norm_obs={saved.norm_obs}, but training has norm_obs={normalize.norm_obs}. "
            "Normalise as the model was trained"
        )
    for name in getattr(normalize, "statistics", {"obs_rms", "ret_rms"}):
        if name in vars(saved):
            setattr(normalize, name, vars(saved)[name])


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
