"""The files of saved models, and of the statistics of their ``VecNormalize``."""

import json
import os
import zipfile
import zlib
from pathlib import Path

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from sb3_cchain.checkpoint.files import write_safely


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
