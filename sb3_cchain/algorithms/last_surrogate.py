"""The loss of the last minibatch of PPO's ``train()``, which logs means alone."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch as th
from stable_baselines3 import PPO

from sb3_cchain.churn import extra_gradient
from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.replaced import replaced


@contextmanager
def last_surrogate(model: PPO) -> Iterator[Callable[[], float]]:
    """
    Watch ``model``'s own ``train()`` in this block.

    :param model: A PPO
    :return: Gives the clipped surrogate loss of the last update's minibatch, as PPO has it before the update
    """
    policy: Any = uncompiled(model.policy)
    get, evaluate_actions = model.rollout_buffer.get, policy.evaluate_actions
    minibatch: Any = None
    log_prob: Any = None
    of_update: tuple[Any, Any] = (None, None)

    def watched_get(*args: Any, **kwargs: Any) -> Iterator[Any]:
        nonlocal minibatch
        for sample in get(*args, **kwargs):
            minibatch = sample
            yield sample

    def watched_evaluate_actions(*args: Any, **kwargs: Any) -> Any:
        nonlocal log_prob
        evaluated = evaluate_actions(*args, **kwargs)
        log_prob = evaluated[1].detach()
        return evaluated

    def remember() -> None:
        nonlocal of_update
        of_update = minibatch, log_prob  # what `target_kl` stops is evaluated and not updated on

    with (
        replaced(model.rollout_buffer, "get", watched_get),
        replaced(policy, "evaluate_actions", watched_evaluate_actions),
        extra_gradient(policy.optimizer, remember),
    ):
        yield lambda: _clipped_surrogate(model, *of_update)


def _clipped_surrogate(model: PPO, minibatch: Any, log_prob: th.Tensor) -> float:
    advantages = minibatch.advantages
    if model.normalize_advantage and len(advantages) > 1:
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    ratio = th.exp(log_prob - minibatch.old_log_prob)
    clip_range = model.clip_range(model._current_progress_remaining)  # type: ignore[operator]
    clipped = th.clamp(ratio, 1 - clip_range, 1 + clip_range)
    return -th.min(advantages * ratio, advantages * clipped).mean().item()
