"""Churn reduction of an unmodified ``PPO.train()``: where reference batches come from, where the gradient goes in."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial

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

from sb3_cchain.algorithms.reference_batches import REFERENCES, ReferenceBatches
from sb3_cchain.algorithms.reference_passes import joint_passes, separate_passes
from sb3_cchain.churn import ChurnCoefficient, ChurnReducer, extra_gradient
from sb3_cchain.churn.component import COMPONENTS
from sb3_cchain.churn.divergence import Divergence, cross_entropy, mean_absolute_change, mean_squared_difference
from sb3_cchain.churn.reducer import Observations
from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.networks.joint_evaluation import can_evaluate_jointly, has_convolutions
from sb3_cchain.networks.policy_inputs import rows
from sb3_cchain.networks.policy_outputs import (
    as_it_acts,
    has_training_mode,
    policy_outputs,
    policy_values,
)
from sb3_cchain.replaced import replaced
from sb3_cchain.validation import check_choice, check_number

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


# Samples of a reference batch on which `churn/value_churn` is measured. All images would take several per cent of an update
VALUE_CHURN_SAMPLES = 32

# L, by the name in `churn_base_loss`
BASE_LOSSES = ("actor", "surrogate")


@dataclass(frozen=True)
class PolicyChurnOptions:
    """
    How the churn of a PPO policy is measured and reduced. The names are those of the arguments.

    :param churn_base_loss: What L is: ``"actor"`` for the clipped surrogate and the entropy bonus, ``"surrogate"`` for the
        clipped surrogate alone
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


def _goes_jointly(policy: ActorCriticPolicy, options: PolicyChurnOptions) -> bool:
    """Whether reference batches can go through the policy with the minibatches, and that takes less time."""
    return (
        options.churn_component == "full"
        and (options.churn_reference == "next" or not has_convolutions(policy))
        and can_evaluate_jointly(policy)
    )


@contextmanager
def reduced_churn(model: PPO, reducer: ChurnReducer, options: PolicyChurnOptions) -> Iterator[None]:
    """
    Run ``model``'s own ``train()`` in this block to train it with churn reduction.

    Afterwards λ has been updated and ``churn/…`` logged:

    - ``churn/loss``: mean churn loss L_churn over the updates
    - ``churn/coef``: the λ it was multiplied by
    - ``churn/relative_loss``: λ·L_churn / \\|L\\|, which an adaptive λ holds near β
    - ``churn/policy_churn``: L_churn minus its value without any churn; for discrete actions the Kullback-Leibler
      divergence from the policy before an update to the one after it
    - ``churn/value_churn``: mean absolute change of the state values by the first update of each epoch, unless it is the
      epoch's only one, on the first 32 samples of its reference batch

    L is averaged over the updates.

    :param model: A PPO model
    :param reducer: Its churn reducer
    :param options: How churn is measured and reduced
    """
    policy, rollout_buffer = uncompiled(model.policy), model.rollout_buffer
    references = ReferenceBatches(rollout_buffer, options.churn_reference, options.churn_batch_size)
    reducer.discard_losses()  # of an iteration that was interrupted
    coef = reducer.coefficient.value
    acting = (lambda: as_it_acts(policy)) if has_training_mode(policy) else nullcontext
    old_values: th.Tensor | None = None
    value_churns: list[float] = []

    def values_of(reference: Observations) -> th.Tensor:
        return policy_values(policy, rows(reference, slice(VALUE_CHURN_SAMPLES)))

    def before_update(add_gradient: Callable[[], None]) -> None:
        nonlocal old_values
        with acting():
            if old_values is not None:
                assert reducer.reference is not None
                value_churns.append(mean_absolute_change(old_values, values_of(reducer.reference)))
            add_gradient()
            old_values = values_of(references.current) if references.starts_epoch else None

    if _goes_jointly(policy, options):
        passes = joint_passes(policy, reducer, references)
    else:
        passes = separate_passes(policy, reducer, references, options.churn_component)
    with (
        replaced(rollout_buffer, "get", references.get),
        passes as add_gradient,
        extra_gradient(policy.optimizer, lambda: before_update(add_gradient)),
    ):
        yield

    if reducer.losses:
        logged = model.logger.name_to_value
        loss = logged["train/policy_gradient_loss"]
        if options.churn_base_loss == "actor":
            loss += model.ent_coef * logged["train/entropy_loss"]
        churn_loss = np.mean(reducer.losses)
        model.logger.record("churn/loss", churn_loss)
        model.logger.record("churn/coef", coef)
        model.logger.record("churn/relative_loss", coef * churn_loss / (abs(loss) + 1e-8))
        model.logger.record("churn/policy_churn", reducer.mean_churn())
        if value_churns:
            model.logger.record("churn/value_churn", np.mean(value_churns))
        reducer.end_iteration(abs(loss))
