"""What is timed: models under the same shipped settings."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from rl_zoo3.utils import get_class_by_name
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn

from benchmarks.grid.run import shipped_hyperparameters
from benchmarks.speed.deepcopy_dqn import DeepCopyDQN
from benchmarks.speed.deepcopy_ppo import DeepCopyPPO
from sb3_cchain import CChainDQN, CChainPPO, DoubleDQN
from sb3_cchain.methods import ReDo
from sb3_cchain.methods.registry import BY_ALGO, REGISTRY, Method

# What RL Zoo takes out of the hyperparameters before it makes the model
NOT_MODEL_ARGUMENTS = {"callback", "env_wrapper", "vec_env_wrapper", "normalize", "monitor_kwargs", "n_timesteps"}


# Methods that by default act less often than once in what is timed, so that they would seem to cost nothing
EACH_ITERATION: dict[type[BaseCallback], dict[str, Any]] = {ReDo: {"interval": 1}}


@dataclass
class Case:
    """
    Models under the same settings, and what is timed of each.

    :param title: Human-readable name
    :param models: By name
    :param measures: By name, what is timed: a call on a model
    :param pairs: Names of models whose seconds are divided by each other
    """

    title: str
    models: dict[str, Any]
    measures: dict[str, Callable[[Any], Any]]
    pairs: list[tuple[str, str]]


def churn_pairs(base: str, cchain: str) -> list[tuple[str, str]]:
    """
    :param base: Name of the base algorithm
    :param cchain: Name of the same with churn reduction
    :return: The pairs of these two and the loop that copies the network
    """
    return [(cchain, base), (cchain, "deep copy"), ("deep copy", base)]


def model_settings(algo: str, env_id: str, **changed: Any) -> dict[str, Any]:
    """
    :param algo: Name of a file of hyperparameters
    :param env_id: Environment id
    :param changed: Arguments that differ
    :return: The model's arguments, from the shipped hyperparameters
    """
    shipped = shipped_hyperparameters(algo, env_id) or {}
    settings = {name: value for name, value in shipped.items() if name not in NOT_MODEL_ARGUMENTS}
    # As RL Zoo reads it
    if "policy_kwargs" in settings:
        settings["policy_kwargs"] = eval(settings["policy_kwargs"], {"nn": nn, "get_class_by_name": get_class_by_name})
    if "." in settings["policy"]:
        settings["policy"] = get_class_by_name(settings["policy"])
    return {**settings, "env": env_id, "seed": 0, "device": "cpu", **changed}


def ppo(env_id: str, **changed: Any) -> Case:
    """
    :param env_id: Environment id
    :param changed: Arguments that differ from the shipped settings
    :return: PPO under the settings of that environment
    """
    settings = model_settings("ppo", env_id, **changed)
    cchain = CChainPPO(**model_settings("ppo_cchain", env_id, **changed))
    models = {"PPO": PPO(**settings), "CChainPPO": cchain, "deep copy": DeepCopyPPO(**settings)}
    for model in models.values():
        model.learn(2 * model.n_steps)  # warm; every later update has a churn loss
    return Case(
        f"{env_id} {changed or ''}",
        models,
        {
            "train()": lambda model: model.train(),
            "iteration (rollout and train)": lambda model: model.learn(model.n_steps, reset_num_timesteps=False),
        },
        churn_pairs("PPO", "CChainPPO"),
    )


def related() -> Case:
    """
    :return: PPO under the Gym Control settings with each of the methods of the registry that are settings of PPO, and C-CHAIN
    """
    settings = model_settings("ppo", "Continual/Acrobot-v1")
    adam = settings["policy_kwargs"].pop("optimizer_kwargs")

    def make(method: Method) -> tuple[Any, list[BaseCallback]]:
        policy_kwargs = {"optimizer_kwargs": adam, **settings["policy_kwargs"], **method.policy_kwargs}
        if method.optimizer_class is not None:
            optimizer_kwargs = {"base_kwargs": adam, **method.optimizer_kwargs}
            policy_kwargs |= {"optimizer_class": method.optimizer_class, "optimizer_kwargs": optimizer_kwargs}
        model = method.algorithm(**{**settings, "policy": method.policy, "policy_kwargs": policy_kwargs})
        # Each with the callbacks that it learns with
        return model, [callback(**EACH_ITERATION.get(callback, {})) for callback in method.callbacks]

    models = {method.label: make(method) for method in REGISTRY if issubclass(method.algorithm, PPO)}
    vanilla = BY_ALGO["ppo"].label

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
        [(name, vanilla) for name in models if name != vanilla],
    )


def minatar(n_past_updates: int = 0) -> Case:
    """
    :param n_past_updates: Updates that the running means already hold
    :return: Double DQN under the MinAtar settings: a small convolutional network, minibatches of 32
    """
    changed = {"buffer_size": 20_000, "learning_starts": 1000}
    settings = model_settings("double_dqn", "Continual/MinAtar-v0", **changed)
    cchain = CChainDQN(**model_settings("dqn_cchain", "Continual/MinAtar-v0", **changed))
    models: dict[str, Any] = {"DoubleDQN": DoubleDQN(**settings), "CChainDQN": cchain}
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
        churn_pairs("DoubleDQN", "CChainDQN"),
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
