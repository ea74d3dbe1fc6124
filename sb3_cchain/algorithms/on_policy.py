"""Churn reduction of an on-policy algorithm's unmodified ``train()``: where the gradient goes in, and what is logged."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_cchain.algorithms.churn_log import churn_prefix, log_churn
from sb3_cchain.algorithms.churn_targets import ChurnTarget, churn_kind
from sb3_cchain.algorithms.last_surrogate import last_surrogate
from sb3_cchain.algorithms.recorded import recorded
from sb3_cchain.algorithms.reference_batches import (
    REFERENCES,
    PreviousRollout,
    ReferenceBatches,
    ReferenceMinibatches,
    RolloutReferences,
)
from sb3_cchain.algorithms.reference_passes import joint_passes
from sb3_cchain.churn import ChurnReducer, component_backward, extra_gradient
from sb3_cchain.churn.component import COMPONENTS
from sb3_cchain.churn.divergence import mean_absolute_change
from sb3_cchain.churn.reducer import Observations
from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.networks.evaluation_mode import evaluation_mode, has_training_mode
from sb3_cchain.networks.joint_evaluation import can_evaluate_jointly, has_convolutions
from sb3_cchain.networks.policy_inputs import rows
from sb3_cchain.replaced import replaced
from sb3_cchain.validation import check_choice, check_number

# Samples of a reference batch on which `churn/value_churn` is measured. All images would take several per cent of an update
VALUE_CHURN_SAMPLES = 32

# L, by the name in `churn_base_loss`
BASE_LOSSES = ("actor", "surrogate", "last")


@dataclass(frozen=True)
class PolicyChurnOptions:
    """
    How the churn of a PPO policy is measured and reduced. The names are those of the arguments.

    :param churn_base_loss: What L is: ``"actor"`` for the clipped surrogate and the entropy bonus, ``"surrogate"`` for the
        clipped surrogate alone, ``"last"`` for that of the last minibatch, and with the churn loss of that minibatch
    :param churn_component: Which component of the churn gradient is used: ``"full"``, ``"projection"`` or ``"orthogonal"``
    :param churn_reference: Where reference batches are taken from: ``"independent"`` or ``"next"``
    :param churn_batch_size: Size of a reference batch in minibatches
    :raises ValueError: Naming the argument that is not allowed
    """

    churn_base_loss: str = "actor"
    churn_component: str = "full"
    churn_reference: str = "independent"
    churn_batch_size: float = 1.0

    def __post_init__(self) -> None:
        check_choice("churn_base_loss", self.churn_base_loss, BASE_LOSSES)
        check_choice("churn_component", self.churn_component, COMPONENTS)
        check_choice("churn_reference", self.churn_reference, REFERENCES)
        check_number("churn_batch_size", self.churn_batch_size, minimum=0, exclusive=True)


def _goes_jointly(model: Any, policy: ActorCriticPolicy, options: PolicyChurnOptions) -> bool:
    """Whether reference batches can go through the policy with the minibatches, and that takes less time."""
    return (
        (options.churn_reference == "next" or not has_convolutions(policy))
        and can_evaluate_jointly(policy)
        and _has_sb3s_train(model)
    )


def _has_sb3s_train(model: Any) -> bool:
    """In SB3's, ``zero_grad()`` comes after the evaluation of a minibatch, and the loss has the values in it."""
    classes = [base for base in type(model).__mro__ if "train" in vars(base)]
    return all(base.__module__.startswith(("stable_baselines3.", "sb3_cchain.")) for base in classes)


def rollout_references(model: Any, reducers: Mapping[str, ChurnReducer], options: PolicyChurnOptions) -> RolloutReferences:
    """
    :param model: A model of an on-policy algorithm
    :param reducers: Its churn reducers
    :param options: How churn is measured
    :return: Where its reference batches come from
    """
    buffer = model.rollout_buffer
    if any(hasattr(buffer, name) for name in ("action_masks", "hidden_states_pi")):
        return ReferenceMinibatches(buffer)
    if not hasattr(model, "batch_size"):  # A2C
        return PreviousRollout(buffer, next(iter(reducers.values())).next_reference)
    return ReferenceBatches(buffer, options.churn_reference, options.churn_batch_size)


@contextmanager
def reduced_on_policy(model: Any, reducers: Mapping[str, ChurnReducer], options: PolicyChurnOptions) -> Iterator[None]:
    """
    Run ``model``'s own ``train()`` in this block to train it with churn reduction.

    Afterwards λ has been updated and ``churn/…`` logged:

    - ``churn/loss``: mean churn loss L_churn over the updates
    - ``churn/coef``: the λ it was multiplied by
    - ``churn/relative_loss``: λ·L_churn / \\|L\\|, which an adaptive λ holds near β
    - ``churn/policy_churn``: L_churn minus its value without any churn; for discrete actions the Kullback-Leibler
      divergence from the policy before an update to the one after it
    - ``churn/value_churn``: mean absolute change of the state values by an update. Where a PPO holds only its policy still, it
      is that of the first update of each epoch, if another one follows it, on the first 32 samples of its reference batch

    With two targets, what belongs to one is logged as ``churn/policy/…`` or ``churn/value/…``. L is averaged over the updates.
    With ``churn_base_loss="last"``, L and ``churn/loss`` are those of the last update.

    :param model: A model of an on-policy algorithm
    :param reducers: Its churn reducers by the name of the target, those with a λ that is not 0
    :param options: How churn is measured and reduced
    """
    policy, targets = uncompiled(model.policy), churn_kind(type(model)).targets
    references = rollout_references(model, reducers, options)
    coefs = {}
    for name, reducer in reducers.items():
        reducer.discard_losses()  # of an iteration that was interrupted
        coefs[name] = reducer.coefficient.value
    acting = partial(evaluation_mode, policy) if has_training_mode(policy) else nullcontext
    value_churns: list[float] = []
    watching: Callable[[], AbstractContextManager[None]] = nullcontext
    if list(reducers) == ["policy"] and isinstance(references, ReferenceBatches):
        watching = _ValueWatch(policy, reducers["policy"], references, value_churns).between_updates

    def hold_still(name: str, backward: Callable[[th.Tensor], object] = th.Tensor.backward) -> None:
        reducer, target = reducers[name], targets[name]
        reference = references.reference(target.needs, name == "policy")
        if reference is None:
            reducer.forget_reference()
            return
        old = reducer.old_outputs
        new = reducer.backward(reference, backward, policy=model.policy)
        if name == "value" and new is not None:
            assert old is not None
            value_churns.append(mean_absolute_change(old, new.detach()))

    adders: dict[str, Callable[[], None]] = {name: partial(hold_still, name) for name in reducers}

    def before_update() -> None:
        with acting(), watching():
            for add_gradient in adders.values():
                add_gradient()

    with ExitStack() as stack:
        if options.churn_component != "full":
            backward = stack.enter_context(component_backward(list(policy.parameters()), options.churn_component))
            adders["policy"] = partial(hold_still, "policy", backward)
        elif "policy" in reducers and isinstance(references, ReferenceBatches) and _goes_jointly(model, policy, options):
            adders["policy"] = stack.enter_context(joint_passes(policy, reducers["policy"], references))
        stack.enter_context(replaced(model.rollout_buffer, "get", references.get))
        logged = stack.enter_context(recorded(model.logger))
        surrogate = stack.enter_context(last_surrogate(model)) if options.churn_base_loss == "last" else None
        stack.enter_context(extra_gradient(policy.optimizer, before_update))
        yield

    for name, reducer in reducers.items():
        if isinstance(references, PreviousRollout):
            reducer.next_reference = references.current
        if reducer.losses:
            loss = _take_losses(model, logged, targets[name], reducer, options, surrogate)
            prefix = churn_prefix(name, reducers)
            log_churn(model.logger.record, prefix, coefs[name], float(np.mean(reducer.losses)), loss)
            if name == "policy":
                model.logger.record("churn/policy_churn", reducer.mean_churn())
            reducer.end_iteration(loss)
    if value_churns:
        model.logger.record("churn/value_churn", np.mean(value_churns))


class _ValueWatch:
    """
    Measures the churn of values that are not held still: that of the first update of each epoch, if another one follows it.

    :param policy: The policy
    :param reducer: That of the policy's outputs
    :param references: Where its reference batches come from
    :param churns: What is measured is appended to it
    """

    def __init__(self, policy: ActorCriticPolicy, reducer: ChurnReducer, references: ReferenceBatches, churns: list[float]):
        self._policy, self._reducer, self._references, self._churns = policy, reducer, references, churns
        self._old_values: th.Tensor | None = None

    @contextmanager
    def between_updates(self) -> Iterator[None]:
        """In the block the reducer goes on from the reference batch of the update before to that of the next one."""
        if self._old_values is not None:
            self._churns.append(mean_absolute_change(self._old_values, self._values_of(self._reducer.reference)))
        yield
        self._old_values = self._values_of(self._references.current) if self._references.starts_epoch else None

    def _values_of(self, reference: Observations | None) -> th.Tensor:
        assert reference is not None
        with th.no_grad():
            return self._policy.predict_values(rows(reference, slice(VALUE_CHURN_SAMPLES)))


def _take_losses(
    model: Any,
    logged: Mapping[str, float],
    target: ChurnTarget,
    reducer: ChurnReducer,
    options: PolicyChurnOptions,
    surrogate: Callable[[], float] | None,
) -> float:
    """|L|. Of the churn losses, those of the updates that count are left."""
    if surrogate is None:
        return abs(target.base_loss(model, logged, without_entropy=options.churn_base_loss == "surrogate"))
    reducer.losses = reducer.losses[-1:]
    return abs(surrogate())
