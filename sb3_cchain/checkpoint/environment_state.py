"""The state of vectorised environments, with all that is in them."""

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor, VecVideoRecorder
from stable_baselines3.common.vec_env.base_vec_env import VecEnvWrapper

from sb3_cchain.checkpoint.object_state import object_states, restore_objects
from sb3_cchain.checkpoint.resumable_env import (
    RESUMED,
    ResumableEnv,
    attempt,
    can_save_single_environment,
    check_same_layers,
    make_resumable,
    restore_single_environment,
    single_environment_state,
)

# Attributes of vectorised environments that are no state: what they wrap, and what SB3 knows of their class
NO_STATE = ("venv", "class_attributes")
# Attributes by which environments are reached
ENVIRONMENTS = ("envs", "remotes", "work_remotes", "processes")


def prepare_environment(env: VecEnv) -> None:
    """
    Make environments resumable before training. Wrappers that record episodes are put into a ``DummyVecEnv`` where the
    state of an environment cannot be saved.

    :param env: The training environment
    :raises ValueError: Naming what cannot be resumed, why, and what to do
    """
    base = env.unwrapped
    if isinstance(base, SubprocVecEnv):
        _check_outermost(base)
        for position, fault in enumerate(base.env_method("resume_fault")):
            _raise(position, fault)
    elif isinstance(base, DummyVecEnv):
        for position, single in enumerate(base.envs):
            fault, resumable = attempt(make_resumable, single)
            _raise(position, fault)
            base.envs[position] = resumable
    elif not _has_own_state(base):
        raise ValueError(
            f"{type(base).__name__} cannot be resumed, because its state is not known. Give the class `state_dict()` and "
            "`load_state_dict(state)`, or use DummyVecEnv or SubprocVecEnv"
        )


def can_save_environment(env: VecEnv) -> bool:
    """
    :param env: A prepared environment
    :return: Whether its state can be saved now. It cannot where an episode has to be recorded and was under way before
    """
    base = env.unwrapped
    if isinstance(base, SubprocVecEnv):
        return all(base.env_method("can_save"))
    if isinstance(base, DummyVecEnv):
        return all(map(can_save_single_environment, base.envs))
    return True


def environment_state(env: VecEnv) -> dict[str, Any]:
    """
    :param env: A prepared environment, between two steps
    :return: Its state, which can be pickled and does not change any more. ``state["left_out"]`` names attributes of vectorised
        wrappers that are not part of it
    :raises ValueError: When the state cannot be saved
    """
    layers, left_out = _vec_layers(env), list[str]()
    # A monitor counts from its start in its file
    skip = {name: (*NO_STATE, "t_start") if isinstance(layer, VecMonitor) else NO_STATE for name, layer in layers.items()}
    states = object_states(layers, _known(layers), skip=skip, left_out=left_out)
    return {
        "n_envs": env.num_envs,
        "layers": states,
        "envs": _single_states(env.unwrapped),
        "reset_infos": deepcopy(list(env.unwrapped.reset_infos)),
        "left_out": left_out,
    }


def restore_environment(env: VecEnv, state: dict[str, Any]) -> None:
    """
    Put a state back.

    :param env: An environment made in the same way as the saved one, after a reset
    :param state: What :func:`environment_state` returned
    :raises ValueError: Naming what differs from the saved environment
    """
    if env.num_envs != state["n_envs"]:
        raise ValueError(
            f"There must be {state['n_envs']} environments side by side, as in the checkpoint, got {env.num_envs}"
        )
    layers = _vec_layers(env)
    check_same_layers(layers, state["layers"])
    prepare_environment(env)
    base = env.unwrapped
    if isinstance(base, SubprocVecEnv):
        for remote, single in zip(base.remotes, state["envs"], strict=True):
            remote.send(("env_method", ("attempt_load", (single,), {})))
        for position, (fault, _) in enumerate([remote.recv() for remote in base.remotes]):
            _raise(position, fault)
        for remote, info in zip(base.remotes, state["reset_infos"], strict=True):
            remote.send(("reset", (None, {RESUMED: info})))
        for remote in base.remotes:
            remote.recv()
    elif isinstance(base, DummyVecEnv):
        for position, single in enumerate(base.envs):
            _raise(position, attempt(restore_single_environment, single, state["envs"][position])[0])
    restore_objects(layers, state["layers"], _known(layers))


def _single_states(base: VecEnv) -> list[Any]:
    if isinstance(base, SubprocVecEnv):
        results = base.env_method("attempt_state")
    elif isinstance(base, DummyVecEnv):
        results = [attempt(single_environment_state, single) for single in base.envs]
    else:
        return []
    for position, (fault, _) in enumerate(results):
        _raise(position, fault)
    return [state for _, state in results]


def _vec_layers(env: VecEnv) -> dict[str, VecEnv]:
    """The vectorised environment and its wrappers, from the outside to the inside, without those that only film."""
    found = [env]
    while isinstance(env, VecEnvWrapper):
        env = env.venv
        found.append(env)
    kept = [layer for layer in found if not isinstance(layer, VecVideoRecorder)]
    return {f"{position} {type(layer).__name__}": layer for position, layer in enumerate(kept)}


def _known(layers: Mapping[str, VecEnv]) -> dict[str, object]:
    *_, base = layers.values()
    # Not the empty tuple, which is one object wherever it stands
    return {name: value for name in ENVIRONMENTS if (value := vars(base).get(name))}


def _has_own_state(env: VecEnv) -> bool:
    return hasattr(type(env), "state_dict") and hasattr(type(env), "load_state_dict")


def _check_outermost(env: SubprocVecEnv) -> None:
    names = env.env_method("class_name") if all(env.env_is_wrapped(ResumableEnv)) else []
    if names and all(name == ResumableEnv.__name__ for name in names):
        return
    raise ValueError(
        "The environments of SubprocVecEnv are in other processes and cannot be resumed unless ResumableEnv is their "
        "outermost wrapper: make_vec_env(..., vec_env_cls=SubprocVecEnv, wrapper_class=ResumableEnv)"
    )


def _raise(position: int, fault: str | None) -> None:
    if fault is not None:
        raise ValueError(f"Environment {position}: {fault}")
