"""All that the rest of a training depends on, besides what Stable-Baselines3 saves with a model."""

import pickle
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.save_util import load_from_zip_file, recursive_getattr, recursive_setattr
from stable_baselines3.common.vec_env import VecEnv

from sb3_cchain.checkpoint.chunks import ChunkStore
from sb3_cchain.checkpoint.environment_state import (
    check_same_environment,
    env_layers,
    remote_states,
    restore_remotes,
    vec_env_parts,
)
from sb3_cchain.checkpoint.object_state import DATA, restore_objects
from sb3_cchain.checkpoint.random_state import random_state, restore_random_state
from sb3_cchain.checkpoint.replay_buffer_state import restore_replay_buffer, save_replay_buffer
from sb3_cchain.checkpoint.resumable_env import Parts
from sb3_cchain.checkpoint.training_description import constructor_arguments
from sb3_cchain.networks.model_optimizers import model_optimizers
from sb3_cchain.tasks.callback_tree import iterate_callbacks

# Attributes of a model that are saved in other ways, that the present process gives it, and that its present learn() does
_SAVED_OTHERWISE = frozenset({"policy"})
_OF_PROCESS = frozenset({"device", "_logger", "_custom_logger", "verbose", "tensorboard_log"})
_OF_LEARN = frozenset({"start_time", "_num_timesteps_at_start", "_total_timesteps"})
_SKIPPED_OF_MODEL = _SAVED_OTHERWISE | _OF_PROCESS | _OF_LEARN
# Of a callback: what the present learn() gives it
_SKIPPED_OF_CALLBACK = frozenset({"model", "parent", "locals", "globals", "_start_time"})
# What gSDE draws before a rollout begins
_GSDE_NOISE = ("exploration_mat", "exploration_matrices")
# What was recorded and not yet written
_PENDING = ("name_to_value", "name_to_count", "name_to_excluded")


class TrainingParts(NamedTuple):
    """
    The objects of a training that have state.

    :param model: The model
    :param callbacks: All callbacks of ``learn()``, in the order in which they are nested
    :param envs: The environments by name: ``env`` and those that callbacks evaluate in
    :param arguments: Of each callback, the attributes that are named like arguments of its constructor, pickled as they were
        when training started; data only
    """

    model: BaseAlgorithm
    callbacks: dict[str, BaseCallback]
    envs: dict[str, VecEnv]
    arguments: dict[str, dict[str, bytes | None]]

    @property
    def known(self) -> dict[str, object]:
        """Objects that others refer to, by names that mean the same ones in another process."""
        model = self.model
        known: dict[str, object] = {"model": model, "logger": model.logger, **self.callbacks}
        for name in ("rollout_buffer", "replay_buffer"):
            if getattr(model, name, None) is not None:
                known[name] = getattr(model, name)
        for name in model._get_torch_save_params()[1]:
            variable = recursive_getattr(model, name)
            if variable is not None:
                known[f"variable {name}"] = variable
        known.update({f"optimizer {name}": optimizer for name, optimizer in model_optimizers(model).items()})
        known.update({f"module {name}": module for name, module in model.policy.named_modules()})
        known.update({f"parameter {name}": parameter for name, parameter in model.policy.named_parameters()})
        known.update({f"buffer {name}": buffer for name, buffer in model.policy.named_buffers()})
        for name, env in self.envs.items():
            known.update({f"{name} layer {number}": layer for number, layer in enumerate(env_layers(env))})
        return known

    def env_parts(self) -> dict[str, Parts]:
        """The objects of each environment that have state in this process."""
        return {name: vec_env_parts(env, f"{name} ") for name, env in self.envs.items()}


def training_parts(model: BaseAlgorithm, callback: BaseCallback) -> TrainingParts:
    """
    :param model: A model in ``learn()``
    :param callback: All callbacks of ``learn()``
    :return: The objects that have state
    """
    assert model.env is not None
    # A list has no state, and may stand for a single callback
    found_callbacks = [found for found in iterate_callbacks(callback) if not isinstance(found, CallbackList)]
    callbacks = {f"callback {number}": found for number, found in enumerate(found_callbacks)}
    envs = {"env": model.env}
    for name, found in callbacks.items():
        envs.update({f"{name} {key}": value for key, value in vars(found).items() if _is_other_env(value, model.env)})
    return TrainingParts(model, callbacks, envs, {name: _arguments(found) for name, found in callbacks.items()})


def _arguments(callback: BaseCallback) -> dict[str, bytes | None]:
    found: dict[str, bytes | None] = {}
    for name in vars(callback).keys() & constructor_arguments(type(callback)):
        value = vars(callback)[name]
        if value is None or isinstance(value, DATA):
            found[name] = None  # for what cannot be pickled
            with suppress(Exception):  # whatever the code of an object raises
                found[name] = pickle.dumps(value, protocol=5)
    return found


def _is_other_env(value: object, env: VecEnv) -> bool:
    return isinstance(value, VecEnv) and all(value is not layer for layer in env_layers(env))


def training_state(parts: TrainingParts, store: ChunkStore, with_envs: bool) -> tuple[dict[str, Any], list[str]]:
    """
    :param parts: The objects of a training, between two rollouts
    :param store: Takes the big arrays
    :param with_envs: Whether the environments' state is part of it
    :return: The state, which can be pickled, without what is in the model's own file; and the names of attributes that cannot
        be saved
    """
    model, callbacks = parts.model, parts.callbacks
    left_out: list[str] = []
    saved = Parts({"model": model, **callbacks}, parts.known, {"model": _SKIPPED_OF_MODEL | _views(model)})
    for name, callback in callbacks.items():
        # Callbacks keep the data with which the present process made them, but for what they change themselves
        before, now = parts.arguments[name], _arguments(callback)
        unchanged = {argument for argument in before.keys() & now.keys() if before[argument] == now[argument]}
        saved.skip[name] = _SKIPPED_OF_CALLBACK | unchanged
    envs = parts.env_parts() if with_envs else {}
    for env in envs.values():
        saved.add(env)
    objects = saved.read(left_out)  # all at once, because callbacks and environments may refer to the same objects
    buffer = getattr(model, "replay_buffer", None)
    state: dict[str, Any] = {
        "objects": objects,
        "envs": {name: (parts.envs[name].num_envs, remote_states(parts.envs[name])) for name in envs} if with_envs else None,
        "gsde_noise": [
            {name: vars(noise)[name].detach() for name in _GSDE_NOISE if name in vars(noise)} for noise in _gsde(model)
        ],
        "replay_buffer": None if buffer is None else save_replay_buffer(buffer, store, saved.known),
        "logged": {name: dict(vars(model.logger)[name]) for name in _PENDING if hasattr(model.logger, name)},
        "random": random_state(model.device),
    }
    return state, left_out


def _views(model: BaseAlgorithm) -> set[str]:
    """Attributes that are lists of views of the policy's tensors, as SB3 keeps of the running statistics of BatchNorm."""
    memory = {tensor.data_ptr() for tensor in model.policy.state_dict().values()}
    lists = {name: value for name, value in vars(model).items() if isinstance(value, list) and value}
    return {
        name
        for name, value in lists.items()
        if all(isinstance(entry, th.Tensor) and entry.data_ptr() in memory for entry in value)
    }


def chunk_names(state: Mapping[str, Any]) -> list[str]:
    """
    :param state: What :func:`training_state` returned
    :return: The pieces in the store that it refers to
    """
    buffer = state["replay_buffer"]
    return [] if buffer is None else [name for names in buffer["arrays"] for name in names]


def restore_training(parts: TrainingParts, state: Mapping[str, Any], model_path: Path, store: ChunkStore) -> None:
    """
    :param parts: The objects of a training that was set up as the saved one was, before its first rollout
    :param state: What :func:`training_state` returned
    :param model_path: The model's own file
    :param store: The big arrays
    """
    model, saved_envs = parts.model, state["envs"] or {}
    envs = parts.env_parts() if saved_envs else {}
    found = Parts({"model": model, **parts.callbacks}, parts.known, {})
    for name, env in envs.items():
        saved_layers = [layer for layer in state["objects"].holders if layer.startswith(f"{name} ")]
        check_same_environment(parts.envs[name], env.holders, saved_envs[name][0], saved_layers)
        found.add(env)
    _restore_parameters(model, model_path)
    restore_objects(found.holders, state["objects"], found.known)
    for name in envs:
        restore_remotes(parts.envs[name], saved_envs[name][1])
    for noise, saved in zip(_gsde(model), state["gsde_noise"], strict=True):
        vars(noise).update(saved)
    if state["replay_buffer"] is not None:
        restore_replay_buffer(model.replay_buffer, state["replay_buffer"], store, found.known)  # type: ignore[attr-defined]
    for name, values in state["logged"].items():
        vars(model.logger)[name].clear()
        vars(model.logger)[name].update(values)
    restore_random_state(state["random"], model.device)


def _restore_parameters(model: BaseAlgorithm, path: Path) -> None:
    _, parameters, variables = load_from_zip_file(path, load_data=False, device=model.device)
    # Of the base class: churn reduction starts over in its own
    BaseAlgorithm.set_parameters(model, parameters, exact_match=True, device=model.device)
    for name, variable in (variables or {}).items():
        if variable is not None:
            recursive_setattr(model, f"{name}.data", variable.data)


def _gsde(model: BaseAlgorithm) -> list[StateDependentNoiseDistribution]:
    distributions = [getattr(module, "action_dist", None) for module in model.policy.modules()]
    return [found for found in distributions if isinstance(found, StateDependentNoiseDistribution)]
