"""Churn reduction of an unmodified ``PPO.train()``: where reference batches come from, where the gradient goes in."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.distributions import (
    BernoulliDistribution,
    CategoricalDistribution,
    DiagGaussianDistribution,
    MultiCategoricalDistribution,
)
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_cchain.churn import ChurnCoefficient, ChurnReducer, component_backward, extra_gradient
from sb3_cchain.churn.component import COMPONENTS
from sb3_cchain.churn.divergence import Divergence, cross_entropy, mean_absolute_change, mean_squared_difference
from sb3_cchain.networks.policy_outputs import (
    as_it_acts,
    has_training_mode,
    policy_outputs,
    policy_values,
)
from sb3_cchain.replaced import replaced

# β when `target_churn_ratio="auto"`. The paper uses 1e3, 1e4 (default of the released code) or 1e5 with the cross-entropy
# of discrete policies, and 0.05 or 0.5 with the mean squared difference of action means.
DEFAULT_TARGET_RATIO: dict[Divergence, float] = {cross_entropy: 1e4, mean_squared_difference: 0.05}


def make_policy_reducer(model: PPO, make_coefficient: Callable[[float], ChurnCoefficient]) -> ChurnReducer:
    """
    :param model: A model, whose policy exists
    :param make_coefficient: Makes λ, given the default β of the policy's kind of outputs
    :return: The reducer of the policy's churn (the paper regularises PPO's policy only, not its value function)
    :raises TypeError: When the policy's action distribution is not supported
    """
    divergence = policy_divergence(model.policy)
    if model.verbose >= 1 and model.n_steps * model.n_envs <= model.batch_size:
        print(
            f"A rollout of n_steps * n_envs = {model.n_steps * model.n_envs} steps is a single minibatch of "
            f"batch_size={model.batch_size}: there is no data outside it to measure churn on, so the minibatch is its own "
            "reference batch. Choose a `batch_size` of at most half a rollout."
        )
    return ChurnReducer(
        partial(_outputs, model),  # deepcopy() of the model copies the model in a partial, too; it would not copy a closure
        divergence,
        make_coefficient(DEFAULT_TARGET_RATIO[divergence]),
    )


def policy_divergence(policy: ActorCriticPolicy) -> Divergence:
    """
    :param policy: An actor-critic policy
    :return: Cross-entropy where actions are discrete, mean squared difference of the action means where they are Gaussian
    :raises TypeError: For an action distribution that is neither
    """
    distribution = policy.action_dist
    if isinstance(distribution, (CategoricalDistribution, MultiCategoricalDistribution, BernoulliDistribution)):
        return cross_entropy
    # StateDependentNoiseDistribution (gSDE) has no common base with it but is a Gaussian too
    if isinstance(distribution, DiagGaussianDistribution) or policy.use_sde:
        return mean_squared_difference
    raise TypeError(
        f"Churn reduction does not know the outputs of {type(distribution).__name__}. It supports categorical, "
        "multi-categorical, Bernoulli, diagonal Gaussian and state-dependent (gSDE) action distributions."
    )


def _outputs(model: PPO, observations: PyTorchObs) -> th.Tensor:
    return policy_outputs(model.policy, observations)


class ReferenceBatches:
    """
    Stands in for ``rollout_buffer.get`` and pairs each minibatch of an epoch with another one as its reference batch.

    The minibatches of an epoch are a random partition of the rollout. Any other minibatch is therefore a random sample that
    shares nothing with this one (the paper's B_ref ∩ B_train = ∅), and SB3 gathers it anyway. The one half an epoch away is
    taken. An epoch of a single minibatch has no other data: the minibatch is its own reference batch.

    :param get: The rollout buffer's ``get(batch_size)``
    """

    # The reference batch of the minibatch that is being trained on, and whether that is the first of its epoch
    current: PyTorchObs
    starts_epoch: bool

    def __init__(self, get: Callable[..., Iterator[Any]]):
        self._get = get

    def get(self, batch_size: int | None = None) -> Iterator[Any]:
        """
        :param batch_size: Minibatch size
        :return: The minibatches of one epoch
        """
        minibatches = list(self._get(batch_size))
        distance = (len(minibatches) + 1) // 2
        for position, minibatch in enumerate(minibatches):
            self.current = minibatches[(position + distance) % len(minibatches)].observations
            self.starts_epoch = position == 0
            yield minibatch


# L, by the name in `churn_base_loss`
BASE_LOSSES = ("actor", "surrogate")


def check_choices(churn_base_loss: str, churn_component: str) -> None:
    """
    :param churn_base_loss: The argument
    :param churn_component: The argument
    :raises ValueError: When one of them is not among the allowed values
    """
    for name, value, allowed in (
        ("churn_base_loss", churn_base_loss, BASE_LOSSES),
        ("churn_component", churn_component, COMPONENTS),
    ):
        if value not in allowed:
            raise ValueError(f"`{name}` must be one of {', '.join(map(repr, allowed))}, got {value!r}")


@contextmanager
def reduced_churn(model: PPO, reducer: ChurnReducer, base_loss: str = "actor", component: str = "full") -> Iterator[None]:
    """
    Run ``model``'s own ``train()`` in this block to train it with churn reduction.

    Afterwards λ has been updated and ``churn/…`` logged:

    - ``churn/loss``: mean churn loss L_churn over the updates
    - ``churn/coef``: the λ it was multiplied by
    - ``churn/relative_loss``: λ·L_churn / \\|L\\|, which an adaptive λ holds near β
    - ``churn/policy_churn``: L_churn minus its value without any churn; for discrete actions the Kullback-Leibler
      divergence from the policy before an update to the one after it
    - ``churn/value_churn``: mean absolute change of the state values by the first update of each epoch, unless it is the
      epoch's only one

    L is averaged over the updates.

    :param model: A PPO model
    :param reducer: Its churn reducer
    :param base_loss: What L is: ``"actor"`` for the clipped surrogate and the entropy bonus, ``"surrogate"`` for the clipped
        surrogate alone
    :param component: Which component of the churn gradient is used: ``"full"``, ``"projection"`` or ``"orthogonal"``
    """
    policy, rollout_buffer = model.policy, model.rollout_buffer
    references = ReferenceBatches(rollout_buffer.get)
    acting = (lambda: as_it_acts(policy)) if has_training_mode(policy) else nullcontext
    reducer.discard_losses()  # of an iteration that was interrupted
    coef = reducer.coefficient.value
    old_values: th.Tensor | None = None
    value_churns: list[float] = []

    def backward(add_gradient: Callable[[th.Tensor], Any]) -> None:
        nonlocal old_values
        with acting():
            if old_values is not None:
                assert reducer.reference is not None
                value_churns.append(mean_absolute_change(old_values, policy_values(policy, reducer.reference)))
            reducer.backward(references.current, add_gradient)
            old_values = policy_values(policy, references.current) if references.starts_epoch else None

    full = component == "full"
    with (
        nullcontext(th.Tensor.backward) if full else component_backward(list(policy.parameters()), component) as add_gradient,
        replaced(rollout_buffer, "get", references.get),
        extra_gradient(policy.optimizer, lambda: backward(add_gradient)),
    ):
        yield

    if reducer.losses:
        logged = model.logger.name_to_value
        loss = logged["train/policy_gradient_loss"]
        if base_loss == "actor":
            loss += model.ent_coef * logged["train/entropy_loss"]
        churn_loss = np.mean(reducer.losses)
        model.logger.record("churn/loss", churn_loss)
        model.logger.record("churn/coef", coef)
        model.logger.record("churn/relative_loss", coef * churn_loss / (abs(loss) + 1e-8))
        model.logger.record("churn/policy_churn", reducer.mean_churn())
        if value_churns:
            model.logger.record("churn/value_churn", np.mean(value_churns))
        reducer.end_iteration(abs(loss))
