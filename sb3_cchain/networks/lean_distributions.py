"""
SB3's action distributions without what they spend beside their arithmetic: the same operations in the same order, so the same
numbers to the bit, random draws and gradients included.

For one observation, building and checking ``torch.distributions`` takes as long as a small network.
"""

import math
from collections.abc import Callable
from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.distributions import (
    BernoulliDistribution,
    CategoricalDistribution,
    DiagGaussianDistribution,
    Distribution,
    MultiCategoricalDistribution,
    sum_independent_dims,
)
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from torch.distributions import Bernoulli, Categorical, Normal
from torch.nn import functional as F

from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.networks.policy_outputs import has_own_distribution

OnPolicyModel = TypeVar("OnPolicyModel", bound=OnPolicyAlgorithm)


class LeanCategorical(CategoricalDistribution):
    """SB3's, without torch's ``Categorical``."""

    def proba_distribution(self, action_logits: th.Tensor) -> "LeanCategorical":
        """
        :param action_logits: Logits, ``(batch_size, n_actions)``
        :return: self
        """
        self.action_logits = action_logits
        self.log_probs = _log_probs(action_logits)
        return self

    @property
    def distribution(self) -> Categorical:  # type: ignore[override]
        """As SB3 has it. Nothing here uses it."""
        return Categorical(logits=self.action_logits)

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """
        :param actions: Actions, ``(batch_size,)``
        :return: Log-probabilities, ``(batch_size,)``
        """
        return _log_prob(self.log_probs, actions)

    def entropy(self) -> th.Tensor:
        """
        :return: Entropies, ``(batch_size,)``
        """
        return _entropy(self.log_probs)

    def sample(self) -> th.Tensor:
        """
        :return: Actions, ``(batch_size,)``
        """
        return _sample(self.log_probs)

    def mode(self) -> th.Tensor:
        """
        :return: Most probable actions, ``(batch_size,)``
        """
        return _mode(self.log_probs)


class LeanMultiCategorical(MultiCategoricalDistribution):
    """SB3's, without torch's ``Categorical``."""

    def proba_distribution(self, action_logits: th.Tensor) -> "LeanMultiCategorical":
        """
        :param action_logits: Logits of all sub-actions, ``(batch_size, sum of their numbers of values)``
        :return: self
        """
        self.action_logits = action_logits.split(list(self.action_dims), dim=1)
        self.log_probs = [_log_probs(logits) for logits in self.action_logits]
        return self

    @property
    def distribution(self) -> list[Categorical]:  # type: ignore[override]
        """As SB3 has it. Nothing here uses it."""
        return [Categorical(logits=logits) for logits in self.action_logits]

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """
        :param actions: Actions, ``(batch_size, n_sub_actions)``
        :return: Log-probabilities, ``(batch_size,)``
        """
        return self._stack(map(_log_prob, self.log_probs, actions.unbind(dim=1))).sum(dim=1)

    def entropy(self) -> th.Tensor:
        """
        :return: Entropies, ``(batch_size,)``
        """
        return self._stack(map(_entropy, self.log_probs)).sum(dim=1)

    def sample(self) -> th.Tensor:
        """
        :return: Actions, ``(batch_size, n_sub_actions)``
        """
        return self._stack(map(_sample, self.log_probs))

    def mode(self) -> th.Tensor:
        """
        :return: Most probable actions, ``(batch_size, n_sub_actions)``
        """
        return self._stack(map(_mode, self.log_probs))

    @staticmethod
    def _stack(of_sub_actions: Any) -> th.Tensor:
        return th.stack(list(of_sub_actions), dim=1)


# A categorical distribution of logarithms of probabilities, ``(batch_size, n_actions)``


def _log_probs(logits: th.Tensor) -> th.Tensor:
    return logits - logits.logsumexp(dim=-1, keepdim=True)


def _log_prob(log_probs: th.Tensor, actions: th.Tensor) -> th.Tensor:
    return log_probs.gather(-1, actions.long().unsqueeze(-1)).squeeze(-1)


def _entropy(log_probs: th.Tensor) -> th.Tensor:
    # The least number in place of minus infinity: its product with a probability of 0 is 0
    finite = log_probs.clamp(min=th.finfo(log_probs.dtype).min)
    return -(finite * log_probs.softmax(dim=-1)).sum(-1)


def _sample(log_probs: th.Tensor) -> th.Tensor:
    return th.multinomial(log_probs.softmax(dim=-1), 1, replacement=True).squeeze(-1)


def _mode(log_probs: th.Tensor) -> th.Tensor:
    return log_probs.softmax(dim=-1).argmax(dim=1)


class LeanBernoulli(BernoulliDistribution):
    """SB3's, without torch's ``Bernoulli``."""

    def proba_distribution(self, action_logits: th.Tensor) -> "LeanBernoulli":
        """
        :param action_logits: Logits, ``(batch_size, n_sub_actions)``
        :return: self
        """
        self.action_logits = action_logits
        return self

    @property
    def distribution(self) -> Bernoulli:  # type: ignore[override]
        """As SB3 has it. Nothing here uses it."""
        return Bernoulli(logits=self.action_logits)

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """
        :param actions: Actions, ``(batch_size, n_sub_actions)``
        :return: Log-probabilities, ``(batch_size,)``
        """
        return -F.binary_cross_entropy_with_logits(self.action_logits, actions, reduction="none").sum(dim=1)

    def entropy(self) -> th.Tensor:
        """
        :return: Entropies, ``(batch_size,)``
        """
        probs = self.action_logits.sigmoid()
        return F.binary_cross_entropy_with_logits(self.action_logits, probs, reduction="none").sum(dim=1)

    def sample(self) -> th.Tensor:
        """
        :return: Actions, ``(batch_size, n_sub_actions)``
        """
        return self.action_logits.detach().sigmoid().bernoulli()

    def mode(self) -> th.Tensor:
        """
        :return: Most probable actions, ``(batch_size, n_sub_actions)``
        """
        return self.action_logits.sigmoid().round()


class LeanDiagGaussian(DiagGaussianDistribution):
    """SB3's, without torch's ``Normal``."""

    def proba_distribution(self, mean_actions: th.Tensor, log_std: th.Tensor) -> "LeanDiagGaussian":
        """
        :param mean_actions: Means, ``(batch_size, action_dim)``
        :param log_std: Logarithms of the standard deviations, ``(action_dim,)``
        :return: self
        """
        self.mean_actions = mean_actions
        self.action_std = th.ones_like(mean_actions) * log_std.exp()
        return self

    @property
    def distribution(self) -> Normal:  # type: ignore[override]
        """As SB3 has it. Nothing here uses it."""
        return Normal(self.mean_actions, self.action_std)

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """
        :param actions: Actions, ``(batch_size, action_dim)``
        :return: Log-densities, ``(batch_size,)``
        """
        exponents = -((actions - self.mean_actions) ** 2) / (2 * self.action_std**2)
        return sum_independent_dims(exponents - self.action_std.log() - math.log(math.sqrt(2 * math.pi)))

    def entropy(self) -> th.Tensor:
        """
        :return: Entropies, ``(batch_size,)``
        """
        return sum_independent_dims(0.5 + 0.5 * math.log(2 * math.pi) + self.action_std.log())

    def sample(self) -> th.Tensor:
        """
        :return: Actions, ``(batch_size, action_dim)``, with the gradient of the parameters
        """
        noise = th.empty(self.mean_actions.shape, dtype=self.mean_actions.dtype, device=self.mean_actions.device).normal_()
        return self.mean_actions + noise * self.action_std

    def mode(self) -> th.Tensor:
        """
        :return: Means, ``(batch_size, action_dim)``
        """
        return self.mean_actions


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

    Nothing changes for a policy that makes its distribution in its own way, and where the distribution is none of SB3's
    categorical, multi-categorical, Bernoulli and diagonal Gaussian ones (gSDE, the maskable ones of sb3-contrib).

    The checks for NaN that torch's distributions make at every step are gone, too. A
    :class:`~sb3_cchain.FiniteCheck` among the callbacks makes one per rollout.

    :param model: A model of any on-policy algorithm
    :return: The same model
    """
    policy = uncompiled(model.policy)
    # The very class: a subclass may do something else
    make = _LEAN.get(type(policy.action_dist))
    if make is not None and not has_own_distribution(type(policy)):
        policy.action_dist = make(policy.action_dist)
    return model
