"""Looks at a model after its training: churn, the neural tangent kernel, the health of its networks, and what is wrong."""

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch as th
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
from sb3_cchain.analysis.ntk import has_ntk
from sb3_cchain.analysis.symptoms import Symptoms, is_finite, symptoms_of, weight_symptoms
from sb3_cchain.analysis.task_evaluation import TaskEvaluation
from sb3_cchain.callbacks import ContinualMetrics, TaskLearningStarts
from sb3_cchain.checkpoint.random_state import unchanged_random_state
from sb3_cchain.checkpoint.training_checkpoint import TrainingCheckpoint
from sb3_cchain.replaced import replaced
from sb3_cchain.tasks import TaskSignal, TaskSync
from sb3_cchain.tasks.continual import is_continual
from sb3_cchain.tasks.sequence import other_sequence, sequence_start
from sb3_cchain.validation import check_number

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
    figures: dict[str, float] = field(default_factory=dict)
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
    :class:`~sb3_cchain.analysis.NetworkHealth` and :class:`~sb3_cchain.analysis.Doctor`. The model has learned from these
    steps afterwards, and so have the statistics of its ``VecNormalize``: to keep it as it is, inspect a copy that is loaded
    from a file. Its logger and its other settings stay as they are.

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
    inspection = Inspection(name, algorithm=type(model).__name__, num_timesteps=model.num_timesteps)
    if not is_finite(model):
        inspection.symptoms = weight_symptoms(model)
        inspection.findings = diagnose(inspection.symptoms, model)
    elif isinstance(model, (OnPolicyAlgorithm, OffPolicyAlgorithm)):
        with _one_iteration(model, n_steps, n_updates) as n_steps:
            _look_while_training(inspection, model, n_steps, callbacks)
    else:
        inspection.symptoms, inspection.figures = _roll_out(model, n_steps)
        inspection.findings = diagnose(inspection.symptoms, model)
    return inspection


@contextmanager
def _one_iteration(model: OnPolicyAlgorithm | OffPolicyAlgorithm, n_steps: int, n_updates: int) -> Iterator[int]:
    """Settings of the model for the iteration, and its environment steps. The model's own settings come back afterwards."""
    settings: dict[str, Any] = {"_logger": Logger(folder=None, output_formats=[]), "_custom_logger": True}
    if isinstance(model, OnPolicyAlgorithm):
        n_steps = model.n_steps * model.n_envs
    else:
        settings["learning_starts"] = model.num_timesteps  # the rollout that fills the buffer has no random actions
        settings["train_freq"] = TrainFreq(math.ceil(n_steps / model.n_envs), TrainFrequencyUnit.STEP)
        settings["gradient_steps"] = n_updates
    # All episodes of this rollout, and no others
    settings |= {"ep_info_buffer": None, "ep_success_buffer": None, "_stats_window_size": n_steps}
    if model.env is not None and is_continual(model.env) and other_sequence(model, model.env) is not None:
        settings["trained_sequence"] = None  # the user's choice of other tasks is no training that goes on in them
    with ExitStack() as stack:
        for name, value in settings.items():
            stack.enter_context(replaced(model, name, value))
        yield n_steps


def _look_while_training(
    inspection: Inspection, model: OnPolicyAlgorithm | OffPolicyAlgorithm, n_steps: int, callbacks: Sequence[BaseCallback]
) -> None:
    inspection.parameters = {
        group: {name: parameter.detach().clone() for name, parameter in group_parameters.items()}
        for group, group_parameters in trained_groups(model).items()
    }
    knows_its_start = hasattr(model, "initial_parameters")
    health, doctor = NetworkHealth(interval=1), Doctor(interval=1, patience=_NEVER)
    ntk = NTKCallback(interval=1, picture_interval=0) if has_ntk(model) else None
    monitors = [ChurnMonitor(interval=1), health, doctor, *([] if ntk is None else [ntk])]
    try:
        # Schedules keep their present values instead of going to their ends
        with replaced(model, "_update_current_progress_remaining", lambda *_: None):
            kept = _kept_callbacks(model, callbacks)
            changing = [each for each in kept if getattr(each, "changes_network", False)]
            callback = [*(each for each in kept if each not in changing), *monitors, *changing]
            model.learn(n_steps, callback=callback, log_interval=_NEVER, reset_num_timesteps=False)
    except ValueError:
        if is_finite(model):
            raise
        # An update has made parameters infinite, and PyTorch's distributions do not take them
        inspection.parameters = {}
        inspection.symptoms = {**doctor.symptoms, **weight_symptoms(model)}
        inspection.findings = diagnose(inspection.symptoms, model)
        return
    inspection.figures = {
        tag: float(value)
        for tag, value in model.logger.name_to_value.items()
        if tag.startswith(("ntk/", "health/", "churn_monitor/"))
        and (knows_its_start or not tag.startswith("health/distance_from_init"))
    }
    inspection.figures.update({f"health/{name}": norm for name, norm in health.gradient_norms().items()})
    inspection.figures.update(_rollout_figures(model.ep_info_buffer or [], n_steps))
    inspection.ntk = getattr(ntk, "matrix", None)  # none, too, where a callback has ended the training before
    inspection.symptoms, inspection.findings = doctor.symptoms, doctor.findings


def _kept_callbacks(model: BaseAlgorithm, callbacks: Sequence[BaseCallback]) -> list[BaseCallback]:
    """Without the monitors that it was trained with, and without TaskLearningStarts, which would put off the updates."""
    kept = [callback for callback in callbacks if not isinstance(callback, (*_MONITORS, *_WRITERS, TaskLearningStarts))]
    if is_continual(model.env) and not any(isinstance(callback, TaskSync) for callback in kept):
        kept.insert(0, TaskSync())
    if sequence_start(model) > 0 and not any(isinstance(callback, TaskSignal) for callback in kept):
        kept.insert(1, TaskSignal())
    return kept


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
    for _ in range(math.ceil(n_steps / env.num_envs)):
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
