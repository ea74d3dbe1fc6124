"""What a training was started with, written beside its checkpoints, so that training that goes on can be compared with it."""

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_cchain.checkpoint import write_safely

# Beside the checkpoints
COMMAND = "command.json"

# Options of RL Zoo that must be as before: those that training depends on, those of evaluations, which draw random numbers,
# and those by which it has the same callbacks and the same rhythm of the log
OF_TRAINING = ("algo", "env", "seed", "env_kwargs", "vec_env")
OF_EVALUATIONS = ("eval_env_kwargs", "eval_freq", "eval_episodes", "n_eval_envs")
OF_CALLBACKS = ("save_freq", "log_interval", "progress")
COMPARED = OF_TRAINING + OF_EVALUATIONS + OF_CALLBACKS


def write_record(
    folder: Path, freq: int | None, keep: int | None, args: argparse.Namespace, hyperparameters: Mapping[str, Any]
) -> None:
    """
    Write the record.

    :param folder: Folder of the checkpoints
    :param freq: Environment steps between two checkpoints
    :param keep: How many of the newest checkpoints stay
    :param args: RL Zoo's
    :param hyperparameters: As RL Zoo read them
    """
    record = {
        "checkpoint_freq": freq,
        "checkpoint_keep": keep,
        "options": {name: plain(getattr(args, name)) for name in COMPARED},
        "hyperparameters": plain(hyperparameters),
    }
    with write_safely(folder / COMMAND) as path:
        path.write_text(json.dumps(record, indent=1) + "\n")


def read_record(folder: Path) -> dict[str, Any]:
    """
    :param folder: Folder of the checkpoints
    :return: What :func:`write_record` wrote there
    :raises ValueError: When there is no such file
    """
    try:
        return json.loads((folder / COMMAND).read_text())
    except FileNotFoundError:
        raise ValueError(
            f"the checkpoints in {folder} were not made by `sb3-cchain train`, which writes {COMMAND} beside them: go on in "
            "Python, by sb3_cchain.resume()"
        ) from None


def differences(record: Mapping[str, Any], args: argparse.Namespace, hyperparameters: Mapping[str, Any]) -> list[str]:
    """
    :param record: What training was started with
    :param args: RL Zoo's, of training that is to go on
    :param hyperparameters: As RL Zoo read them, of training that is to go on. Their ``n_timesteps`` may differ
    :return: What differs, in a few words each
    """
    found = []
    for name in COMPARED:
        before, now = record["options"][name], plain(getattr(args, name))
        if before != now:
            found.append(f"--{name.replace('_', '-')} {before}, not {now}")
    before, now = record["hyperparameters"], plain(hyperparameters)
    for name in sorted({*before, *now} - {"n_timesteps"}):
        if before.get(name) != now.get(name):
            found.append(f"{name} {before.get(name)}, not {now.get(name)}")
    return found


def plain(value: Any) -> Any:
    """
    :param value: An option or hyperparameters
    :return: The same as JSON holds it; classes, functions and objects that do not describe themselves by their names
    """
    return json.loads(json.dumps(_without_class_keys(value), default=_name))


def _without_class_keys(value: Any) -> Any:
    """A Python file of settings may map the class of a wrapper to its arguments."""
    if isinstance(value, dict):
        return {_name(key) if isinstance(key, type) else key: _without_class_keys(each) for key, each in value.items()}
    return [_without_class_keys(each) for each in value] if isinstance(value, list | tuple) else value


def _name(value: Any) -> str:
    if hasattr(value, "__qualname__"):
        return value.__qualname__
    kind = type(value)
    describes_itself = kind.__str__ is not object.__str__ or kind.__repr__ is not object.__repr__
    return str(value) if describes_itself else kind.__qualname__
