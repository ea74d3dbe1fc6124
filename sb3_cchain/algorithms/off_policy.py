"""Churn reduction of an off-policy algorithm's unmodified ``train()``: where the gradient goes in, and what is logged."""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

import numpy as np
import torch as th

from sb3_cchain.algorithms.churn_log import churn_prefix, log_churn
from sb3_cchain.algorithms.churn_targets import ChurnTarget, churn_kind
from sb3_cchain.algorithms.recorded import recorded
from sb3_cchain.algorithms.replay_observations import kept_minibatches, sample_observations
from sb3_cchain.churn import ChurnReducer, extra_gradient
from sb3_cchain.churn.divergence import mean_absolute_change
from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.networks.evaluation_mode import as_it_acts
from sb3_cchain.networks.model_optimizers import model_optimizers


@contextmanager
def reduced_off_policy(model: Any, reducers: Mapping[str, ChurnReducer]) -> Iterator[None]:
    """
    Run ``model``'s own ``train()`` in this block to train it with churn reduction. Reference batches are samples of the replay
    buffer, of the size of a minibatch and drawn independently of the minibatches.

    Afterwards λ has been updated, each gradient update counting as an iteration, and ``churn/…`` logged, averages over the
    updates between two logs:

    - ``churn/loss``: the churn loss L_churn
    - ``churn/coef``: the λ it was multiplied by, the same in all updates of a ``train()``
    - ``churn/relative_loss``: λ·L_churn / \\|L\\|, of each ``train()``. The mean of these ratios is greater than the ratio of
      the means, which an adaptive λ holds at β
    - ``churn/policy_churn``: mean squared change of the actions by an update
    - ``churn/value_churn``: mean absolute change of the values by an update

    With two targets, what belongs to one is logged as ``churn/policy/…`` or ``churn/value/…``.

    :param model: A model of an off-policy algorithm
    :param reducers: Its churn reducers by the name of the target, those with a λ that is not 0
    """
    targets, optimizers = churn_kind(type(model)).targets, model_optimizers(model)
    changes: dict[str, list[float]] = {name: [] for name in reducers}
    coefs = {}
    with ExitStack() as stack:
        stack.enter_context(kept_minibatches(model.replay_buffer))
        for name, reducer in reducers.items():
            reducer.discard_losses()  # of a training that was interrupted
            coefs[name] = reducer.coefficient.value
            before_update = partial(_hold_still, model, targets[name], reducer, changes[name])
            stack.enter_context(extra_gradient(optimizers[targets[name].optimizer], before_update))
        logged = stack.enter_context(recorded(model.logger))
        yield
    for name, reducer in reducers.items():
        if reducer.losses:
            loss = abs(targets[name].base_loss(model, logged))
            prefix = churn_prefix(name, reducers)
            log_churn(model.logger.record_mean, prefix, coefs[name], float(np.mean(reducer.losses)), loss)
            churn = reducer.mean_churn() if name == "policy" else np.mean(changes[name])
            model.logger.record_mean(f"churn/{name}_churn", churn)
            reducer.end_iteration(loss, each_update=True)


def _hold_still(model: Any, target: ChurnTarget, reducer: ChurnReducer, changes: list[float]) -> None:
    """Right after ``zero_grad()``."""
    with_actions = bool(target.needs)
    reference = sample_observations(model.replay_buffer, model.batch_size, model._vec_normalize_env, with_actions)
    policy = uncompiled(model.policy)
    network = getattr(policy, target.optimizer) if target.optimizer else policy
    old: th.Tensor | None = reducer.old_outputs
    # As it acts: the running statistics of BatchNorm do not move, and the noise of dropout is no churn
    with as_it_acts(network):
        new = reducer.backward(reference, policy=model.policy)
    if new is not None:
        assert old is not None
        changes.append(mean_absolute_change(old, new.detach()))
