"""A TensorBoard in which nothing needs to be arranged: charts in groups, and the hyperparameters."""

import inspect
from collections.abc import Iterator
from numbers import Real
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import HParam, TensorBoardOutputFormat
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_cchain.callbacks.task_sync import is_continual
from sb3_cchain.callbacks.tensorboard_layout import TensorBoardLayout

_SCHEDULES = ("learning_rate", "clip_range", "clip_range_vf")
# Arguments that training does not depend on, and those that are named otherwise
_LEFT_OUT = ("policy", "env", "verbose", "stats_window_size", "tensorboard_log")


class TensorBoardOverview(BaseCallback):
    """
    Groups the charts of a run in TensorBoard's Custom Scalars tab, and writes the hyperparameters to its HPARAMS tab.

    The charts are those of returns, C-CHAIN, monitored churn, the NTK, network health and related methods of which something
    is logged; see :func:`hyperparameters` for the latter.

    ``CChainPPO`` and ``CChainDQN`` do so by themselves, and so do ``ContinualMetrics`` and all callbacks that look at networks
    during training. Give it to other algorithms without those. Nothing is done twice, and nothing at all for a model that does
    not log to TensorBoard. Hyperparameters that the user records under SB3's key ``hparams`` stand instead of these.
    """

    def _on_training_start(self) -> None:
        add_overview(self.model)

    def _on_step(self) -> bool:
        return True


def add_overview(model: BaseAlgorithm) -> None:
    """
    What :class:`TensorBoardOverview` does, once for each logger.

    :param model: A model that is about to be trained
    """
    logger = model.logger
    outputs = logger.output_formats
    if any(isinstance(output, TensorBoardLayout) for output in outputs):
        return
    for output in outputs:
        if isinstance(output, TensorBoardOutputFormat):
            outputs.append(TensorBoardLayout(output.writer))
            if "hparams" not in logger.name_to_value:  # the key of SB3's documentation: the user has recorded them
                metrics = ["rollout/ep_rew_mean"]
                if is_continual(model.env):
                    metrics.insert(0, "continual/average_performance")
                hparams = HParam(hyperparameters(model), dict.fromkeys(metrics, 0.0))
                logger.record("hparams", hparams, exclude=("stdout", "log", "json", "csv"))
            return


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
        yield name, float(value)
    elif isinstance(value, type):
        yield name, value.__name__


def _env_id(model: BaseAlgorithm) -> str | None:
    env = model.env
    # An environment's specification may hold what cannot be sent from another process
    if env is None or isinstance(env.unwrapped, SubprocVecEnv) or not env.has_attr("spec"):
        return None
    spec = env.get_attr("spec", indices=0)[0]
    return None if spec is None else spec.id
