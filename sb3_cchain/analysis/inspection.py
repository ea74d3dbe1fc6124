"""Churn, the neural tangent kernel and the health of the networks of a model, and what is wrong with it, after the fact."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from rich.table import Table
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import obs_as_tensor

from sb3_cchain.analysis import ChurnMonitor, Doctor, NetworkHealth, NTKCallback
from sb3_cchain.analysis.findings import CHECKS, Finding, as_json, diagnose
from sb3_cchain.analysis.health_figures import trained_groups
from sb3_cchain.analysis.metrics.norms import group_norms
from sb3_cchain.analysis.ntk import has_ntk
from sb3_cchain.analysis.plots import plot_models
from sb3_cchain.analysis.random_state import unchanged_random_state
from sb3_cchain.analysis.symptoms import Symptoms, is_finite, symptoms_of, weight_symptoms
from sb3_cchain.analysis.task_evaluation import TaskEvaluation
from sb3_cchain.callbacks import ContinualMetrics, TaskLearningStarts
from sb3_cchain.checkpoint.training_checkpoint import TrainingCheckpoint
from sb3_cchain.replaced import replaced
from sb3_cchain.tasks import TaskSync
from sb3_cchain.tasks.continual import is_continual
from sb3_cchain.validation import check_number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Drawn for each group of layers, by their names after "health/"
GROUP_FIGURES = (
    "dormant_share",
    "active_share",
    "feature_srank",
    "feature_effective_rank",
    "weight_norm",
    "distance_from_init",
)

_MONITORS = (ChurnMonitor, Doctor, NetworkHealth, NTKCallback)
# Training does not depend on them, and they would write to the files of the training
_WRITERS = (CheckpointCallback, ContinualMetrics, EvalCallback, TaskEvaluation, TrainingCheckpoint)

# Iterations or episodes until the logger is emptied
_NEVER = 10**9


@dataclass
class Inspection:
    """
    The figures of one model, and what is wrong with it.

    :param name: Name of the model
    :param figures: By name as in TensorBoard, and ``rollout/mean_return``, ``rollout/n_episodes``, ``rollout/n_steps``
    :param ntk: The neural tangent kernel; None for algorithms of which it cannot be computed
    :param parameters: A copy of the parameters of each group of layers, by name
    :param algorithm: Name of the class of its algorithm
    :param num_timesteps: Environment steps that it was trained for
    :param symptoms: What the findings were made from
    :param findings: What is wrong with it
    """

    name: str
    figures: dict[str, float]
    ntk: th.Tensor | None = None
    parameters: dict[str, dict[str, th.Tensor]] = field(default_factory=dict)
    algorithm: str = ""
    num_timesteps: int = 0
    symptoms: Symptoms = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """
        :return: The findings, and every measure, as plain values
        """
        return {
            "name": self.name,
            "algorithm": self.algorithm,
            "num_timesteps": self.num_timesteps,
            "findings": [finding.to_json() for finding in self.findings],
            "measures": {name: as_json(value) for name, value in self.symptoms.items()},
            "not_measured": [check.name for check in CHECKS if check.worst(self.symptoms) is None],
        }


def inspect_model(
    model: BaseAlgorithm,
    name: str = "model",
    n_steps: int = 2048,
    n_updates: int = 100,
    callbacks: Sequence[BaseCallback] = (),
) -> Inspection:
    """
    Roll the model out and train it a little, as its training would go on, and look at it with
    :class:`~sb3_cchain.ChurnMonitor` at each update, :class:`~sb3_cchain.analysis.NTKCallback` where there is a kernel,
    :class:`~sb3_cchain.analysis.NetworkHealth` and :class:`~sb3_cchain.analysis.Doctor`. This changes the model.

    On-policy, that is one iteration. Off-policy, ``n_steps`` steps fill a replay buffer, which is not saved with a model, and
    ``n_updates`` updates are made on it. What has a schedule (learning rate, clipping range, exploration) has the value of the
    moment when the model was saved; where the learning rate had come down to 0, there is no churn.

    ARS is not trained, but only rolled out. A model whose parameters are not finite, or become so in this training, cannot
    act: of it there are only the findings.

    :param model: A model of any algorithm of Stable-Baselines3 and sb3-contrib, with an environment
    :param name: What it is called in reports
    :param n_steps: Environment steps to roll out, for off-policy algorithms; on-policy it is one rollout
    :param n_updates: Gradient updates, for off-policy algorithms
    :param callbacks: Callbacks of its training. Those that only evaluate or write files, and
        :class:`~sb3_cchain.callbacks.TaskLearningStarts`, are left out
    :return: What was found
    :raises ValueError: Naming the argument that is out of its range; for a model without an environment
    """
    check_number("n_steps", n_steps, 1, integer=True)
    check_number("n_updates", n_updates, 1, integer=True)
    _check_env(model)
    about: dict[str, Any] = {"algorithm": type(model).__name__, "num_timesteps": model.num_timesteps}
    if not is_finite(model):
        symptoms = weight_symptoms(model)
        return Inspection(name, {}, **about, symptoms=symptoms, findings=diagnose(symptoms, model))
    if not isinstance(model, (OnPolicyAlgorithm, OffPolicyAlgorithm)):
        symptoms, figures = _roll_out(model, n_steps)
        return Inspection(name, figures, **about, symptoms=symptoms, findings=diagnose(symptoms, model))
    model.set_logger(Logger(folder=None, output_formats=[]))
    if isinstance(model, OnPolicyAlgorithm):
        n_steps = model.n_steps * model.n_envs
    else:
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
    health, doctor = NetworkHealth(interval=1), Doctor(interval=1, patience=_NEVER)
    monitors: list[BaseCallback] = [ChurnMonitor(interval=1), health, doctor]
    ntk = NTKCallback(interval=1, picture_interval=0) if has_ntk(model) else None
    if ntk is not None:
        monitors.append(ntk)
    # The monitors that it was trained with are replaced by those above. TaskLearningStarts would put off the updates
    others = [callback for callback in callbacks if not isinstance(callback, (*_MONITORS, *_WRITERS, TaskLearningStarts))]
    if is_continual(model.env) and not any(isinstance(callback, TaskSync) for callback in others):
        others.insert(0, TaskSync())
    try:
        # Schedules keep their present values instead of going to their ends
        with replaced(model, "_update_current_progress_remaining", lambda *_: None):
            model.learn(n_steps, callback=[*others, *monitors], log_interval=_NEVER, reset_num_timesteps=False)
    except ValueError:
        if is_finite(model):
            raise
        # An update has made parameters infinite, and PyTorch's distributions do not take them
        symptoms = {**doctor.symptoms, **weight_symptoms(model)}
        return Inspection(name, {}, **about, symptoms=symptoms, findings=diagnose(symptoms, model))
    figures = {
        tag: float(value)
        for tag, value in model.logger.name_to_value.items()
        if tag.startswith(("ntk/", "health/", "churn_monitor/"))
        and (knows_its_start or not tag.startswith("health/distance_from_init"))
    }
    figures.update({f"health/{name}": norm for name, norm in health.gradient_norms().items()})
    figures.update(_rollout_figures(model.ep_info_buffer or [], n_steps))
    matrix = getattr(ntk, "matrix", None)  # none, too, where a callback has ended the training before
    return Inspection(name, figures, matrix, parameters, **about, symptoms=doctor.symptoms, findings=doctor.findings)


def _rollout_figures(episodes: Iterable[dict[str, float]], n_steps: int) -> dict[str, float]:
    returns = [episode["r"] for episode in episodes]
    return {
        "rollout/mean_return": float(np.mean(returns)) if returns else np.nan,
        "rollout/n_episodes": len(returns),
        "rollout/n_steps": n_steps,
    }


def _roll_out(model: BaseAlgorithm, n_steps: int) -> tuple[Symptoms, dict[str, float]]:
    """Without training, and so without what only training shows."""
    env = model.env
    assert env is not None
    observations, episodes, seen = env.reset(), [], []
    for _ in range(-(-n_steps // env.num_envs)):
        seen.append(np.array(observations))
        actions, _ = model.predict(observations)  # type: ignore[arg-type]
        observations, _, _, infos = env.step(actions)
        episodes += [info["episode"] for info in infos if "episode" in info]
    with unchanged_random_state():
        batch = {"observations": obs_as_tensor(np.concatenate(seen), model.device)}
        return symptoms_of(model, batch), _rollout_figures(episodes, len(seen) * env.num_envs)


def _check_env(model: BaseAlgorithm) -> None:
    if model.env is None:
        name = type(model).__name__
        raise ValueError(
            f"The model has no environment: load it with one, {name}.load(path, env), or give it one by set_env(env)"
        )


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
    return [table for table in tables if table.row_count]


def findings_text(inspection: Inspection) -> str:
    """
    :param inspection: Of a model
    :return: Its findings, with the code of what to try
    """
    lines = [f"{inspection.name}: {len(inspection.findings) or 'no'} finding{'' if len(inspection.findings) == 1 else 's'}"]
    for finding in inspection.findings:
        lines += ["", f"{finding.check.title} ({finding.check.certainty}: {finding.check.name})", f"  {finding.measured()}"]
        for remedy in finding.remedies:
            lines += [f"  Try {remedy.title}:", *(f"      {line}" for line in remedy.line.splitlines())]
    return "\n".join(lines)


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


def draw(inspections: Sequence[Inspection]) -> "Figure":
    """
    Draw the NTKs, and the figures of each group of layers.

    :param inspections: Of one model, or of two to compare
    :return: The picture
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
    ntks = [(i.ntk, f"{i.name}: NTK, srank {i.figures['ntk/srank']:.0f}") for i in inspections if i.ntk is not None]
    return plot_models([inspection.name for inspection in inspections], ntks, groups, bars)


def plot(inspections: Sequence[Inspection], path: Path) -> None:
    """
    Save the picture of :func:`draw`.

    :param inspections: Of one model, or of two to compare
    :param path: PNG file
    :raises ImportError: Without matplotlib
    """
    figure = draw(inspections)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
