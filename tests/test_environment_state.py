"""The state of environments is put back into new ones, which go on as the old ones would have."""

import pickle
import subprocess
import sys
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

import sb3_cchain  # noqa: F401
from sb3_cchain.checkpoint.environment_state import (
    can_save_environment,
    environment_state,
    prepare_environment,
    restore_environment,
)
from sb3_cchain.checkpoint.resumable_env import ResumableEnv
from sb3_cchain.envs import ContinualProcgenVecEnv

N_ENVS = 2
# Steps over both environments after which the next task begins
STEPS_PER_TASK = 120
# Environment, its arguments, and the package that it needs
CASES = {
    "CartPole-v1": ({}, None),
    "Acrobot-v1": ({"max_episode_steps": 40}, None),
    "MountainCar-v0": ({"max_episode_steps": 40}, None),
    "MountainCarContinuous-v0": ({"max_episode_steps": 40}, None),
    "Pendulum-v1": ({"max_episode_steps": 40}, None),
    "FrozenLake-v1": ({}, None),
    "LunarLander-v3": ({"enable_wind": True}, "Box2D"),
    "BipedalWalker-v3": ({}, "Box2D"),
    "HalfCheetah-v5": ({"max_episode_steps": 40}, "mujoco"),
    "Hopper-v5": ({}, "mujoco"),
    "Continual/Acrobot-v1": ({"steps_per_task": STEPS_PER_TASK, "max_episode_steps": 40}, None),
    "Continual/LunarLander-v3": ({"steps_per_task": STEPS_PER_TASK}, "Box2D"),
    "Continual/MinAtar-v0": ({"steps_per_task": STEPS_PER_TASK}, "minatar"),
    "Continual/Walker-v0": ({"steps_per_task": STEPS_PER_TASK, "max_episode_steps": 40}, "dm_control"),
    "Continual/Quadruped-v0": ({"steps_per_task": STEPS_PER_TASK, "max_episode_steps": 40}, "dm_control"),
    "Continual/Starpilot-v0": ({"steps_per_task": STEPS_PER_TASK}, "procgen"),
    "ContinualProcgenVecEnv": ({"game": "starpilot", "steps_per_task": STEPS_PER_TASK}, "procgen"),
}


def make(env_id, subproc=False, seed=0, **kwargs):
    """Vectorised environments, those of processes of their own made resumable."""
    arguments, package = CASES[env_id]
    if package is not None:
        pytest.importorskip(package)
    if env_id == "ContinualProcgenVecEnv":
        env = ContinualProcgenVecEnv(n_envs=N_ENVS, num_threads=0, **arguments)
        env.seed(seed)
    else:
        continual = {"n_envs": N_ENVS} if env_id.startswith("Continual/") else {}
        kwargs = {"vec_env_cls": SubprocVecEnv, "vec_env_kwargs": {"start_method": "fork"}, "wrapper_class": ResumableEnv, **kwargs} if subproc else kwargs
        env = make_vec_env(env_id, n_envs=N_ENVS, seed=seed, env_kwargs={**arguments, **continual}, **kwargs)
    env.reset()
    prepare_environment(env)
    # From here on, episodes are recorded where that is needed
    env.reset()
    return env


def act(env, step):
    """Random actions that depend on the step alone."""
    rng = np.random.default_rng(step)
    if isinstance(env.action_space, gym.spaces.Discrete):
        return rng.integers(env.action_space.n, size=env.num_envs)
    space = env.action_space
    return rng.uniform(space.low, space.high, (env.num_envs, *space.shape)).astype(space.dtype)


def plain(value):
    """What can be compared by ``==``, without times."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items() if key != "t"}
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.dtype.str, value.shape, value.tobytes()
    return value


def play(env, start, end):
    """What the steps return, and the infos of the resets."""
    found = []
    for step in range(start, end):
        result = plain(env.step(act(env, step)))
        found.append((result, plain(env.unwrapped.reset_infos)))
    return found


def assert_goes_on(env, new, cut, n_steps, start=0):
    play(env, start, cut)
    assert can_save_environment(env)
    content = pickle.dumps(environment_state(env))
    expected = play(env, cut, cut + n_steps)
    restore_environment(new, pickle.loads(content))
    assert_same(expected, play(new, cut, cut + n_steps))


def assert_same(expected, found):
    for step, (one, other) in enumerate(zip(expected, found, strict=True)):
        assert one == other, f"Differs at step {step}"


@pytest.mark.parametrize("env_id", CASES)
def test_goes_on_exactly(env_id):
    for cut in (100, 59, 60):
        env, new = make(env_id), make(env_id, seed=7)
        assert_goes_on(env, new, cut, 150)
        env.close()
        new.close()
