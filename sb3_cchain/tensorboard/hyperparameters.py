"""The runs of TensorBoard's HPARAMS tab."""

import inspect
import math
from collections.abc import Iterator
from numbers import Real
from typing import TYPE_CHECKING, Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import HParam, KVWriter
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.common.vec_env import SubprocVecEnv

if TYPE_CHECKING:  # TensorBoard need not be installed
    from torch.utils.tensorboard import SummaryWriter

_SCHEDULES = ("learning_rate", "clip_range", "clip_range_vf")
# Arguments that training does not depend on, and those that have another name here
_LEFT_OUT = ("policy", "env", "verbose", "stats_window_size", "tensorboard_log")


class TensorBoardHyperparameters(KVWriter):
    """
    Writes hyperparameters to TensorBoard at the first log, unless the user logs some by SB3's ``HParam`` then.

    ``HParam`` itself would also write a list of columns. TensorBoard takes the list of any one of the runs for all of them, so
    C-CHAIN's arguments could be missing next to a run of PPO. Without a list it shows the columns of all runs.

    It is another output of SB3's logger, next to the one for TensorBoard.

    :param writer: The writer of SB3's output for TensorBoard
    :param values: Hyperparameter → value
    """

    def __init__(self, writer: "SummaryWriter", values: dict[str, str | float]):
        self._writer = writer
        self._values = values
        self._first = True

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """
        :param key_values: What is logged
        :param key_excluded: The outputs that each is not for
        :param step: Environment steps made
        """
        if self._first and not any(isinstance(value, HParam) for value in key_values.values()):
            from torch.utils.tensorboard.summary import hparams

            _, session_start, _ = hparams(self._values, {})
            assert self._writer.file_writer is not None
            self._writer.file_writer.add_summary(session_start)
            self._writer.flush()
        self._first = False

    def close(self) -> None:
        """Nothing to close: the writer belongs to SB3's output."""


def hyperparameters(model: BaseAlgorithm) -> dict[str, str | float]:
    """
    :param model: A model
    :return: Names of algorithm, policy and environment (if it has one, and is not in another process), number of environments,
        and the arguments of the algorithm and its bases that are numbers, strings, booleans or lists, or classes (by name),
        those inside ``policy_kwargs`` included; schedules by their initial value
    """
    arguments = {
        name: getattr(model, name)
        for base in type(model).__mro__
        for name in inspect.signature(base).parameters
        if hasattr(model, name) and name not in _LEFT_OUT
    }
    for name in _SCHEDULES:
        if callable(arguments.get(name)):
            arguments[name] = arguments[name](1.0)
    arguments = {
        "algorithm": type(model),
        "policy": model.policy_class,
        "env": _env_id(model),
        "n_envs": model.n_envs,
        **arguments,
    }
    return {name: value for argument in arguments.items() for name, value in _flat(*argument)}


def _flat(name: str, value: Any) -> Iterator[tuple[str, str | float]]:
    if isinstance(value, dict):
        for key, part in value.items():
            yield from _flat(f"{name}.{key}", part)
    elif isinstance(value, TrainFreq):
        yield name, f"{value.frequency} {value.unit.value}"
    elif isinstance(value, (str, bool, list, tuple)):
        yield name, str(value)  # of booleans, too, which PyTorch takes for 0.0 and 1.0
    elif isinstance(value, Real):
        # TensorBoard fails on infinity
        yield name, float(value) if math.isfinite(value) else str(float(value))
    elif isinstance(value, type):
        yield name, value.__name__


def _env_id(model: BaseAlgorithm) -> str | None:
    env = model.env
    # An environment's specification may hold what cannot be sent from another process
    if env is None or isinstance(env.unwrapped, SubprocVecEnv):
        return None
    try:
        return env.get_attr("spec", indices=0)[0].id
    except Exception:  # any vectorised environment may fail here; a name is not worth a run
        return None
