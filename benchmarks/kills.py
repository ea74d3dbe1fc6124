"""
Kills training with kill -9 at random moments, lets it go on from its checkpoints each time, and compares the end with training
that nobody killed.

    python -m benchmarks.kills --kills 100
"""

import argparse
import hashlib
import multiprocessing
import os
import pickle
import random
import signal
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import torch as th
import torch._dynamo  # PyTorch's optimisers import it when they are made, which takes longer than most processes here live
from rich.console import Console
from rich.progress import track
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecEnv

from sb3_cchain import CChainDQN, CChainPPO, ContinualMetrics, TrainingCheckpoint, resume
from sb3_cchain.checkpoint import find_checkpoint, has_checkpoint


def make_env() -> VecEnv:
    """
    :return: The environment of all trainings here
    """
    return make_vec_env("Continual/Acrobot-v1", 2, seed=0, env_kwargs={"steps_per_task": 3000, "n_tasks": 20})


def make_ppo() -> BaseAlgorithm:
    """
    :return: On-policy: a checkpoint is small
    """
    return CChainPPO("MlpPolicy", make_env(), n_steps=64, batch_size=32, seed=0, device="cpu")


def make_dqn() -> BaseAlgorithm:
    """
    :return: Off-policy: a checkpoint holds a replay buffer
    """
    return CChainDQN("MlpPolicy", make_env(), buffer_size=100_000, learning_starts=500, train_freq=16, seed=0, device="cpu")


ALGORITHMS: dict[str, Callable[[], BaseAlgorithm]] = {"ppo": make_ppo, "dqn": make_dqn}


def train(algorithm: str, n_steps: int, save_freq: int, folder: Path) -> None:
    """
    Begin training, or go on with it, to its end, and write down what it led to.

    :param algorithm: Key of ``ALGORITHMS``
    :param n_steps: Environment steps
    :param save_freq: Environment steps between checkpoints
    :param folder: Of everything that it writes
    """
    warnings.simplefilter("ignore")  # of older checkpoints that are taken: those are counted below
    checkpoints, callback = folder / "checkpoints", ContinualMetrics(folder / "returns.csv")
    logger = configure(str(folder), [])
    if has_checkpoint(checkpoints):
        model = resume(checkpoints, make_env(), [callback], logger=logger)
    else:
        model = ALGORITHMS[algorithm]()
        model.set_logger(logger)
        model.learn(n_steps, [callback, TrainingCheckpoint(save_freq, checkpoints)])
    (folder / "end").write_text(digest(model, folder / "returns.csv"))


def digest(model: BaseAlgorithm, returns: Path) -> str:
    """
    :param model: A trained model
    :param returns: Its file of returns
    :return: A hash of the parameters, the optimisers, λ's history, the last observations and the returns
    """
    content = hashlib.sha256(returns.read_bytes())
    state = {**model.get_parameters(), "churn": model.churn_state.as_dict(), "last": model._last_obs}  # type: ignore[attr-defined]
    content.update(pickle.dumps(_arrays(state)))
    return content.hexdigest()


def _arrays(value: object) -> object:
    """The same with arrays in place of tensors, whose pickles depend on more than their values."""
    if isinstance(value, th.Tensor):
        return value.numpy().tobytes()
    if isinstance(value, dict):
        return {key: _arrays(entry) for key, entry in value.items()}
    return [_arrays(entry) for entry in value] if isinstance(value, (list, tuple)) else value


def main(arguments: Sequence[str] | None = None) -> int:
    """
    :param arguments: Arguments of the command line
    :return: Exit code: 1 when a killed training did not end as the other
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algo", nargs="+", default=list(ALGORITHMS), choices=list(ALGORITHMS), help="What is trained")
    parser.add_argument("--kills", type=int, default=100, help="How often each training is killed")
    parser.add_argument("--steps", type=int, default=60_000, help="Environment steps of a training")
    parser.add_argument("--save-freq", type=int, default=128, help="Environment steps between checkpoints")
    parser.add_argument("--longest", type=float, default=3.0, help="Seconds after which it is killed at the latest")
    parser.add_argument("--seed", type=int, default=0, help="Of the moments")
    args = parser.parse_args(arguments)
    th.set_num_threads(1)
    console, failed = Console(), False
    for algorithm in args.algo:
        with TemporaryDirectory() as folder:
            failed |= not compare(algorithm, args, Path(folder), console)
    return int(failed)


def compare(algorithm: str, args: argparse.Namespace, folder: Path, console: Console) -> bool:
    """
    :param algorithm: Key of ``ALGORITHMS``
    :param args: Arguments of the command line
    :param folder: For everything that is written
    :param console: Where the outcome is shown
    :return: Whether the killed training ended as the other
    """
    # Forked, because importing everything would take longer than the lives of most processes
    context, moments = multiprocessing.get_context("fork"), random.Random(args.seed)
    whole, killed = folder / "whole", folder / "killed"
    settings = (args.steps, args.save_freq)
    undisturbed = context.Process(target=train, args=(algorithm, *settings, whole))
    undisturbed.start()
    undisturbed.join()
    n_kills, n_damaged, n_restarts = 0, 0, 0
    for _ in track(range(args.kills), f"{algorithm}: kills", console=console):
        process = context.Process(target=train, args=(algorithm, *settings, killed))
        process.start()
        process.join(moments.uniform(0.0, args.longest))
        if process.exitcode is not None:
            break
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        n_kills += 1
        n_restarts += not has_checkpoint(killed / "checkpoints")
        n_damaged += damaged(killed / "checkpoints")
    last = context.Process(target=train, args=(algorithm, *settings, killed))
    last.start()
    last.join()
    same = (whole / "end").read_text() == (killed / "end").read_text()
    console.print(
        f"{algorithm}: {n_kills} kills, {n_restarts} of them before the first checkpoint, {n_damaged} damaged checkpoints, "
        f"the end is {'the same to the bit' if same else 'another'}"
    )
    return same and n_damaged == 0


def damaged(checkpoints: Path) -> int:
    """
    :param checkpoints: A folder of checkpoints whose training was killed
    :return: How many of its checkpoints are not whole
    """
    found = 0
    for path in checkpoints.glob("step_*"):
        try:
            find_checkpoint(path)
        except ValueError as error:
            print(error)
            found += 1
    return found


if __name__ == "__main__":
    sys.exit(main())
