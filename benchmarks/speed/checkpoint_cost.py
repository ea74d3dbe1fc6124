"""What it costs to save a whole training, and to go on from it."""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecMonitor

from benchmarks.grid.suites import SUITES
from benchmarks.number_text import thousands
from benchmarks.speed.settings import model_settings
from benchmarks.speed.tables import Table
from sb3_cchain import CChainDQN, CChainPPO, TrainingCheckpoint
from sb3_cchain.checkpoint import find_checkpoint, load_model
from sb3_cchain.envs import ContinualProcgenVecEnv, TaskVecNormalize


class TimedCheckpoint(TrainingCheckpoint):
    """Takes note of how long it takes to save and to put back."""

    def __init__(self, save_freq: int, path: Path):
        super().__init__(save_freq, path)
        self.save_seconds: list[float] = []
        self.save_processor_seconds: list[float] = []
        self.restore_seconds = 0.0

    def _on_rollout_start(self) -> None:
        is_resumed, start = self._resumed is not None, time.perf_counter()
        super()._on_rollout_start()
        if is_resumed:
            self.restore_seconds = time.perf_counter() - start

    def _save(self) -> Path:
        start, processor_start = time.perf_counter(), time.process_time()
        path = super()._save()
        self.save_seconds.append(time.perf_counter() - start)
        self.save_processor_seconds.append(time.process_time() - processor_start)
        return path


def gym_control(env_id: str) -> BaseAlgorithm:
    """
    :param env_id: A continual environment of Gym Control
    :return: CChainPPO under its shipped settings
    """
    return CChainPPO(**model_settings("ppo_cchain", env_id))


def dmc() -> BaseAlgorithm:
    """
    :return: CChainPPO under the shipped settings of continual Walker, with normalisation
    """
    settings = model_settings("ppo_cchain", "Continual/Walker-v0")
    return CChainPPO(**{**settings, "env": TaskVecNormalize(make_vec_env(settings["env"]))})


def procgen() -> BaseAlgorithm:
    """
    :return: CChainPPO with the IMPALA network under the shipped settings of continual Starpilot, but for shorter rollouts
    """
    settings = model_settings("ppo_cchain", "Continual/Starpilot-v0", n_steps=16)
    return CChainPPO(**{**settings, "env": VecMonitor(ContinualProcgenVecEnv("starpilot", n_envs=64))})


def minatar() -> BaseAlgorithm:
    """
    :return: CChainDQN under the shipped settings of continual MinAtar, which fills its replay buffer and does not learn
    """
    return CChainDQN(**model_settings("dqn_cchain", "Continual/MinAtar-v0", learning_starts=10**9))


# Name, what makes the environment and the model, environment steps between checkpoints, number of checkpoints
CASES: list[tuple[str, Callable[[], BaseAlgorithm], int, int]] = [
    ("Acrobot, PPO with 3 × 256", partial(gym_control, "Continual/Acrobot-v1"), 800, 5),
    ("LunarLander, the same; episodes are replayed", partial(gym_control, "Continual/LunarLander-v3"), 800, 5),
    ("Walker, PPO with normalisation", dmc, 2048, 3),
    ("Starpilot, PPO with IMPALA and 64 environments", procgen, 1024, 3),
    ("MinAtar, DQN, 100 000 transitions, 20 000 of them new", minatar, 20_000, 5),
]


def checkpoint_table() -> Table:
    """
    :return: For some trainings, the size of a checkpoint and how long it takes to save it and to put it back
    """
    note = (
        "Wall time of the last checkpoint. `replay buffer` is what its pieces take on the disk, compressed; in memory, the "
        "observations of 100 000 transitions have 200 MB."
    )
    header = ["", "checkpoint", "replay buffer", "to save", "to put back"]
    return Table(header, [[name, *measure(make, *times)] for name, make, *times in CASES], note)


# Name, what makes the environment and the model, suite of the grid, environment steps of training that are timed
SHARES: list[tuple[str, Callable[[], BaseAlgorithm], str, int]] = [
    ("Acrobot", partial(gym_control, "Continual/Acrobot-v1"), "gym_control", 2400),
    ("Walker", dmc, "dmc", 4096),
    ("Starpilot", procgen, "procgen", 2048),
    ("MinAtar, with a full replay buffer", minatar, "minatar", 2000),
]


def share_table() -> Table:
    """
    :return: For a run of each suite, the share of its time that it takes to save it as often as the grid does
    """
    note = (
        "Processor time. `steps` are those from one checkpoint to the next, `training` is what they take. A disk that is busy "
        "makes it longer."
    )
    header = ["", "steps", "training", "to save", "share"]
    return Table(header, [[name, *measure_share(make, suite, steps)] for name, make, suite, steps in SHARES], note)


def measure_share(make: Callable[[], BaseAlgorithm], suite: str, n_steps: int) -> list[str]:
    """
    :param make: Makes the model with its environment
    :param suite: Its suite of the grid
    :param n_steps: Environment steps of training that are timed
    :return: Environment steps from one checkpoint to the next, seconds to train for them and to save, the share of the latter
    """
    save_freq, model = SUITES[suite].checkpoint_freq, make()
    with TemporaryDirectory() as folder:
        if isinstance(model, DQN):
            saving = TimedCheckpoint(save_freq, Path(folder))
            model.learn(model.buffer_size + save_freq + 1, saving)  # fills the buffer, and does not learn
            model.learning_starts, saved = 0, saving.save_processor_seconds[-1]
            start, before = time.process_time(), model.num_timesteps
            model.learn(n_steps, reset_num_timesteps=False)
            training = time.process_time() - start
        else:
            saving = TimedCheckpoint(n_steps, Path(folder))
            start, before = time.process_time(), 0
            model.learn(2 * n_steps + 1, saving)
            training = time.process_time() - start - sum(saving.save_processor_seconds)
            saved = saving.save_processor_seconds[-1]
    training *= save_freq / (model.num_timesteps - before)
    return [thousands(save_freq), f"{training:.0f} s", f"{saved:.2f} s", f"{100 * saved / (training + saved):.2f} %"]


def measure(make: Callable[[], BaseAlgorithm], save_freq: int, n_saves: int) -> list[str]:
    """
    :param make: Makes the model with its environment
    :param save_freq: Environment steps between checkpoints
    :param n_saves: Number of checkpoints
    :return: Sizes of the checkpoint and the replay buffer, seconds to save and to put back
    """
    with TemporaryDirectory() as folder:
        saving = TimedCheckpoint(save_freq, Path(folder))
        make().learn(save_freq * n_saves + 1, callback=saving)
        checkpoint = find_checkpoint(folder)
        env = make().env
        assert env is not None
        restoring = TimedCheckpoint(10**9, Path(folder))
        restoring.go_on_from(checkpoint)
        load_model(checkpoint, env).learn(1, callback=restoring, reset_num_timesteps=False)
        sizes = [disk_size(checkpoint.path), disk_size(checkpoint.store.folder)]
    times = [saving.save_seconds[-1], restoring.restore_seconds]
    return [*(f"{size / 1e6:.1f} MB" if size else "" for size in sizes), *(f"{seconds:.2f} s" for seconds in times)]


def disk_size(folder: Path) -> int:
    """
    :param folder: A folder
    :return: Bytes of all files in it
    """
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
