"""
What churn reduction costs on a GPU: the wall-clock time of updates on the CPU, with all of its cores, and on a CUDA device.
Models that are compared are timed in turn. Run it on a machine that does nothing else.

    python -m benchmarks.speed.gpu
    python -m benchmarks.speed.gpu --rounds 10 --write
"""

import argparse
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.envs import FakeImageEnv

from benchmarks.grid.run import ROOT
from benchmarks.report.places import write_tables
from benchmarks.speed.big_rollout import with_rollout
from benchmarks.speed.settings import model_settings
from benchmarks.speed.tables import Table
from benchmarks.speed.timing import ratio
from sb3_cchain import CChainDQN, CChainPPO, DoubleDQN

# Name, class, file of hyperparameters, arguments that differ
PPOS: tuple[tuple[str, type[PPO], str, dict[str, Any]], ...] = (
    ("PPO", PPO, "ppo", {}),
    ("CChainPPO", CChainPPO, "ppo_cchain", {}),
    ('CChainPPO, `churn_reference="next"`', CChainPPO, "ppo_cchain", dict(churn_reference="next")),
)


def impala_ppo(device: str) -> Iterator[tuple[str, Callable[[], Any]]]:
    """
    :param device: PyTorch device
    :return: By name, an epoch over 2500 images of ProcGen's shape, with its shipped network and minibatches
    """
    for name, algorithm, algo, arguments in PPOS:
        yield name, with_rollout(algorithm, algo, 50, 50, n_epochs=1, device=device, **arguments).train


def mlp_ppo(device: str) -> Iterator[tuple[str, Callable[[], Any]]]:
    """
    :param device: PyTorch device
    :return: By name, an iteration's updates under the shipped settings of continual Acrobot
    """
    for name, algorithm, algo, arguments in PPOS:
        settings = model_settings(algo, "Continual/Acrobot-v1", device=device, **arguments)
        yield name, algorithm(**settings).learn(settings["n_steps"]).train


def nature_dqn(device: str) -> Iterator[tuple[str, Callable[[], Any]]]:
    """
    :param device: PyTorch device
    :return: By name, a hundred updates on minibatches of 32 images of Atari's shape
    """
    for algorithm in (DoubleDQN, CChainDQN):
        env = FakeImageEnv(screen_height=84, screen_width=84, n_channels=4, discrete=True, channel_first=True)
        model: DoubleDQN = algorithm("CnnPolicy", env, buffer_size=500, learning_starts=400, seed=0, device=device)
        model.learn(400)
        yield algorithm.__name__, partial(model.train, gradient_steps=100, batch_size=32)


CASES = {"IMPALA network, images": impala_ppo, "3 x 256 MLP, Acrobot": mlp_ppo, "Nature CNN, images": nature_dqn}


def wall_clock(call: Callable[[], Any], device: str) -> float:
    """
    :param call: What to time
    :param device: PyTorch device that it computes on
    :return: Seconds until all that it started is done
    """
    start = time.perf_counter()
    call()
    if device != "cpu":
        th.cuda.synchronize(device)
    return time.perf_counter() - start


def gpu_table(n_rounds: int, devices: tuple[str, ...] = ("cpu", "cuda")) -> Table:
    """
    :param n_rounds: Timings of each
    :param devices: PyTorch devices
    :return: For each case, algorithm and device the seconds (median), and these divided by those of the base (the first) on
        the same device in the same round
    """
    rows = []
    for title, make in CASES.items():
        columns: dict[str, list[str]] = {}
        for device in devices:
            calls = dict(make(device))
            for call in calls.values():
                call()  # the first update has no churn loss, and CUDA starts
            rounds = [{name: wall_clock(call, device) for name, call in calls.items()} for _ in range(n_rounds)]
            seconds = {name: np.array([timing[name] for timing in rounds]) for name in calls}
            base = next(iter(calls))
            for name, own in seconds.items():
                cell = "1" if name == base else ratio(own, seconds[base])
                columns.setdefault(name, []).extend([f"{np.median(own):.2g}", cell])
        rows += [[title, name, *cells] for name, cells in columns.items()]
    header = ["", ""]
    for device in devices:
        header += [f"{device}, seconds", f"{device}, time / base"]
    machine = f"{th.get_num_threads()} threads"
    if "cuda" in devices:
        machine = f"{th.cuda.get_device_name()}, {machine}"
    return Table(header, rows, f"{n_rounds} rounds; {machine}; torch {th.__version__}.")


def main() -> None:
    """Parse the command line, measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=10, help="Timings of each")
    parser.add_argument("--write", action="store_true", help="Put the table into its place in docs/")
    args = parser.parse_args()
    if not th.cuda.is_available():
        parser.error("PyTorch sees no CUDA device")
    text = gpu_table(args.rounds).markdown()
    print(text)
    if args.write:
        write_tables({"gpu": text}, ROOT / "docs")


if __name__ == "__main__":
    main()
