"""Where a training logs to, so that it goes on there."""

import warnings
from collections.abc import Mapping
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import (
    CSVOutputFormat,
    HumanOutputFormat,
    JSONOutputFormat,
    KVWriter,
    Logger,
    TensorBoardOutputFormat,
    make_output_format,
)

from sb3_cchain.callbacks.log_folder import log_folder

# By the names that Stable-Baselines3 has for them
_FORMATS = {CSVOutputFormat: "csv", JSONOutputFormat: "json", TensorBoardOutputFormat: "tensorboard"}


def describe_log(model: BaseAlgorithm) -> dict[str, Any]:
    """
    :param model: A model in ``learn()``
    :return: The folder of its logger, None when the logger has none that lasts; the ``formats`` of
        Stable-Baselines3 that it writes; and the classes of ``others``
    """
    formats, others = [], []
    for output in getattr(model.logger, "output_formats", [model.logger]):
        name = _format(output)
        if name is not None:
            formats.append(name)
        elif not type(output).__module__.startswith("sb3_cchain."):  # these come by themselves
            others.append(type(output).__name__)
    folder = log_folder(model)
    return {"folder": None if folder is None else str(folder), "formats": formats, "others": others}


def further_logger(saved: Mapping[str, Any], num_timesteps: int) -> Logger | None:
    """
    :param saved: What :func:`describe_log` returned
    :param num_timesteps: Environment steps at which training goes on
    :return: A logger that writes in the same formats to the same folder, in new files as far as Stable-Baselines3 would
        overwrite them; None when a loaded model has the same logger by itself
    :raises ValueError: When that folder cannot be made
    """
    if saved["others"]:
        warnings.warn(
            f"The training that was saved also logged by {', '.join(saved['others'])}, which only you can make again: give "
            "`logger`"
        )
    folder = saved["folder"]
    if folder is None:
        return None
    try:
        outputs = [make_output_format(name, folder, f"_from_step_{num_timesteps}") for name in saved["formats"]]
    except OSError as error:
        raise ValueError(f"The training logged to {folder}, which cannot be made here ({error}): give `logger`") from error
    return Logger(folder, outputs)


def _format(output: KVWriter) -> str | None:
    if isinstance(output, HumanOutputFormat):
        return "log" if output.own_file else "stdout"
    return _FORMATS.get(type(output))
