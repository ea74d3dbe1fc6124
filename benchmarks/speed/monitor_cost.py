"""
What the callbacks cost that look at training, each with its defaults: the processor time spent in them as a share of that of
the rest of the same training. Two trainings, with and without, differ by more than that on a machine that does other things.

    python -m benchmarks.speed.monitor_cost
    python -m benchmarks.speed.monitor_cost --impala   # one NTK of the IMPALA network, of 100 minibatches of 64 x 256 steps
"""

import argparse
import resource
from typing import Any

import torch as th
from rich.console import Console
from rich.table import Table
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv

from benchmarks.speed.cases import model_settings
from benchmarks.speed.time_inside import TimeInside
from benchmarks.speed.timing import seconds
from sb3_cchain import ChurnMonitor
from sb3_cchain.analysis import NetworkHealth, NTKCallback
from sb3_cchain.networks.impala_policy import ImpalaPolicy

MONITORS: list[type[BaseCallback]] = [ChurnMonitor, NTKCallback, NetworkHealth]

# The methods in which monitors work: events of a callback, and hooks on optimisers
ENTRANCES = ("_on_rollout_start", "_on_rollout_end", "_on_step", "_before_update", "_before_step")


def cost(algorithm: type[BaseAlgorithm], settings: dict[str, Any], monitor: BaseCallback, n_steps: int) -> tuple[float, float]:
    """
    :param algorithm: Algorithm
    :param settings: Its arguments
    :param monitor: The callback
    :param n_steps: Environment steps to train for
    :return: Seconds of processor time in the callback, and in the rest of the training
    """
    inside = TimeInside()
    inside.watch(monitor, *(name for name in ENTRANCES if hasattr(monitor, name)))
    model = algorithm(**settings)
    total = seconds(lambda: model.learn(n_steps, callback=monitor))
    return inside.seconds, total - inside.seconds


def impala() -> str:
    """
    :return: What one NTK of the IMPALA network costs, as a sentence. The rollout is of random images in ProcGen's shape
    """
    env = make_vec_env(FakeImageEnv, 64, seed=0, env_kwargs=dict(screen_height=64, screen_width=64, n_channels=3))
    settings = dict(policy=ImpalaPolicy, env=env, n_steps=256, batch_size=1024, n_epochs=1, seed=0, device="cpu")
    inside, _ = cost(PPO, settings, NTKCallback(), 64 * 256)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    return f"The NTK of the IMPALA network: {inside:.0f} s of processor time; the process needed {memory:.1f} GB at most."


def main() -> None:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--impala", action="store_true", help="Of the IMPALA network, once")
    args = parser.parse_args()
    th.set_num_threads(1)
    if args.impala:
        print(impala())
        return
    minatar = model_settings("dqn", "Continual/MinAtar-v0", buffer_size=20_000, learning_starts=400)
    cart_pole = dict(policy="MlpPolicy", env="CartPole-v1", seed=0, device="cpu")
    # Ten iterations of PPO; as many updates of DQN as are between two looks
    trainings: dict[str, tuple[type[BaseAlgorithm], dict[str, Any], int]] = {
        "PPO, Gym Control": (PPO, model_settings("ppo", "Continual/Acrobot-v1"), 8000),
        "PPO, CartPole, SB3's defaults": (PPO, cart_pole, 20_480),
        "DQN, MinAtar": (DQN, minatar, 2400),
        "DQN, CartPole, SB3's defaults": (DQN, cart_pole, 8100),
    }
    table = Table("", *(monitor.__name__ for monitor in MONITORS), title="Processor time beside that of the rest of training")
    for name, (algorithm, settings, n_steps) in trainings.items():
        costs = [cost(algorithm, settings, monitor(), n_steps) for monitor in MONITORS]
        table.add_row(name, *(f"{inside / rest:.1%}" for inside, rest in costs))
    Console().print(table)


if __name__ == "__main__":
    main()
