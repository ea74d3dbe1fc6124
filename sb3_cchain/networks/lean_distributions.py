"""
SB3's action distributions without the checks of ``torch.distributions``: the same operations in the same order, so the same
numbers to the bit, random draws and gradients included.

For one observation, building and checking them takes as long as a small network.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.distributions import (
    BernoulliDistribution,
    CategoricalDistribution,
    DiagGaussianDistribution,
    Distribution,
    MultiCategoricalDistribution,
)
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from torch.distributions import Bernoulli, Categorical, Normal

from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.networks.policy_outputs import is_sb3s

OnPolicyModel = TypeVar("OnPolicyModel", bound=OnPolicyAlgorithm)


NAN_OUTPUTS = (
    "The outputs of the policy network are NaN or infinite. Look for NaN or infinite observations and parameters; "
    "sb3_cchain.FiniteCheck names them in training."
)


def _without_nan(outputs: th.Tensor) -> th.Tensor:
    if outputs.isnan().any():
        raise ValueError(NAN_OUTPUTS)
    return outputs


def _log_prob(categorical: Categorical, actions: th.Tensor) -> th.Tensor:
    # As `categorical.log_prob()`, without broadcasting
    return categorical.logits.gather(-1, actions.long().unsqueeze(-1)).squeeze(-1)


def _sample(categorical: Categorical) -> th.Tensor:
    # As `categorical.sample()`. On a GPU, NaN would end the process
    return th.multinomial(_without_nan(categorical.probs), 1, replacement=True).squeeze(-1)


def _mode(categorical: Categorical) -> th.Tensor:
    return _without_nan(categorical.probs).argmax(dim=1)


class LeanCategorical(CategoricalDistribution):
    """SB3's, with a ``Categorical`` that checks nothing."""

    def proba_distribution(self, action_logits: th.Tensor) -> "LeanCategorical":
        """
        :param action_logits: Logits, ``(batch_size, n_actions)``
        :return: self
        """
        self.distribution = Categorical(logits=action_logits, validate_args=False)
        return self

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """
        :param actions: Actions, ``(batch_size,)``
        :return: Log-probabilities, ``(batch_size,)``
        """
        return _log_prob(self.distribution, actions)

    def sample(self) -> th.Tensor:
        """
        :return: Actions, ``(batch_size,)``
        """
        return _sample(self.distribution)

    def mode(self) -> th.Tensor:
        """
        :return: Most probable actions, ``(batch_size,)``
        """
        return _mode(self.distribution)


class LeanMultiCategorical(MultiCategoricalDistribution):
    """SB3's, with a ``Categorical`` for each sub-action that checks nothing."""

    def proba_distribution(self, action_logits: th.Tensor) -> "LeanMultiCategorical":
        """
        :param action_logits: Logits of all sub-actions, ``(batch_size, sum of their numbers of values)``
        :return: self
        """
        sub_actions = action_logits.split(list(self.action_dims), dim=1)
        self.distribution = [Categorical(logits=logits, validate_args=False) for logits in sub_actions]
        return self

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """
        :param actions: Actions, ``(batch_size, n_sub_actions)``
        :return: Log-probabilities, ``(batch_size,)``
        """
        return th.stack(list(map(_log_prob, self.distribution, actions.unbind(dim=1))), dim=1).sum(dim=1)

    def sample(self) -> th.Tensor:
        """
        :return: Actions, ``(batch_size, n_sub_actions)``
        """
        return th.stack(list(map(_sample, self.distribution)), dim=1)

    def mode(self) -> th.Tensor:
        """
        :return: Most probable actions, ``(batch_size, n_sub_actions)``
        """
        return th.stack(list(map(_mode, self.distribution)), dim=1)


class LeanBernoulli(BernoulliDistribution):
    """SB3's, with a ``Bernoulli`` that checks nothing."""

    def proba_distribution(self, action_logits: th.Tensor) -> "LeanBernoulli":
        """
        :param action_logits: Logits, ``(batch_size, n_sub_actions)``
        :return: self
        """
        self.distribution = Bernoulli(logits=action_logits, validate_args=False)
        return self

    def sample(self) -> th.Tensor:
        """
        :return: Actions, ``(batch_size, n_sub_actions)``
        """
        _without_nan(self.distribution.probs)
        return super().sample()

    def mode(self) -> th.Tensor:
        """
        :return: Most probable actions, ``(batch_size, n_sub_actions)``
        """
        return _without_nan(super().mode())


class LeanDiagGaussian(DiagGaussianDistribution):
    """SB3's, with a ``Normal`` that checks nothing."""

    def proba_distribution(self, mean_actions: th.Tensor, log_std: th.Tensor) -> "LeanDiagGaussian":
        """
        :param mean_actions: Means, ``(batch_size, action_dim)``
        :param log_std: Logarithms of the standard deviations, ``(action_dim,)``
        :return: self
        """
        self.distribution = Normal(mean_actions, th.ones_like(mean_actions) * log_std.exp(), validate_args=False)
        return self

    def sample(self) -> th.Tensor:
        """
        :return: Actions, ``(batch_size, action_dim)``, through which gradients flow
        """
        return _without_nan(super().sample())

    def mode(self) -> th.Tensor:
        """
        :return: Means, ``(batch_size, action_dim)``
        """
        return _without_nan(super().mode())


# By the class of SB3's distribution, how to make the lean one from it
_LEAN: dict[type[Distribution], Callable[[Any], Distribution]] = {
    CategoricalDistribution: lambda stock: LeanCategorical(stock.action_dim),
    MultiCategoricalDistribution: lambda stock: LeanMultiCategorical(stock.action_dims),
    BernoulliDistribution: lambda stock: LeanBernoulli(stock.action_dims),
    DiagGaussianDistribution: lambda stock: LeanDiagGaussian(stock.action_dim),
}


def make_lean(model: OnPolicyModel) -> OnPolicyModel:
    """
    Give a model lean action distributions. What it does, learns and saves stays the same, to the bit; it takes less time.

    Nothing changes for a policy that is no ``ActorCriticPolicy``, or has a method of its own that makes or uses its
    distribution, and for distributions other than SB3's categorical, multi-categorical, Bernoulli and diagonal Gaussian ones
    (gSDE, the maskable ones of sb3-contrib).

    An action is never drawn from NaN, as with torch's distributions. Where it came from is said by a
    :class:`~sb3_cchain.algorithms.FiniteCheck` among the callbacks, which looks at the policy once per rollout.

    :param model: A model of any on-policy algorithm
    :return: The same model
    """
    policy = uncompiled(model.policy)
    if not isinstance(policy, ActorCriticPolicy):
        return model
    # The very class: a subclass may do something else
    make = _LEAN.get(type(policy.action_dist))
    if make is not None and is_sb3s(policy.action_dist) and all(_is_method_of_sb3(getattr(policy, name)) for name in _METHODS):
        policy.action_dist = make(policy.action_dist)
    return model


# Of a policy, those that make its distribution or use it
_METHODS = ("_get_action_dist_from_latent", "get_distribution", "forward", "evaluate_actions", "_predict")


def _is_method_of_sb3(method: Callable[..., Any]) -> bool:
    return method.__module__.startswith(("stable_baselines3.", "sb3_contrib."))
