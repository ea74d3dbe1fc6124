"""The folder in which callbacks write files of their own."""

from pathlib import Path

from stable_baselines3.common.base_class import BaseAlgorithm


def log_folder(model: BaseAlgorithm) -> Path | None:
    """
    :param model: A model that is being trained
    :return: The folder of its logs, if it has ``tensorboard_log`` or was given a logger by ``set_logger()``. The logger of any
        other model writes to a temporary folder, another one in each ``learn()``, so None is returned then.
    """
    if model.tensorboard_log is None and not model._custom_logger:
        return None
    # A logger of one's own need not derive from SB3's
    folder = model.logger.get_dir() if hasattr(model.logger, "get_dir") else None
    return None if folder is None else Path(folder)


def log_path(model: BaseAlgorithm, name: str) -> Path | None:
    """
    :param model: A model that is being trained
    :param name: Name of a file or a folder
    :return: Where it is in :func:`log_folder`; None where there is no such folder
    """
    folder = log_folder(model)
    return None if folder is None else folder / name
