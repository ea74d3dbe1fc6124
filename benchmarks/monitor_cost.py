"""
What the callbacks cost that look at training, each with its defaults: the processor time spent in them as a share of that of
the rest of the same training. Two trainings, with and without, differ by more than that on a machine that does other things.

    python -m benchmarks.monitor_cost
"""

import argparse
import time
from collections.abc import Callable
from functools import wraps
from typing import Any

import torch as th
from rich.console import Console
from rich.table import Table
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks.speed import settings_of
from sb3_cchain import ChurnMonitor
from sb3_cchain.analysis import NetworkHealth, NTKCallback

MONITORS: list[type[BaseCallback]] = [ChurnMonitor, NTKCallback, NetworkHealth]

# Where monitors work: in the events of a callback, and in the hooks that they attach to optimisers
ENTRANCES = ("_on_rollout_start", "_on_rollout_end", "_on_step", "_before_update", "_before_step")


def cost(algorithm: type[BaseAlgorithm], settings: dict[str, Any], monitor: BaseCallback, n_steps: int) -> float:
    """
    :param algorithm: Algorithm
    :param settings: Its arguments
    :param monitor: The callback
    :param n_steps: Environment steps to train for
    :return: Seconds in the callback by seconds in the rest of the training
    """
    inside = 0.0

    def timed(method: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(method)
        def call(*args: Any) -> Any:
            nonlocal inside
            start = time.process_time()
            result = method(*args)
            inside += time.process_time() - start
            return result

        return call

    for name in ENTRANCES:
        if hasattr(monitor, name):
            setattr(monitor, name, timed(getattr(monitor, name)))
    model = algorithm(**settings)
    start = time.process_time()
    model.learn(n_steps, callback=monitor)
    return inside / (time.process_time() - start - inside)


def main() -> None:
    """Parse the command line, measure, print."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    th.set_num_threads(1)
    minatar = settings_of("dqn", "Continual/MinAtar-v0", buffer_size=20_000, learning_starts=400)
    cart_pole = dict(policy="MlpPolicy", env="CartPole-v1", seed=0, device="cpu")
    # Ten iterations of PPO; as many updates of DQN as are between two looks
    trainings: dict[str, tuple[type[BaseAlgorithm], dict[str, Any], int]] = {
        "PPO, Gym Control": (PPO, settings_of("ppo", "Continual/Acrobot-v1"), 8000),
        "PPO, CartPole, SB3's defaults": (PPO, cart_pole, 20_480),
        "DQN, MinAtar": (DQN, minatar, 2400),
        "DQN, CartPole, SB3's defaults": (DQN, cart_pole, 8100),
    }
    table = Table("", *(monitor.__name__ for monitor in MONITORS), title="Processor time beside that of the rest of training")
    for name, (algorithm, settings, n_steps) in trainings.items():
        table.add_row(name, *(f"{cost(algorithm, settings, monitor(), n_steps):.1%}" for monitor in MONITORS))
    Console().print(table)


if __name__ == "__main__":
    main()
