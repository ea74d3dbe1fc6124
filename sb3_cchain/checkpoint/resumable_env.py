"""The state of a single environment with its wrappers."""

import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
from gymnasium.core import ActType, ObsType
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import OrderEnforcing
from stable_baselines3.common.monitor import Monitor

from sb3_cchain.checkpoint.episode_replay import CONSTRUCTION, EpisodeReplay
from sb3_cchain.checkpoint.named_code import stock_class
from sb3_cchain.checkpoint.object_state import ObjectStates, is_stream, object_states, restore_objects
from sb3_cchain.checkpoint.random_state import random_state, restore_random_state
from sb3_cchain.checkpoint.simulator_state import emptied, is_inexact, register_simulators
from sb3_cchain.checkpoint.state_pickle import NotSaved
from sb3_cchain.checkpoint.value_description import describe_value
from sb3_cchain.envs.continual_env import ContinualEnv
from sb3_cchain.envs.reset import reset_env

# As an option of `reset()`, the info of the reset with which the present episode began. See `ResumableEnv.reset`
RESUMED = "sb3_cchain.resumed_reset_info"


class ResumableEnv(gym.Wrapper[ObsType, ActType, ObsType, ActType]):
    """
    Lets training that is stopped go on in the middle of an episode, exactly as if it had not been stopped. It must be the
    outermost wrapper. ``SubprocVecEnv`` needs it, because its environments are in other processes::

        make_vec_env(env_id, n_envs=8, vec_env_cls=SubprocVecEnv, wrapper_class=ResumableEnv)

    :param env: The environment
    """

    def __init__(self, env: gym.Env[ObsType, ActType]):
        super().__init__(env)
        # Not done before the environment is used for the first time, so that errors reach the process that trains
        self._fault = attempt(make_resumable, self, begun=False)[0]

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]
        """That of the environment, as this wrapper changes nothing."""
        return self.env.spec

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[ObsType, dict[str, Any]]:
        """
        :param seed: Passed on
        :param options: Passed on. ``SubprocVecEnv`` keeps the info of the last reset in the other process, where only a reset
            can put it back. So with :data:`RESUMED` among the options the episode goes on, and there is no observation
        :return: Observation and info
        """
        if options is not None and RESUMED in options:
            return None, options[RESUMED]  # type: ignore[return-value]
        return reset_env(self.env, seed, options)

    def state_dict(self) -> ObjectStates:
        """
        :return: The state of the environment and its wrappers, which can be pickled and does not change any more
        :raises ValueError: When the environment cannot be saved
        """
        return environment_parts(self).read()

    def load_state_dict(self, state: ObjectStates) -> None:
        """
        Put a state back.

        :param state: What ``state_dict()`` returned
        :raises ValueError: When the environment is another one
        """
        parts = environment_parts(self)
        check_same_layers(parts.holders, state.holders)
        restore_objects(parts.holders, state, parts.known)

    def resume_fault(self) -> str | None:
        """
        :return: Why the environment cannot be resumed, if it cannot
        """
        # What a reset adds may need to be recorded, too
        return self._fault or attempt(make_resumable, self)[0]

    def description(self) -> str:
        """
        :return: See :func:`describe_single_environment`
        """
        return describe_single_environment(self)

    def can_save(self) -> bool:
        """
        :return: Whether the present episode can be saved
        """
        return can_save_single_environment(self)

    def attempt_state(self) -> tuple[str | None, Any]:
        """
        ``state_dict()`` for other processes, where an error would end the process of the environment.

        :return: The error, if there was one; the state, and that of the global random numbers of the process
        """
        fault, state = attempt(self.state_dict)
        return fault, (state, random_state())

    def attempt_load(self, state: tuple[ObjectStates, dict[str, Any]]) -> tuple[str | None, Any]:
        """
        ``load_state_dict()`` for other processes.

        :param state: What ``attempt_state()`` returned
        :return: The error, if there was one
        """
        of_environment, of_random_numbers = state
        fault = attempt(self.load_state_dict, of_environment)
        restore_random_state(of_random_numbers)  # last, as an episode that is played again draws some
        return fault


def attempt(function: Any, *args: Any, **kwargs: Any) -> tuple[str | None, Any]:
    """
    :param function: Any
    :param args: Its arguments
    :param kwargs: Its keyword arguments
    :return: The message of the ValueError that it raised, or what it returned
    """
    try:
        return None, function(*args, **kwargs)
    except ValueError as error:
        return str(error), None


def make_resumable(env: gym.Env, *, begun: bool = True) -> gym.Env:
    """
    Record the episodes of an environment, or of its tasks, where its state cannot be saved.

    :param env: The environment. Wrappers are put into it, around what cannot be saved
    :param begun: Whether it may have been reset already
    :return: It, or a wrapper if that has to be around all
    :raises ValueError: When the environment cannot be made resumable
    """
    register_simulators()
    chain = _chain(env)
    base = chain[-1]
    if is_inexact(base):
        raise ValueError(
            f"{base} cannot be resumed exactly, because its simulator saves only a part of its state. Begin new episodes when "
            "training is resumed: TrainingCheckpoint(..., exact=False), on the command line --checkpoint-inexact"
        )
    if isinstance(base, ContinualEnv):
        for task_id, task in enumerate(base.tasks):
            base.tasks[task_id] = make_resumable(task, begun=begun and task_id in base._seeded)
    for position, layer in enumerate(chain):
        fault = _fault(env, layer)
        if fault is None:
            continue
        if isinstance(base, ContinualEnv):
            raise ValueError(
                f"{layer} cannot be resumed, because its state cannot be saved: {fault}. "
                "Give its class `state_dict()` and `load_state_dict(state)`"
            )
        if streams := [name for name, value in vars(layer).items() if is_stream(value)]:
            warnings.warn(
                f"{layer} holds {', '.join(streams)}, a generator or a file, whose place cannot be saved. If an episode goes "
                "on there where the one before stopped, training cannot be resumed. Let `reset()` make it anew, give the "
                "class `state_dict()` and `load_state_dict(state)`, or use TrainingCheckpoint(..., exact=False)"
            )
        replay: gym.Env = EpisodeReplay(layer, begun=begun and _may_have_begun(chain))
        if position == 0:
            return replay
        outer = chain[position - 1]
        assert isinstance(outer, gym.Wrapper)
        outer.env = replay
        break
    return env


def _may_have_begun(chain: Sequence[gym.Env]) -> bool:
    # Gymnasium's wrapper knows of resets; an environment for evaluation may not have been used yet
    return all(layer.has_reset for layer in chain if isinstance(layer, OrderEnforcing))


def describe_single_environment(env: gym.Env) -> str:
    """
    :param env: An environment
    :return: Its id and arguments, and the classes of its wrappers, from outside to inside. Not ``str(env)``, which may tell
        of its state
    """
    spec, names = env.spec, []
    while isinstance(env, gym.Wrapper):
        if not isinstance(env, EpisodeReplay):  # which is put in when training starts
            names.append(stock_class(type(env)).__name__)
        env = env.env
    name = "without id" if spec is None else spec.id
    kwargs = {} if spec is None else spec.kwargs
    # `render_mode` is for the eye; what cannot be described is left out
    arguments = {key: describe_value(value) for key, value in kwargs.items() if key != "render_mode"}
    told = ", ".join(f"{key}={text}" for key, text in sorted(arguments.items()) if text is not None)
    return f"{name}{f' with {told}' if told else ''} ({' '.join([*names, type(env).__name__])})"


def can_save_single_environment(env: gym.Env) -> bool:
    """
    :param env: An environment that :func:`make_resumable` returned
    :return: Whether the beginning of its present episode was recorded, where that is needed
    """
    return all(layer.is_recorded for layer in _layers(env).values() if isinstance(layer, EpisodeReplay))


@dataclass
class Parts:
    """
    Objects that have state, as ``object_states()`` takes them.

    :param holders: The objects by name: environments, their wrappers and, of a continual environment, all tasks
    :param known: What they refer to and is not part of their state
    :param skip: Attributes of each that are not part of its state
    :param strict: Names of the holders that must be saved whole
    :param unused: Tasks that do nothing before their next reset
    """

    holders: dict[str, object]
    known: dict[str, object]
    skip: dict[str, Collection[str]]
    strict: list[str] = field(default_factory=list)
    unused: list[gym.Env] = field(default_factory=list)

    def add(self, other: "Parts") -> None:
        """
        :param other: Objects that are saved together with these
        """
        self.holders.update(other.holders)
        self.known.update(other.known)
        self.skip.update(other.skip)
        self.strict += other.strict
        self.unused += other.unused

    def read(self, left_out: list[str] | None = None) -> ObjectStates:
        """
        :param left_out: See :func:`~sb3_cchain.checkpoint.object_state.object_states`
        :return: Their states
        """
        with emptied(self.unused):
            return object_states(self.holders, self.known, skip=self.skip, strict=self.strict, left_out=left_out)


def environment_parts(env: gym.Env, prefix: str = "") -> Parts:
    """
    :param env: An environment that :func:`make_resumable` returned
    :param prefix: What names begin with
    :return: The objects that have state
    """
    register_simulators()
    layers = _layers(env, prefix)
    skip: dict[str, Collection[str]] = {name: (*CONSTRUCTION, *_times(layer)) for name, layer in layers.items()}
    return Parts(dict(layers), _known(layers), skip, list(layers), _tasks_not_under_way(layers))


def check_same_layers(layers: Iterable[str], saved_layers: Iterable[str]) -> None:
    """
    :param layers: Names of an environment and its wrappers
    :param saved_layers: Names of those that were saved
    :raises ValueError: Naming the first one that differs
    """
    present, saved = list(layers), list(saved_layers)
    if present == saved:
        return
    shorter = min(len(present), len(saved))
    position = next((i for i in range(shorter) if present[i] != saved[i]), shorter)
    names = [found[position] if position < len(found) else "none" for found in (present, saved)]
    raise ValueError(
        f"The environment must be wrapped as the saved one was, but it has {names[0]!r} instead of {names[1]!r}. "
        f"It has {', '.join(present)}; the saved one had {', '.join(saved)}"
    )


def _chain(env: gym.Env) -> list[gym.Env]:
    """The environment and what it wraps, from the outside to the inside, down to where episodes are recorded."""
    chain = [env]
    while isinstance(env, gym.Wrapper) and not isinstance(env, EpisodeReplay):
        env = env.env
        chain.append(env)
    return chain


def _layers(env: gym.Env, prefix: str = "") -> dict[str, gym.Env]:
    """All that has a state of its own, with the tasks of a continual environment."""
    chain = _chain(env)
    kept = [layer for layer in chain if not isinstance(layer, ResumableEnv)]
    layers = {f"{prefix}{position} {stock_class(type(layer)).__name__}": layer for position, layer in enumerate(kept)}
    if isinstance(chain[-1], ContinualEnv):
        for task_id, task in enumerate(chain[-1].tasks):
            layers.update(_layers(task, f"{prefix}task {task_id}, "))
    return layers


def _known(layers: Mapping[str, gym.Env]) -> dict[str, object]:
    """What the layers refer to and is no state of theirs."""
    known: dict[str, object] = {}
    for name, layer in layers.items():
        if isinstance(layer, ContinualEnv):
            known[f"{name} tasks"] = layer.tasks
        if isinstance(layer, gym.Wrapper):
            known[f"{name} env"] = layer.env
    return known


def _tasks_not_under_way(layers: Mapping[str, gym.Env]) -> list[gym.Env]:
    """Tasks of continual environments that do nothing before their next reset."""
    continual = [layer for layer in layers.values() if isinstance(layer, ContinualEnv)]
    return [task for env in continual for task in env.tasks if task is not env.task]


def _times(layer: gym.Env) -> tuple[str, ...]:
    # A monitor counts from then in its file
    return ("t_start",) if isinstance(layer, Monitor) else ()


def _fault(env: gym.Env, layer: gym.Env) -> str | None:
    """Why the state of a layer cannot be saved, if it cannot."""
    layers = _layers(env)
    name = next((name for name, other in layers.items() if other is layer), None)
    if name is None or isinstance(layer, EpisodeReplay):
        return None
    others = {other: known for other, known in layers.items() if other != name}
    try:
        # What MuJoCo's data are is known
        with emptied(layers.values()):
            object_states({name: layer}, {**others, **_known(layers)}, skip={name: CONSTRUCTION}, strict=[name])
    except NotSaved as error:
        return str(error)
    return None
