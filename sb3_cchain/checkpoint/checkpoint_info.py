"""The files of a checkpoint, and the one that describes the others."""

import hashlib
import json
import os
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from platform import python_version
from typing import Any

import numpy as np

from sb3_cchain.checkpoint.files import write_safely

# Of the files. A later version of the package reads it, or says that it does not
FORMAT = 3
INFO, MODEL, STATE = "checkpoint.json", "model.zip", "training.pkl"
PACKAGES = ("sb3-cchain", "stable-baselines3", "sb3-contrib", "torch", "gymnasium", "numpy")


def read_info(path: Path) -> dict[str, Any]:
    """
    :param path: Folder of a checkpoint
    :return: What is known about it
    :raises ValueError: When there is no such file, it is damaged, or of a format that this version does not read
    """
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


def file_hash(file: Path) -> str:
    """
    :param file: A file
    :return: The SHA-256 of its content
    """
    return hashlib.sha256(file.read_bytes()).hexdigest()


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
