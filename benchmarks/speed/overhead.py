"""
What the package costs around training: its environments, the callbacks that C-CHAIN adds by itself, and what they log. The
same training runs with them and without them, in turn in one process and with the same random numbers, so that both make the
same steps and updates. Without them, the environment is the first task alone, and callbacks and logger are SB3's own.

    python -m benchmarks.speed.overhead
    python -m benchmarks.speed.overhead --case minatar --rounds 20

Prints the processor time of the parts per environment step, and the differences as shares of the whole training without them.
"""

import argparse
from collections.abc import Callable
from functools import partial
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium.wrappers import TimeLimit
from rich.console import Console
from rich.progress import track
from rich.table import Table
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from benchmarks.speed.settings import model_settings
from benchmarks.speed.time_inside import TimeInside
from benchmarks.speed.timing import seconds
from sb3_cchain import CChainDQN, CChainPPO, ContinualEnv
from sb3_cchain.algorithms.churn_algorithm import ChurnAlgorithm
from sb3_cchain.envs import TaskVecNormalize

# What is timed of a training, by the names in the table. The start and the end of `learn()` are left out: they come once in a
# training, but in each round here.
PARTS = ("around the simulation", "callbacks", "buffers of episodes", "logger")
EVENTS = ("update_locals", "on_step", "on_rollout_start", "on_rollout_end")

Seconds = dict[str, float]


class Bare(ChurnAlgorithm):
    """Churn reduction without the mixin's callbacks, overview in TensorBoard and look at each step's task."""

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        return BaseAlgorithm._init_callback(self, callback, progress_bar)

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: Any = None) -> None:
        BaseAlgorithm._update_info_buffer(self, infos, dones)


class BarePPO(Bare, CChainPPO):
    """CChainPPO with nothing around it."""


class BareDQN(Bare, CChainDQN):
    """CChainDQN with nothing around it."""


def first_task(env_id: str) -> gym.Env:
    """
    :param env_id: Id of a continual environment
    :return: Its first task, with its limit of episode steps
    """
    env = gym.make(env_id)
    assert env.spec is not None
    task, limit = env.unwrapped.task, env.spec.max_episode_steps  # type: ignore[attr-defined]
    return task if limit is None else TimeLimit(task, limit)


def simulation(env: VecEnv) -> gym.Env:
    """
    :param env: A vectorised environment, of a continual environment or of its first task
    :return: The environment that makes the steps, without anything around it
    """
    inner = env.unwrapped.envs[0].unwrapped  # type: ignore[attr-defined]
    return inner.task.unwrapped if isinstance(inner, ContinualEnv) else inner


class TimedTraining:
    """
    A training whose parts are timed.

    :param model: The model
    :param folder: What it logs goes there
    """

    def __init__(self, model: Any, folder: str):
        self.model = model
        model.set_logger(configure(folder, ["tensorboard"]))
        self._inside = {name: TimeInside() for name in (*PARTS, "simulation", "train()", "start and end")}
        self._inside["around the simulation"].watch(model.env, "step")
        self._inside["simulation"].watch(simulation(model.env), "step")
        self._inside["buffers of episodes"].watch(model, "_update_info_buffer")
        self._inside["logger"].watch(model.logger, "dump")
        self._inside["train()"].watch(model, "train")
        self._init_callback, model._init_callback = model._init_callback, self._make_callback
        self._inside["start and end"].watch(model, "_setup_learn")

    def _make_callback(self, *args: Any) -> BaseCallback:
        callback = self._init_callback(*args)
        self._inside["callbacks"].watch(callback, *EVENTS)
        self._inside["start and end"].watch(callback, "on_training_start", "on_training_end")
        return callback

    def run(self, n_steps: int, seed: int) -> Seconds:
        """
        Train for a while.

        :param n_steps: Environment steps
        :param seed: Of the random numbers
        :return: Seconds of processor time in each part, in all, and in all but ``train()``
        """
        for inside in self._inside.values():
            inside.seconds = 0.0
        set_random_seed(seed)
        total = seconds(lambda: self.model.learn(n_steps, reset_num_timesteps=False))
        timing = {name: inside.seconds for name, inside in self._inside.items()}
        timing["around the simulation"] -= timing.pop("simulation")
        timing["all"] = total - timing.pop("start and end")
        timing["all but train()"] = timing["all"] - timing["train()"]
        return timing


def time_in_turn(models: tuple[Any, Any], n_steps: int, n_rounds: int) -> list[tuple[Seconds, Seconds]]:
    """
    :param models: A model with what is measured, and the same without it
    :param n_steps: Environment steps of a round
    :param n_rounds: Rounds, without the first, which is not counted
    :return: The seconds of both in each round
    """
    timings = []
    with TemporaryDirectory() as one, TemporaryDirectory() as other:
        trainings = TimedTraining(models[0], one), TimedTraining(models[1], other)
        for seed in track(range(n_rounds + 1), description="Training"):
            # Each is the first in every other round
            order = (0, 1) if seed % 2 else (1, 0)
            timing = {position: trainings[position].run(n_steps, seed) for position in order}
            timings.append((timing[0], timing[1]))
    return timings[1:]


def as_table(title: str, timings: list[tuple[Seconds, Seconds]], n_steps: int) -> Table:
    """
    :param title: Human-readable name
    :param timings: As returned by ``time_in_turn()``
    :param n_steps: Environment steps of a round
    :return: Medians over the rounds of the time per step; median, least and greatest difference within a round, as a share of
        all that is done without what is measured
    """
    table = Table("µs per environment step", "with", "without", "difference", "min", "max", title=title)

    def add(name: str, parts: tuple[str, ...]) -> None:
        sums = [[sum(timing[part] for part in parts) for timing in pair] for pair in timings]
        shares = [(one - other) / pair[1]["all"] for (one, other), pair in zip(sums, timings, strict=True)]
        medians = np.median(sums, axis=0) / n_steps * 1e6
        table.add_row(name, *(f"{m:.1f}" for m in medians), *(f"{f(shares):.2%}" for f in (np.median, np.min, np.max)))

    for part in PARTS:
        add(part, (part,))
    add("these parts", PARTS)
    # train() is the same on both sides. What is left includes the networks, whose time depends on where in memory they lie:
    # here two trainings that are alike differ by up to 2 %, in the parts by less than 0.5 %
    add("all but train()", ("all but train()",))
    table.caption = f"All, without: {np.median([other['all'] for _, other in timings]) / n_steps * 1e6:.0f} µs"
    return table


def gym_control() -> tuple[Any, Any, int]:
    """
    :return: CChainPPO under the shipped settings of continual Acrobot, bare too, and the steps of an iteration
    """
    settings = model_settings("ppo_cchain", "Continual/Acrobot-v1")
    return CChainPPO(**settings), BarePPO(**{**settings, "env": first_task(settings["env"])}), settings["n_steps"]


def minatar() -> tuple[Any, Any, int]:
    """
    :return: CChainDQN under the shipped settings of continual MinAtar, bare too, and some steps, with an update each
    """
    settings = model_settings("dqn_cchain", "Continual/MinAtar-v0", buffer_size=20_000, learning_starts=100)
    return CChainDQN(**settings), BareDQN(**{**settings, "env": first_task(settings["env"])}), 150


def dmc() -> tuple[Any, Any, int]:
    """
    :return: CChainPPO under the shipped settings of continual Walker, with normalisation; bare too; and the steps of an
        iteration, which is shorter here and has as many updates for each step
    """
    settings = model_settings("ppo_cchain", "Continual/Walker-v0", n_steps=256)
    env = TaskVecNormalize(make_vec_env(settings["env"]))
    bare_env = VecNormalize(make_vec_env(partial(first_task, settings["env"])))
    return CChainPPO(**{**settings, "env": env}), BarePPO(**{**settings, "env": bare_env}), settings["n_steps"]


CASES: dict[str, Callable[[], tuple[Any, Any, int]]] = {"gym_control": gym_control, "minatar": minatar, "dmc": dmc}


def main() -> None:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", nargs="+", default=list(CASES), choices=list(CASES), help="What to time")
    parser.add_argument("--rounds", type=int, default=5, help="Timings of each")
    args = parser.parse_args()
    th.set_num_threads(1)
    for name in args.case:
        model, bare, n_steps = CASES[name]()
        title = f"{type(model).__name__}, {name}, rounds: {args.rounds}"
        Console().print(as_table(title, time_in_turn((model, bare), n_steps, args.rounds), n_steps))


if __name__ == "__main__":
    main()
