"""
What churn reduction costs: PPO, CChainPPO, and the loop that copies the network at every minibatch, timed in turn in one
process under the Gym Control settings. Prints ratios; the machine's own speed drops out.

    python -m benchmarks.speed
"""

import argparse
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch as th
import yaml
from rich.console import Console
from rich.progress import track
from rich.table import Table
from stable_baselines3 import PPO
from torch import nn

from benchmarks.deepcopy_ppo import DeepCopyPPO
from sb3_cchain import CChainPPO
from sb3_cchain.zoo import hyperparams_folder

ENV_ID = "Continual/Acrobot-v1"
PPO_ARGUMENTS = (
    *("policy", "n_steps", "batch_size", "n_epochs", "learning_rate", "gamma", "gae_lambda", "clip_range"),
    *("ent_coef", "vf_coef", "max_grad_norm", "normalize_advantage", "policy_kwargs"),
)


def gym_control_settings() -> dict[str, Any]:
    """
    :return: PPO's arguments in the shipped hyperparameters
    """
    settings = yaml.safe_load((hyperparams_folder() / "ppo.yml").read_text())[ENV_ID]
    arguments = {name: settings[name] for name in PPO_ARGUMENTS}
    # As RL Zoo reads it
    return {**arguments, "policy_kwargs": eval(arguments["policy_kwargs"], {"nn": nn})}


def seconds(call: Callable[[], Any]) -> float:
    """
    :param call: What to time
    :return: Wall-clock seconds
    """
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def main() -> None:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20, help="Timings of each")
    args = parser.parse_args()
    th.set_num_threads(1)

    settings = gym_control_settings()
    models: dict[str, PPO] = {
        "PPO": PPO(env=ENV_ID, seed=0, device="cpu", **settings),
        "CChainPPO": CChainPPO(env=ENV_ID, seed=0, device="cpu", **settings),
        "deep copy": DeepCopyPPO(env=ENV_ID, seed=0, device="cpu", **settings),
    }
    for model in models.values():
        model.learn(2 * model.n_steps)  # warm; every later update has a churn loss

    measures: dict[str, Callable[[PPO], Any]] = {
        "train()": lambda model: model.train(),
        "iteration (rollout and train)": lambda model: model.learn(model.n_steps, reset_num_timesteps=False),
    }
    table = Table("", "ratio", "median", "min", "max", title=f"{ENV_ID}, {args.rounds} rounds, one thread")
    for measure, call in measures.items():
        rounds = [
            {name: seconds(partial(call, model)) for name, model in models.items()}
            for _ in track(range(args.rounds), description=measure)
        ]
        for over in ("PPO", "deep copy"):
            ratios = [timing["CChainPPO"] / timing[over] for timing in rounds]
            figures = [f"{statistic(ratios):.2f}" for statistic in (np.median, np.min, np.max)]
            table.add_row(measure, f"CChainPPO / {over}", *figures)
        ratios = [timing["deep copy"] / timing["PPO"] for timing in rounds]
        table.add_row(measure, "deep copy / PPO", *(f"{f(ratios):.2f}" for f in (np.median, np.min, np.max)))
    Console().print(table)


if __name__ == "__main__":
    main()
