"""Where the time of an update goes, with and without churn reduction."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import PPO

from benchmarks.speed.settings import model_settings
from benchmarks.speed.tables import Table
from benchmarks.speed.time_inside import TimeInside
from benchmarks.speed.timing import seconds
from sb3_cchain import CChainPPO, make_lean
from sb3_cchain.algorithms import on_policy, reference_passes
from sb3_cchain.replaced import replaced

ENV_ID = "Continual/Acrobot-v1"
FORWARD, BACKWARD, CLIP, ADAM = "forward pass", "backward pass", "`clip_grad_norm_`", "Adam's step"
REFERENCE = "outputs on the reference batch before the update"
PARTS = (FORWARD, BACKWARD, CLIP, ADAM, REFERENCE)


@contextmanager
def watched(model: PPO) -> Iterator[dict[str, TimeInside]]:
    """
    :param model: A model
    :return: The time inside each of ``PARTS``, while the ``with`` block lasts
    """
    with_churn = isinstance(model, CChainPPO)
    inside = {part: TimeInside() for part in PARTS}
    owners: list[tuple[str, Any, str]] = [
        (BACKWARD, th.Tensor, "backward"),
        (CLIP, th.nn.utils, "clip_grad_norm_"),
        (ADAM, model.policy.optimizer, "step"),
        # CChainPPO puts this in the place of `policy.evaluate_actions()`
        (FORWARD, *((reference_passes, "evaluate_jointly") if with_churn else (model.policy, "evaluate_actions"))),
    ]

    def timed_extra_gradient(optimizer: th.optim.Optimizer, backward: Callable[[], None]) -> Any:
        holder = type("Holder", (), {"backward": staticmethod(backward)})()
        inside[REFERENCE].watch(holder, "backward")
        return extra_gradient(optimizer, holder.backward)

    extra_gradient = on_policy.extra_gradient
    with ExitStack() as stack:
        stack.enter_context(replaced(on_policy, "extra_gradient", timed_extra_gradient))
        for part, owner, name in owners:
            stack.enter_context(replaced(owner, name, getattr(owner, name)))  # put back afterwards
            inside[part].watch(owner, name)
        yield inside


def parts_of_an_update(model: PPO) -> dict[str, float]:
    """
    :param model: A model with a rollout
    :return: Seconds of processor time in each part of an update of ``train()``, and in everything else
    """
    n_updates = model.n_epochs * -(-model.n_steps * model.n_envs // model.batch_size)
    with watched(model) as inside:
        total = seconds(model.train)
    parts = {part: inside[part].seconds / n_updates for part in PARTS}
    return {**parts, "everything else": total / n_updates - sum(parts.values()), "all": total / n_updates}


def parts_table(n_rounds: int = 12, **changed: Any) -> Table:
    """
    :param n_rounds: How often each model is timed
    :param changed: Arguments that differ from the shipped settings
    :return: Microseconds of each part
    """
    stock, cchain = (model_settings(algo, ENV_ID, **changed) for algo in ("ppo", "ppo_cchain"))
    models: dict[str, PPO] = {
        "PPO": PPO(**stock),
        "lean PPO": make_lean(PPO(**stock)),
        "CChainPPO": CChainPPO(**cchain),
        'CChainPPO, `churn_reference="next"`': CChainPPO(**cchain, churn_reference="next"),
    }
    for model in models.values():
        model.learn(2 * model.n_steps)
    rounds = [{name: parts_of_an_update(model) for name, model in models.items()} for _ in range(n_rounds)]
    rows = [
        [part, *(f"{1e6 * np.median([each[name][part] for each in rounds]):.0f}" for name in models)]
        for part in rounds[0]["PPO"]
    ]
    return Table(["", *models], rows, f"Microseconds of an update, medians of {n_rounds} rounds.")
