"""Where the time of an update goes, with and without churn reduction."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from math import ceil
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm

from benchmarks.speed.settings import model_settings
from benchmarks.speed.tables import Table
from benchmarks.speed.time_inside import TimeInside
from benchmarks.speed.timing import seconds
from sb3_cchain import CChainDQN, CChainPPO, DoubleDQN, make_lean
from sb3_cchain.algorithms import on_policy, reference_passes
from sb3_cchain.replaced import replaced

FORWARD, BACKWARD, CLIP, ADAM = "forward passes", "backward pass", "`clip_grad_norm_`", "Adam's step"
REFERENCE = "outputs on the reference batch before the update"
PARTS = (FORWARD, BACKWARD, CLIP, ADAM, REFERENCE)


def methods(model: BaseAlgorithm) -> list[tuple[str, Any, str]]:
    """
    :param model: A PPO or DQN model
    :return: Part, owner and name of the methods and functions that are the parts of its update, without ``REFERENCE``
    """
    same_for_all = [
        (BACKWARD, th.Tensor, "backward"),
        (CLIP, th.nn.utils, "clip_grad_norm_"),
        (ADAM, model.policy.optimizer, "step"),
    ]
    if isinstance(model, DoubleDQN):
        return [*same_for_all, (FORWARD, model.q_net, "forward"), (FORWARD, model.q_net_target, "forward")]
    if isinstance(model, CChainPPO):
        # It puts this in the place of `policy.evaluate_actions()`
        return [*same_for_all, (FORWARD, reference_passes, "evaluate_jointly")]
    return [*same_for_all, (FORWARD, model.policy, "evaluate_actions")]


@contextmanager
def watched(model: BaseAlgorithm) -> Iterator[dict[str, TimeInside]]:
    """
    :param model: A model
    :return: The time inside each of ``PARTS``, while the ``with`` block lasts
    """
    inside = {part: TimeInside() for part in PARTS}
    extra_gradient = on_policy.extra_gradient

    def timed_extra_gradient(optimizer: th.optim.Optimizer, backward: Callable[[], None]) -> Any:
        holder = type("Holder", (), {"backward": staticmethod(backward)})()
        inside[REFERENCE].watch(holder, "backward")
        return extra_gradient(optimizer, holder.backward)

    with ExitStack() as stack:
        stack.enter_context(replaced(on_policy, "extra_gradient", timed_extra_gradient))
        for part, owner, name in methods(model):
            stack.enter_context(replaced(owner, name, getattr(owner, name)))  # put back afterwards
            inside[part].watch(owner, name)
        yield inside


def parts_of_an_update(model: BaseAlgorithm, train: Callable[[], Any], n_updates: int) -> dict[str, float]:
    """
    :param model: A model
    :param train: Its ``train()``
    :param n_updates: How many updates that makes
    :return: Seconds of processor time in each part of an update, and in everything else
    """
    with watched(model) as inside:
        total = seconds(train)
    parts = {part: inside[part].seconds / n_updates for part in PARTS}
    return {**parts, "everything else": total / n_updates - sum(parts.values()), "all": total / n_updates}


def parts_table(models: Mapping[str, BaseAlgorithm], train: Callable[[Any], Any], n_updates: int, n_rounds: int) -> Table:
    """
    :param models: Models that can train, by name
    :param train: Calls the ``train()`` of a model
    :param n_updates: How many updates that makes
    :param n_rounds: How often each model is timed
    :return: Microseconds of each part that any of them has
    """
    rounds = [
        {name: parts_of_an_update(model, partial(train, model), n_updates) for name, model in models.items()}
        for _ in range(n_rounds)
    ]
    medians = {
        part: [1e6 * np.median([each[name][part] for each in rounds]) for name in models]
        for part in rounds[0][next(iter(models))]
    }
    rows = [[part, *(f"{figure:.0f}" for figure in figures)] for part, figures in medians.items() if any(figures)]
    return Table(["", *models], rows, f"Microseconds of an update, medians of {n_rounds} rounds.")


def ppo_parts(n_rounds: int = 12, **changed: Any) -> Table:
    """
    :param n_rounds: How often each model is timed
    :param changed: Arguments that differ from the shipped settings
    :return: The parts of an update in Gym Control
    """
    stock, cchain = (model_settings(algo, "Continual/Acrobot-v1", **changed) for algo in ("ppo", "ppo_cchain"))
    models: dict[str, PPO] = {
        "PPO": PPO(**stock),
        "lean PPO": make_lean(PPO(**stock)),
        "CChainPPO": CChainPPO(**cchain),
        'CChainPPO, `churn_reference="next"`': CChainPPO(**cchain, churn_reference="next"),
    }
    for model in models.values():
        model.learn(2 * model.n_steps)
    n_updates = model.n_epochs * ceil(model.n_steps * model.n_envs / model.batch_size)
    return parts_table(models, lambda model: model.train(), n_updates, n_rounds)


def dqn_parts(n_rounds: int = 12, n_updates: int = 200, **changed: Any) -> Table:
    """
    :param n_rounds: How often each model is timed
    :param n_updates: Updates that are timed at a time
    :param changed: Arguments that differ from the shipped settings
    :return: The parts of an update in MinAtar
    """
    changed = {"buffer_size": 20_000, "learning_starts": 1000, **changed}
    stock, cchain = (model_settings(algo, "Continual/MinAtar-v0", **changed) for algo in ("double_dqn", "dqn_cchain"))
    models = {
        "DoubleDQN": DoubleDQN(**stock),
        "CChainDQN": CChainDQN(**cchain),
        'CChainDQN, `churn_reference="next"`': CChainDQN(**cchain, churn_reference="next"),
    }
    for model in models.values():
        model.learn(model.learning_starts + 200)

    def train(model: DoubleDQN) -> None:
        for _ in range(n_updates):
            model.train(gradient_steps=1, batch_size=model.batch_size)

    return parts_table(models, train, n_updates, n_rounds)
