"""
What the callbacks cost that look at training, each with its defaults: the processor time spent in them as a share of that of
the rest of the same training. Two trainings, with and without, differ by more than that on a machine that does other things.
"""

from typing import Any

from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks.speed.big_rollout import N_ENVS, N_STEPS, in_process, peak_memory, with_rollout
from benchmarks.speed.settings import model_settings
from benchmarks.speed.tables import Table
from benchmarks.speed.time_inside import TimeInside
from benchmarks.speed.timing import seconds
from sb3_cchain import ChurnMonitor
from sb3_cchain.analysis import NetworkHealth, NTKCallback
from sb3_cchain.analysis.ntk import policy_ntk

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


def ntk_of_impala() -> tuple[float, float]:
    """
    :return: Seconds of one NTK of the IMPALA network, and the greatest resident memory of this process in GB
    """
    model = with_rollout(PPO, "ppo", batch_size=128)
    return seconds(lambda: policy_ntk(model, n_minibatches=100)), peak_memory()


def monitor_table() -> Table:
    """
    :return: For each training, the share of each monitor
    """
    minatar = model_settings("dqn", "Continual/MinAtar-v0", buffer_size=20_000, learning_starts=400)
    cart_pole = dict(policy="MlpPolicy", env="CartPole-v1", seed=0, device="cpu")
    # Five iterations of PPO; as many updates of DQN as are between two looks
    trainings: dict[str, tuple[type[BaseAlgorithm], dict[str, Any], int]] = {
        "PPO, Gym Control (3 × 256 units)": (PPO, model_settings("ppo", "Continual/Acrobot-v1"), 4000),
        "PPO, CartPole, SB3's defaults": (PPO, cart_pole, 10_240),
        "DQN, MinAtar": (DQN, minatar, 2400),
        "DQN, CartPole, SB3's defaults": (DQN, cart_pole, 8100),
    }
    rows = []
    for name, (algorithm, settings, n_steps) in trainings.items():
        costs = [cost(algorithm, settings, monitor(), n_steps) for monitor in MONITORS]
        rows.append([name, *(f"{100 * inside / rest:.1f} %" for inside, rest in costs)])
    ntk_seconds, memory = in_process(ntk_of_impala)
    note = (
        f"One NTK of the IMPALA network (m = 100) with a rollout of {N_ENVS} × {N_STEPS} steps takes {ntk_seconds:.0f} "
        f"seconds; the process needs {memory:.1f} GB at most."
    )
    return Table(["", *(f"`{monitor.__name__}`" for monitor in MONITORS)], rows, note)
