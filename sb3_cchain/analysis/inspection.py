"""Churn, the neural tangent kernel and the health of the networks of a model, after the fact."""

import inspect
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch as th
from rich.table import Table
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.dqn.policies import DQNPolicy

from sb3_cchain.algorithms import CChainDQN, CChainPPO, DoubleDQN
from sb3_cchain.analysis import ChurnMonitor, NetworkHealth, NTKCallback
from sb3_cchain.analysis.health import trained_groups
from sb3_cchain.analysis.metrics.norms import group_norms
from sb3_cchain.analysis.ntk import has_ntk
from sb3_cchain.analysis.plots import plot_models
from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.replaced import replaced
from sb3_cchain.tasks import TaskSync
from sb3_cchain.tasks.signal import is_continual
from sb3_cchain.validation import check_number

# Drawn for each group of layers, by their names after "health/"
GROUP_FIGURES = (
    "dormant_share",
    "active_share",
    "feature_srank",
    "feature_effective_rank",
    "weight_norm",
    "distance_from_init",
)

# Iterations or episodes until the logger is emptied
_NEVER = 10**9


@dataclass
class Inspection:
    """
    The figures of one model.

    :param name: Name of the model
    :param figures: By name as in TensorBoard, and ``rollout/mean_return``, ``rollout/n_episodes``, ``rollout/n_steps``
    :param ntk: The neural tangent kernel
    :param parameters: A copy of the parameters of each group of layers, by name
    """

    name: str
    figures: dict[str, float]
    ntk: th.Tensor
    parameters: dict[str, dict[str, th.Tensor]]


def inspect_model(
    model: BaseAlgorithm,
    name: str = "model",
    n_steps: int = 2048,
    n_updates: int = 100,
    callbacks: Sequence[BaseCallback] = (),
) -> Inspection:
    """
    Roll the model out and train it a little, as its training would go on, and look at it with
    :class:`~sb3_cchain.ChurnMonitor` at each update, :class:`~sb3_cchain.analysis.NTKCallback` and
    :class:`~sb3_cchain.analysis.NetworkHealth`. This changes the model.

    On-policy, that is one iteration. Off-policy, ``n_steps`` steps fill a replay buffer, which is not saved with a model, and
    ``n_updates`` updates are made on it. What has a schedule (learning rate, clipping range, exploration) has the value of the
    moment when the model was saved; where the learning rate had come down to 0, there is no churn.

    :param model: A PPO, A2C, DQN or one of sb3-contrib's that the monitors know, with an environment
    :param name: What it is called in reports
    :param n_steps: Environment steps to roll out, for off-policy algorithms; on-policy it is one rollout
    :param n_updates: Gradient updates, for off-policy algorithms
    :param callbacks: Callbacks of its training on which the training depends
    :return: What was found
    :raises TypeError: For other algorithms
    :raises ValueError: Naming the argument that is out of its range; for a model without an environment, or with parameters
        that are not finite
    """
    check_number("n_steps", n_steps, 1, integer=True)
    check_number("n_updates", n_updates, 1, integer=True)
    _check_model(model)
    model.set_logger(Logger(folder=None, output_formats=[]))
    if isinstance(model, OnPolicyAlgorithm):
        n_steps = model.n_steps * model.n_envs
    elif isinstance(model, OffPolicyAlgorithm):
        model.learning_starts = model.num_timesteps  # the rollout that fills the buffer has no random actions
        model.train_freq = TrainFreq(-(-n_steps // model.n_envs), TrainFrequencyUnit.STEP)  # type: ignore[assignment]
        model.gradient_steps = n_updates
    # All episodes of this rollout, and no others
    model.ep_info_buffer, model._stats_window_size = None, n_steps
    parameters = {
        group: {name: parameter.detach().clone() for name, parameter in group_parameters.items()}
        for group, group_parameters in trained_groups(model).items()
    }
    knows_its_start = hasattr(model, "initial_parameters")
    ntk, health = NTKCallback(interval=1, picture_interval=0), NetworkHealth(interval=1)
    # The monitors that it was trained with are replaced by those above
    others = [callback for callback in callbacks if not isinstance(callback, (ChurnMonitor, NTKCallback, NetworkHealth))]
    if is_continual(model.env) and not any(isinstance(callback, TaskSync) for callback in others):
        others.insert(0, TaskSync())
    # Schedules keep their present values instead of going to their ends
    with replaced(model, "_update_current_progress_remaining", lambda *_: None):
        model.learn(
            n_steps,
            callback=[*others, ChurnMonitor(interval=1), ntk, health],
            log_interval=_NEVER,
            reset_num_timesteps=False,
        )
    figures = {
        tag: float(value)
        for tag, value in model.logger.name_to_value.items()
        if tag.startswith(("ntk/", "health/", "churn_monitor/"))
        and (knows_its_start or not tag.startswith("health/distance_from_init"))
    }
    figures.update({f"health/{name}": norm for name, norm in health.gradient_norms().items()})
    episodes: Iterable[dict[str, float]] = model.ep_info_buffer or []
    returns = [episode["r"] for episode in episodes]
    figures["rollout/mean_return"] = float(np.mean(returns)) if returns else np.nan
    figures["rollout/n_episodes"] = len(returns)
    figures["rollout/n_steps"] = n_steps
    return Inspection(name, figures, ntk.matrix, parameters)


def _check_model(model: BaseAlgorithm) -> None:
    if not has_ntk(model):
        raise TypeError(
            "Models of on-policy algorithms without recurrent networks, DQN and QRDQN can be inspected, got one of "
            f"{type(model).__name__}. For others, give ChurnMonitor and NetworkHealth to learn()"
        )
    if model.env is None:
        name = type(model).__name__
        raise ValueError(
            f"The model has no environment: load it with one, {name}.load(path, env), or give it one by set_env(env)"
        )
    for name, parameter in uncompiled(model.policy).named_parameters():
        if not parameter.isfinite().all():
            raise ValueError(f"The model cannot act: its parameter {name} has entries that are infinite or not a number")


def algorithm_of(path: str | Path) -> type[BaseAlgorithm]:
    """
    :param path: A model that was saved by PPO, DQN, or an algorithm of this package
    :return: The algorithm's class. SB3 does not save it, so it is told from the data that it saves.
    :raises ValueError: When it is of another algorithm, or no model
    """
    data, *_ = load_from_zip_file(path, device="cpu")
    policy_class = (data or {}).get("policy_class")
    if data is None or not inspect.isclass(policy_class):
        raise ValueError(f"{path} is not a model saved by Stable-Baselines3: it does not name its policy")
    if policy_class.__module__.startswith("sb3_contrib"):
        pass  # RecurrentPPO's policy is an ActorCriticPolicy
    elif issubclass(policy_class, DQNPolicy):
        return CChainDQN if "churn_coef" in data else DoubleDQN if "double_q" in data else DQN
    elif issubclass(policy_class, ActorCriticPolicy) and "clip_range" in data:
        return CChainPPO if "churn_coef" in data else PPO
    raise ValueError(f"{path} was saved by neither PPO nor DQN (its policy is a {policy_class.__name__}): give its --algo")


def report(inspections: Sequence[Inspection]) -> list[Table]:
    """
    :param inspections: Of one model, or of two to compare
    :return: Tables
    """
    tables = []
    for title, prefix in (
        ("Rollout", "rollout/"),
        ("Churn of an update, on the rollout's data", "churn_monitor/fresh/"),
        ("Neural tangent kernel", "ntk/"),
        ("Networks", "health/"),
    ):
        tags = [tag for tag in _tags(inspections, prefix) if "/" not in tag.removeprefix(prefix)]
        tables.append(_table(title, inspections, {_words(tag.removeprefix(prefix)): tag for tag in tags}))
    tags = sorted((tag for tag in _tags(inspections, "health/") if tag.count("/") > 1), key=_group)
    rows = {f"{_group(tag)}: {_words(tag.split('/')[1])}": tag for tag in tags}
    tables.append(_table("Groups of layers", inspections, rows))
    if len(inspections) == 2:
        tables.append(_distances(*inspections))
    return tables


def _distances(a: Inspection, b: Inspection) -> Table:
    table = Table("", "L2 distance", title=f"From {a.name}'s parameters to {b.name}'s", title_justify="left", min_width=60)
    shapes_of_a, shapes_of_b = (
        {group: [(name, p.shape) for name, p in parameters.items()] for group, parameters in inspection.parameters.items()}
        for inspection in (a, b)
    )
    differences = {
        group: [b.parameters[group][name] - parameter for name, parameter in parameters.items()]
        for group, parameters in a.parameters.items()
        if shapes_of_a[group] == shapes_of_b.get(group)
    }
    for name, distance in group_norms("together", differences).items():
        table.add_row(name.removeprefix("together/"), f"{distance:.4g}" if differences else "")
    for group in dict.fromkeys([*shapes_of_a, *shapes_of_b]):
        if group not in differences:
            table.add_row(group, "not of the same shape")
    return table


def _words(name: str) -> str:
    return "gradient norm, clipped" if name == "gradient_norm" else name.replace("_", " ")


def _group(tag: str) -> str:
    return tag.split("/", 2)[2]


def _tags(inspections: Sequence[Inspection], prefix: str) -> list[str]:
    return [tag for tag in dict.fromkeys(t for i in inspections for t in i.figures) if tag.startswith(prefix)]


def _table(title: str, inspections: Sequence[Inspection], rows: dict[str, str]) -> Table:
    table = Table("", title=title, title_justify="left", min_width=60)
    for inspection in inspections:
        table.add_column(inspection.name, justify="right")
    if len(inspections) == 2:
        table.add_column("ratio", justify="right")
    for name, tag in rows.items():
        values = [inspection.figures.get(tag, np.nan) for inspection in inspections]
        ratio = [f"{values[1] / values[0]:.3g}" if values[0] else ""] if len(values) == 2 else []
        table.add_row(name, *(f"{value:.4g}" for value in values), *ratio)
    return table


def plot(inspections: Sequence[Inspection], path: Path) -> None:
    """
    Draw the NTKs, and the figures of each group of layers.

    :param inspections: Of one model, or of two to compare
    :param path: PNG file
    :raises ImportError: Without matplotlib
    """
    tags = [tag for tag in _tags(inspections, "health/") if tag.count("/") > 1]
    groups = list(dict.fromkeys(map(_group, tags)))
    bars = {
        name.replace("_", " ").replace("feature ", "feature\n"): [
            [inspection.figures.get(f"health/{name}/{group}", np.nan) for group in groups] for inspection in inspections
        ]
        for name in GROUP_FIGURES
        if any(tag.startswith(f"health/{name}/") for tag in tags)
    }
    ntks = [(i.ntk, f"{i.name}: NTK, srank {i.figures['ntk/srank']:.0f}") for i in inspections]
    figure = plot_models([inspection.name for inspection in inspections], ntks, groups, bars)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
