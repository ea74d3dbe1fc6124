"""Where the statistics of ``VecNormalize`` are that belong to a saved model."""

import re
from pathlib import Path


def statistics_path(model_path: str | Path, env_name: str) -> Path:
    """
    :param model_path: A model saved by ``sb3-cchain train``
    :param env_name: The environment's name in RL Zoo's folders
    :return: Where the statistics of its ``VecNormalize`` are: those of a checkpoint beside it, those of the final and of the
        best model in the folder of the settings
    """
    path = Path(model_path)
    return checkpoint_statistics(path) or path.parent / env_name / "vecnormalize.pkl"


def checkpoint_statistics(model_path: Path) -> Path | None:
    """
    :param model_path: A saved model
    :return: For a checkpoint by ``--save-freq`` where its statistics are, None for any other model
    """
    checkpoint = re.fullmatch(r"(.+)_(\d+_steps)", model_path.stem)
    return None if checkpoint is None else model_path.with_name(f"{checkpoint[1]}_vecnormalize_{checkpoint[2]}.pkl")
