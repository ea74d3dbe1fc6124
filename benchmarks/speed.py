"""
What churn reduction costs: the base algorithm, C-CHAIN, and the loop that copies the network at every minibatch, timed in turn
in one process under the shipped settings. Prints ratios, so that the machine's own speed drops out, and how many times as many
floating-point operations are needed.

    python -m benchmarks.speed
    python -m benchmarks.speed --case minatar procgen
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch as th
from rich.console import Console
from rich.progress import track
from rich.table import Table
from rl_zoo3.utils import get_class_by_name
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.deepcopy_dqn import DeepCopyDQN
from benchmarks.deepcopy_ppo import DeepCopyPPO
from benchmarks.runs import shipped_hyperparameters
from sb3_cchain import CChainDQN, CChainPPO, DoubleDQN
from sb3_cchain.methods import (
    TRAC,
    AdamRel,
    L2Init,
    OptimizerMetrics,
    OptimizerWrapper,
    Oracle,
    Parseval,
    ReDo,
    ShrinkAndPerturb,
    WeightClipping,
)
from sb3_cchain.networks import CReLU, CReLUPolicy, LayerNormPolicy

# What RL Zoo takes out of the hyperparameters before it makes the model
NOT_THE_MODELS = {"callback", "env_wrapper", "vec_env_wrapper", "normalize", "monitor_kwargs", "n_timesteps"}


@dataclass
class Case:
    """
    Models under the same settings, and what is timed of each.

    :param title: What it stands for
    :param models: By name
    :param measures: By name, calls on a model
    :param pairs: Names of models whose seconds are divided by each other
    """

    title: str
    models: dict[str, Any]
    measures: dict[str, Callable[[Any], Any]]
    pairs: list[tuple[str, str]]


def pairs_of(base: str, ours: str) -> list[tuple[str, str]]:
    """
    :param base: Name of the base algorithm
    :param ours: Name of it with churn reduction
    :return: The pairs of these two and the loop that copies the network
    """
    return [(ours, base), (ours, "deep copy"), ("deep copy", base)]


def settings_of(algo: str, env_id: str, **changed: Any) -> dict[str, Any]:
    """
    :param algo: Name of a file of hyperparameters
    :param env_id: Environment id
    :param changed: What shall differ
    :return: The model's arguments in the shipped hyperparameters
    """
    shipped = shipped_hyperparameters(algo, env_id) or {}
    settings = {name: value for name, value in shipped.items() if name not in NOT_THE_MODELS}
    # As RL Zoo reads it
    if "policy_kwargs" in settings:
        settings["policy_kwargs"] = eval(settings["policy_kwargs"], {"nn": nn, "get_class_by_name": get_class_by_name})
    if "." in settings["policy"]:
        settings["policy"] = get_class_by_name(settings["policy"])
    return {**settings, "env": env_id, "seed": 0, "device": "cpu", **changed}


def ppo(env_id: str, **changed: Any) -> Case:
    """
    :param env_id: Environment id
    :param changed: What shall differ from the shipped settings
    :return: PPO under the settings of that environment
    """
    settings = settings_of("ppo", env_id, **changed)
    models = {"PPO": PPO(**settings), "CChainPPO": CChainPPO(**settings), "deep copy": DeepCopyPPO(**settings)}
    for model in models.values():
        model.learn(2 * model.n_steps)  # warm; every later update has a churn loss
    return Case(
        f"{env_id} {changed or ''}",
        models,
        {
            "train()": lambda model: model.train(),
            "iteration (rollout and train)": lambda model: model.learn(model.n_steps, reset_num_timesteps=False),
        },
        pairs_of("PPO", "CChainPPO"),
    )


def related() -> Case:
    """
    :return: PPO under the Gym Control settings with each of the related methods
    """
    settings = settings_of("ppo", "Continual/Acrobot-v1")
    adam = settings["policy_kwargs"].pop("optimizer_kwargs")

    def make(*callbacks: BaseCallback, algorithm: type[PPO] = PPO, policy: Any = "MlpPolicy", **policy_kwargs: Any) -> Any:
        policy_kwargs = {"optimizer_kwargs": adam, **settings["policy_kwargs"], **policy_kwargs}
        return algorithm(**{**settings, "policy": policy, "policy_kwargs": policy_kwargs}), [*callbacks]

    def make_with(optimizer_class: type[OptimizerWrapper], **kwargs: Any) -> Any:
        optimizer_kwargs = {"base_kwargs": adam, **kwargs}
        return make(OptimizerMetrics(), optimizer_class=optimizer_class, optimizer_kwargs=optimizer_kwargs)

    # Each with the callbacks that it learns with
    models = {
        "PPO": make(),
        "C-CHAIN": make(algorithm=CChainPPO),
        "TRAC": make_with(TRAC),
        "weight clipping": make_with(WeightClipping),
        "L2 Init": make_with(L2Init),
        "Parseval": make_with(Parseval, n_output_layers=2),
        "AdamRel": make(AdamRel()),
        "Oracle": make(Oracle()),
        "ReDo every iteration": make(ReDo(interval=1)),
        "shrink-and-perturb every update": make(ShrinkAndPerturb()),
        "LayerNorm": make(policy=LayerNormPolicy),
        "CReLU": make(policy=CReLUPolicy, activation_fn=CReLU),
    }

    # Callbacks act around train(), some only between the iterations of a learn(). No task switches in between.
    def iterations(made: Any) -> None:
        model, callbacks = made
        model.learn(5 * model.n_steps, callback=callbacks, reset_num_timesteps=False)

    for made in models.values():
        iterations(made)
    return Case(
        "Continual/Acrobot-v1, related methods",
        models,
        {"5 iterations": iterations},
        [(name, "PPO") for name in models if name != "PPO"],
    )


def minatar(n_past_updates: int = 0) -> Case:
    """
    :param n_past_updates: Updates that count as made before, for what the running means go over
    :return: Double DQN under the MinAtar settings: a small convolutional network, minibatches of 32
    """
    settings = settings_of("double_dqn", "Continual/MinAtar-v0", buffer_size=20_000, learning_starts=1000)
    models: dict[str, Any] = {"DoubleDQN": DoubleDQN(**settings), "CChainDQN": CChainDQN(**settings)}
    models["deep copy"] = DeepCopyDQN(**{name: value for name, value in settings.items() if name not in ("double_q", "loss")})
    for model in models.values():
        model.learn(1200)
    for _ in range(n_past_updates):
        models["CChainDQN"].churn_reducer.coefficient.update(0.01, 1e-6)
        models["deep copy"].td_losses.append(0.01)
        models["deep copy"].churn_losses.append(1e-6)
    return Case(
        "Continual/MinAtar-v0" + (f" after {n_past_updates} updates" if n_past_updates else ""),
        models,
        {
            "100 × train()": lambda model: [model.train(gradient_steps=1, batch_size=32) for _ in range(100)],
            "100 environment steps, an update each": lambda model: model.learn(100, reset_num_timesteps=False),
        },
        pairs_of("DoubleDQN", "CChainDQN"),
    )


CASES: dict[str, Callable[[], Case]] = {
    "gym_control": partial(ppo, "Continual/Acrobot-v1"),
    # One epoch, as a round would take minutes
    "procgen": partial(ppo, "Continual/Starpilot-v0", n_epochs=1),
    "dmc": partial(ppo, "Continual/Walker-v0", n_epochs=1),
    "related": related,
    "minatar": minatar,
    "minatar_later": partial(minatar, n_past_updates=50_000),
}


def seconds(call: Callable[[], Any]) -> float:
    """
    :param call: What to time
    :return: Seconds of processor time: of one thread, they are what it takes on a machine that does nothing else
    """
    start = time.process_time()
    call()
    return time.process_time() - start


def n_operations(call: Callable[[], Any]) -> int:
    """
    :param call: What to count
    :return: Floating-point operations of its matrix products and convolutions
    """
    with FlopCounterMode(display=False) as counter:
        call()
    return counter.get_total_flops()


def ratios(case: Case, n_rounds: int) -> Table:
    """
    :param case: What to time
    :param n_rounds: Timings of each
    :return: Ratios of the seconds within a round, and of the operations of the first measure
    """
    title = f"{case.title}, {n_rounds} rounds, one thread"
    table = Table("", "ratio", "median", "min", "max", title=title)
    for measure, call in case.measures.items():
        rounds = [
            {name: seconds(partial(call, model)) for name, model in case.models.items()}
            for _ in track(range(n_rounds), description=measure)
        ]
        for one, other in case.pairs:
            figures = [timing[one] / timing[other] for timing in rounds]
            table.add_row(measure, f"{one} / {other}", *(f"{f(figures):.2f}" for f in (np.median, np.min, np.max)))
    measure, call = next(iter(case.measures.items()))
    one, other = case.pairs[0]
    needed, of_base = (n_operations(partial(call, case.models[name])) for name in (one, other))
    table.caption = f"Floating-point operations of {one} / {other}, {measure}: {needed / of_base:.2f}"
    return table


def main() -> None:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", nargs="+", default=list(CASES), choices=list(CASES), help="What to time")
    parser.add_argument("--rounds", type=int, default=20, help="Timings of each")
    args = parser.parse_args()
    th.set_num_threads(1)
    for name in args.case:
        Console().print(ratios(CASES[name](), args.rounds))


if __name__ == "__main__":
    main()
