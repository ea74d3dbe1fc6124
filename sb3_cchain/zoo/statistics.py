"""Where the statistics of ``VecNormalize`` are that belong to a saved model."""

import re
from pathlib import Path

BEST_STATISTICS = "best_model_vecnormalize.pkl"


def statistics_path(model_path: str | Path, env_name: str) -> Path:
    """
    :param model_path: A model saved by ``sb3-cchain train``
    :param env_name: The environment's name in RL Zoo's folders
    :return: Where the statistics of its ``VecNormalize`` are: beside it, or in the folder of the settings, which has those of
        the best model until training ends, and then those of the final model
    """
    path = Path(model_path)
    return statistics_beside(path) or path.parent / env_name / "vecnormalize.pkl"


def statistics_beside(model_path: Path) -> Path | None:
    """
    :param model_path: A saved model
    :return: Where the statistics are of a checkpoint by ``--save-freq``, and of the best model once training has ended; None
        for any other model
    """
    if model_path.name == "best_model.zip":
        statistics = model_path.with_name(BEST_STATISTICS)
        return statistics if statistics.is_file() else None
    checkpoint = re.fullmatch(r"(.+)_(\d+_steps)", model_path.stem)
    return None if checkpoint is None else model_path.with_name(f"{checkpoint[1]}_vecnormalize_{checkpoint[2]}.pkl")
