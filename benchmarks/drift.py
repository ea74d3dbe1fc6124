"""
How soon does TaskSignal(drift="adwin") notice that the world has changed, and how often when it has not? Trains CChainPPO in
worlds whose switches are known, records what the detector may watch, and shows delays and false alarms. An alarm is for a
switch when it is the first one after it and comes within half a task. All other alarms are false.

    python -m benchmarks.drift        # all worlds, five seeds; goes on where it was interrupted
"""

import argparse
import csv
from bisect import bisect_right
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.report.markdown import markdown_table
from sb3_cchain import CChainPPO, ContinualEnv
from sb3_cchain.checkpoint import write_safely
from sb3_cchain.tasks.drift import Drift

N_TASKS = 3
# What is watched, by its name in `drift_of`, and which of its values are worse
WATCHED = {"return": "smaller", "train/value_loss": "greater", "churn/policy_churn": "greater"}
DELTAS = (0.002, 0.05)
# Half the length of the pole in each task, m; CartPole-v1 has 0.5
POLES = (0.5, 0.05, 2.0)
SETTINGS = dict(n_steps=64, batch_size=128, n_epochs=5, learning_rate=1e-3, gamma=0.98, device="cpu")
N_ENVS = 8

Series = list[tuple[int, float]]


class Alarms(NamedTuple):
    """
    What a detector said in one training.

    :param delays: For each switch that it noticed, the environment steps and the values until it did
    :param n_switches: How many switches there were
    :param n_false: All other alarms: in the first task, a second one in a later task, and those that come late
    """

    delays: list[tuple[int, int]]
    n_switches: int
    n_false: int


def _make_pole(half_length: float) -> gym.Env:
    env = gym.make("CartPole-v1")
    env.unwrapped.length = half_length  # type: ignore[attr-defined]
    env.unwrapped.polemass_length = env.unwrapped.masspole * half_length  # type: ignore[attr-defined]
    return env


UNCHANGED = "CartPole that stays as it is"
# Title → what makes an environment with tasks of so many steps
WORLDS: dict[str, Callable[[int], gym.Env]] = {
    "continual CartPole": lambda steps: gym.make("Continual/CartPole-v1", n_tasks=N_TASKS, steps_per_task=steps),
    "continual Acrobot": lambda steps: gym.make("Continual/Acrobot-v1", n_tasks=N_TASKS, steps_per_task=steps),
    "CartPole, poles of other lengths": lambda steps: ContinualEnv([partial(_make_pole, pole) for pole in POLES], steps),
    UNCHANGED: lambda steps: ContinualEnv([partial(_make_pole, POLES[0])], steps),
}


class Record(BaseCallback):
    """Keeps what a detector may watch, as TaskSignal reads it: time and value."""

    def __init__(self) -> None:
        super().__init__()
        self.series: dict[str, Series] = {name: [] for name in WATCHED}

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                self.series["return"].append((self.num_timesteps, float(info["episode"]["r"])))
        return True

    def _on_rollout_start(self) -> None:
        logged = self.logger.name_to_value
        for name in self.series.keys() & logged.keys():
            self.series[name].append((self.num_timesteps, float(logged[name])))


def train(world: str, seed: int, steps_per_task: int) -> dict[str, Series]:
    """
    :param world: Key of ``WORLDS``
    :param seed: Seed
    :param steps_per_task: Environment steps of each task
    :return: What was recorded, by its name in ``drift_of``
    """
    env = make_vec_env(partial(WORLDS[world], steps_per_task), N_ENVS, seed=seed)
    record = Record()
    CChainPPO("MlpPolicy", env, seed=seed, **SETTINGS).learn(N_TASKS * steps_per_task, record)  # type: ignore[arg-type]
    return record.series


def alarms(series: Series, switches: Sequence[int], in_time: int, delta: float, worse: str) -> Alarms:
    """
    :param series: Time in environment steps, and value
    :param switches: Environment steps at which the second and further tasks begin
    :param in_time: Environment steps after a switch up to which an alarm is for it
    :param delta: Threshold δ of the detector
    :param worse: Which values are worse, ``"smaller"`` or ``"greater"``
    :return: What the detector says
    """
    detector, delays, n_false = Drift("adwin", delta, worse), dict[int, tuple[int, int]](), 0
    times = [time for time, _ in series]
    for position, (time, value) in enumerate(series):
        if detector.update(value):
            # A value that comes at the switch itself is still of the old task
            task = sum(time > switch for switch in switches)
            begin = switches[task - 1] if task > 0 else None
            if begin is None or task in delays or time - begin > in_time:
                n_false += 1
            else:
                delays[task] = (time - begin, position + 1 - bisect_right(times, begin))
    return Alarms(list(delays.values()), len(switches), n_false)


def table_of(results: dict[tuple[str, int], dict[str, Series]], steps_per_task: int) -> str:
    """
    :param results: What was recorded, by world and seed
    :param steps_per_task: Environment steps of each task
    :return: A table with a row per world, watched value and threshold
    """
    rows = []
    for world in dict.fromkeys(world for world, _ in results):
        switches = [] if world == UNCHANGED else [steps_per_task * task for task in range(1, N_TASKS)]
        runs = [series for (of, _), series in results.items() if of == world]
        for name, worse in WATCHED.items():
            for delta in DELTAS:
                said = [alarms(series[name], switches, steps_per_task // 2, delta, worse) for series in runs]
                delays = [delay for each in said for delay in each.delays]
                steps, values = np.median(delays, axis=0) if delays else (np.nan, np.nan)
                rows.append(
                    [
                        *(world, f"`{name}`", f"{delta:g}"),
                        f"{len(delays)} of {sum(each.n_switches for each in said)}" if switches else "",
                        *((f"{values:.0f}", f"{steps:.0f}") if delays else ("", "")),
                        f"{sum(each.n_false for each in said)}",
                    ]
                )
    header = ["world", "watched", "δ", "switches noticed", "delay, values", "delay, steps", "false alarms"]
    return markdown_table(header, rows)


def write(path: Path, recorded: dict[str, Series]) -> None:
    """
    :param path: CSV file
    :param recorded: What was recorded
    """
    with write_safely(path) as safe, open(safe, "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["watched", "timesteps", "value"])
        writer.writerows([name, time, f"{value:.6g}"] for name, series in recorded.items() for time, value in series)


def read(path: Path) -> dict[str, Series]:
    """
    :param path: CSV file
    :return: What was recorded
    """
    recorded: dict[str, Series] = {name: [] for name in WATCHED}
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            recorded[row["watched"]].append((int(row["timesteps"]), float(row["value"])))
    return recorded


def main(arguments: Sequence[str] | None = None) -> None:
    """
    :param arguments: Arguments of the command line
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS), choices=list(WORLDS), help="Worlds")
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(5)), help="Seeds")
    parser.add_argument("--steps-per-task", type=int, default=20_000, help="Environment steps of each of the three tasks")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results"), help="Folder of all results")
    args = parser.parse_args(arguments)
    th.set_num_threads(1)
    folder = args.output / f"drift_{N_TASKS}x{args.steps_per_task}"
    for world, seed in product(args.worlds, args.seeds):
        path = _folder(folder, world) / f"seed_{seed}.csv"
        if not path.exists():
            write(path, train(world, seed, args.steps_per_task))
            print(f"{world}, seed {seed}: done", flush=True)
    # All that is there, with what was made before
    results = {
        (world, seed): read(path)
        for world in WORLDS
        for seed, path in sorted((int(path.stem[5:]), path) for path in _folder(folder, world).glob("seed_*.csv"))
    }
    table = table_of(results, args.steps_per_task)
    (folder / "table.md").write_text(table + "\n")
    print(f"{table}\n\nWritten: {folder}/table.md")


def _folder(folder: Path, world: str) -> Path:
    return folder / world.replace(",", "").replace(" ", "_")


if __name__ == "__main__":
    main()
