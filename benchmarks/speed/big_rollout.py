"""A rollout of 64 × 256 images of ProcGen's shape, and what is done with it in a process of its own: memory is measured."""

import multiprocessing
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv

from benchmarks.speed.settings import model_settings

N_ENVS, N_STEPS = 64, 256


def with_rollout(algorithm: type[PPO], algo: str, n_envs: int = N_ENVS, n_steps: int = N_STEPS, **changed: Any) -> PPO:
    """
    :param algorithm: Algorithm
    :param algo: Name of its file of hyperparameters
    :param n_envs: Environments
    :param n_steps: Steps of each
    :param changed: Arguments that differ from the shipped settings
    :return: A model whose rollout is of random images, with actions, advantages and returns of 0
    """
    env = make_vec_env(FakeImageEnv, n_envs, env_kwargs=dict(screen_height=64, screen_width=64, n_channels=3))
    model = algorithm(**model_settings(algo, "Continual/Starpilot-v0", **{**changed, "env": env, "n_steps": n_steps}))
    model._setup_learn(1)
    buffer = model.rollout_buffer
    generator = np.random.default_rng(0)
    for images in buffer.observations:  # step by step: a second rollout would count as memory
        images[:] = generator.integers(0, 256, images.shape, dtype=np.uint8)
    buffer.full = True
    return model


def in_process(function: Callable[..., Any], *args: Any) -> Any:
    """
    :param function: A function of a module
    :param args: Its arguments
    :return: What it returns in a process of its own, with one thread
    """
    with multiprocessing.get_context("spawn").Pool(1, initializer=th.set_num_threads, initargs=(1,)) as pool:
        return pool.apply(function, args)


def peak_memory() -> float:
    """
    :return: The greatest resident memory of this process so far, in GB
    """
    # Linux's. `ru_maxrss` begins with the memory of the process that started this one
    kilobytes = re.findall(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return int(kilobytes[0]) * 1024 / 1e9
