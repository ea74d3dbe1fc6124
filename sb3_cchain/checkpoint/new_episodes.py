"""Training that goes on with new episodes: what lasts longer than an episode is put back nevertheless."""

import warnings
from collections.abc import Mapping
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.her import HerReplayBuffer

from sb3_cchain.checkpoint.environment_state import named_layers, no_state
from sb3_cchain.checkpoint.object_state import object_states, restore_objects
from sb3_cchain.tasks.continual import is_continual
from sb3_cchain.tasks.reset import reset_training_env


def lasting_state(env: VecEnv, left_out: list[str]) -> dict[str, Any]:
    """
    :param env: A vectorised environment
    :param left_out: Takes the names of attributes of wrappers that cannot be saved
    :return: What lasts longer than its episodes: the state of its vectorised wrappers, such as the statistics of
        ``VecNormalize``, and how far its tasks are. None of an environment that stays on a task
    """
    wrappers = _wrappers(env)
    clocks = env.get_attr("clock") if is_continual(env) else []
    return {
        "wrappers": object_states(wrappers, _known(env), skip=no_state(wrappers), left_out=left_out),
        "task_steps": [None if clock.is_pinned else clock.n_steps for clock in clocks],
    }


def begin_new_episodes(model: BaseAlgorithm, envs: Mapping[str, VecEnv], states: Mapping[str, Any]) -> None:
    """
    Put back what :func:`lasting_state` returned, and begin new episodes in the training environment.

    :param model: A model between two rollouts
    :param envs: The training environment and others, by name
    :param states: The state of each
    """
    for name, env in envs.items():
        restore_objects(_wrappers(env), states[name]["wrappers"], _known(env))
        for position, n_steps in enumerate(states[name]["task_steps"]):
            if n_steps is not None:
                env.env_method("set_clock", n_steps, indices=position)
    reset_training_env(model)  # wrappers forget in it what belongs to an episode
    buffer = getattr(model, "replay_buffer", None)
    if buffer is not None and buffer.size() > 0:
        _end_last_episodes(buffer)


def _end_last_episodes(buffer: ReplayBuffer) -> None:
    """What is added to the buffer from now on does not follow what is in it."""
    if isinstance(buffer, HerReplayBuffer):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it says that it does so
            buffer.truncate_last_trajectory()
        return
    last = (buffer.pos - 1) % buffer.buffer_size
    under_way = buffer.dones[last] == 0
    buffer.dones[last, under_way] = 1
    if buffer.handle_timeout_termination:
        buffer.timeouts[last, under_way] = 1


def _wrappers(env: VecEnv) -> dict[str, VecEnv]:
    return {name: layer for name, layer in named_layers(env).items() if layer is not env.unwrapped}


def _known(env: VecEnv) -> dict[str, object]:
    return {"environments": env.unwrapped}
