"""The state of vectorised environments, with all that is in them."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor, VecVideoRecorder
from stable_baselines3.common.vec_env.base_vec_env import VecEnvWrapper

from sb3_cchain.checkpoint.object_state import has_state_dict
from sb3_cchain.checkpoint.resumable_env import (
    RESUMED,
    Parts,
    ResumableEnv,
    attempt,
    can_save_single_environment,
    check_same_layers,
    environment_parts,
    make_resumable,
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
    elif not has_state_dict(type(base)):
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


def vec_env_parts(env: VecEnv, prefix: str = "") -> Parts:
    """
    :param env: A prepared environment
    :param prefix: What names begin with
    :return: The objects that have state in this process
    """
    layers = {f"{prefix}{name}": layer for name, layer in named_layers(env).items()}
    parts = Parts(dict(layers), _known(layers), no_state(layers))
    if isinstance(env.unwrapped, DummyVecEnv):
        for position, single in enumerate(env.unwrapped.envs):
            parts.add(environment_parts(single, f"{prefix}environment {position}, "))
    return parts


def no_state(layers: Mapping[str, VecEnv]) -> dict[str, Collection[str]]:
    """
    :param layers: A vectorised environment and its wrappers, by name
    :return: For each the attributes that are no state
    """
    # A monitor counts from its start in its file
    return {name: (*NO_STATE, "t_start") if isinstance(layer, VecMonitor) else NO_STATE for name, layer in layers.items()}


def check_same_environment(env: VecEnv, layers: Iterable[str], n_envs: int, saved_layers: Iterable[str]) -> None:
    """
    :param env: A vectorised environment
    :param layers: Names of its parts that have state in this process
    :param n_envs: How many environments the saved one consisted of
    :param saved_layers: Names of the parts of the saved one
    :raises ValueError: Naming what differs
    """
    if env.num_envs != n_envs:
        raise ValueError(f"There must be {n_envs} environments side by side, as in the checkpoint, got {env.num_envs}")
    check_same_layers(layers, saved_layers)


def remote_states(env: VecEnv) -> list[Any]:
    """
    :param env: A prepared environment, between two steps
    :return: State of the environments that are in other processes, and of the global random numbers there
    :raises ValueError: When the state cannot be saved
    """
    if not isinstance(env.unwrapped, SubprocVecEnv):
        return []
    results = env.unwrapped.env_method("attempt_state")
    for position, (fault, _) in enumerate(results):
        _raise(position, fault)
    return [state for _, state in results]


def restore_remotes(env: VecEnv, states: Sequence[Any]) -> None:
    """
    Put the states of environments in other processes back.

    :param env: An environment made in the same way as the saved one, whose own state in this process has been put back
    :param states: What :func:`remote_states` returned
    :raises ValueError: Naming what differs from the saved environment
    """
    base = env.unwrapped
    if not isinstance(base, SubprocVecEnv):
        return
    for remote, single in zip(base.remotes, states, strict=True):
        remote.send(("env_method", ("attempt_load", (single,), {})))
    for position, (fault, _) in enumerate([remote.recv() for remote in base.remotes]):
        _raise(position, fault)
    for remote, info in zip(base.remotes, base.reset_infos, strict=True):
        remote.send(("reset", (None, {RESUMED: info})))
    for remote in base.remotes:
        remote.recv()


def env_layers(env: VecEnv) -> list[VecEnv]:
    """
    :param env: A vectorised environment
    :return: It and what it wraps, from the outside to the inside
    """
    layers = [env]
    while isinstance(layers[-1], VecEnvWrapper):
        layers.append(layers[-1].venv)
    return layers


def named_layers(env: VecEnv) -> dict[str, VecEnv]:
    """
    :param env: A vectorised environment
    :return: Its layers by names, without those that only film
    """
    kept = [layer for layer in env_layers(env) if not isinstance(layer, VecVideoRecorder)]
    return {f"{position} {type(layer).__name__}": layer for position, layer in enumerate(kept)}


def _known(layers: Mapping[str, VecEnv]) -> dict[str, object]:
    *_, (base_name, base) = layers.items()
    # Not the empty tuple, which is one object wherever it stands
    return {f"{base_name} {name}": value for name in ENVIRONMENTS if (value := vars(base).get(name))}


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
