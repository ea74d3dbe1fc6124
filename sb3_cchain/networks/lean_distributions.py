"""
SB3's action distributions without what they spend beside their arithmetic: the same operations in the same order, so the same
numbers to the bit, random draws and gradients included.

For one observation, building and checking ``torch.distributions`` takes as long as a small network.
"""

import math
from collections.abc import Callable
from functools import cached_property
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


class _Categorical:
    """What policies ask of torch's ``Categorical``, with its attributes' names: logits are ``(batch_size, n_actions)``."""

    def __init__(self, logits: th.Tensor):
        self.logits = logits - logits.logsumexp(dim=-1, keepdim=True)

    @cached_property
    def probs(self) -> th.Tensor:
        return self.logits.softmax(dim=-1)

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        return self.logits.gather(-1, actions.long().unsqueeze(-1)).squeeze(-1)

    def entropy(self) -> th.Tensor:
        # The least number in place of minus infinity: its product with a probability of 0 is 0
        finite = self.logits.clamp(min=th.finfo(self.logits.dtype).min)
        return -(finite * self.probs).sum(-1)

    def sample(self) -> th.Tensor:
        probs = self.probs
        if probs.device.type != "cpu":  # where multinomial() would end the process
            return th.multinomial(_without_nan(probs), 1, replacement=True).squeeze(-1)
        try:  # it looks for NaN itself
            return th.multinomial(probs, 1, replacement=True).squeeze(-1)
        except RuntimeError as error:
            raise ValueError(NAN_OUTPUTS) from error

    def mode(self) -> th.Tensor:
        return _without_nan(self.probs).argmax(dim=1)


def _is_torchs(distribution: Distribution) -> bool:
    """Whether torch's distribution was asked for or put there: it counts from then on, because it may have been changed."""
    return "distribution" in vars(distribution)


class LeanCategorical(CategoricalDistribution):
    """SB3's, without torch's ``Categorical``."""

    def proba_distribution(self, action_logits: th.Tensor) -> "LeanCategorical":
        """
        :param action_logits: Logits, ``(batch_size, n_actions)``
        :return: self
        """
        vars(self).pop("distribution", None)
        self._action_logits = action_logits
        self._lean = _Categorical(action_logits)
        return self

    @cached_property
    def distribution(self) -> Categorical:  # type: ignore[override]
        """Torch's, as SB3 has it, made when it is asked for."""
        return Categorical(logits=self._action_logits)

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """
        :param actions: Actions, ``(batch_size,)``
        :return: Log-probabilities, ``(batch_size,)``
        """
        if _is_torchs(self):
            return super().log_prob(actions)
        return self._lean.log_prob(actions)

    def entropy(self) -> th.Tensor:
        """
        :return: Entropies, ``(batch_size,)``
        """
        if _is_torchs(self):
            return super().entropy()
        return self._lean.entropy()

    def sample(self) -> th.Tensor:
        """
        :return: Actions, ``(batch_size,)``
        """
        if _is_torchs(self):
            return super().sample()
        return self._lean.sample()

    def mode(self) -> th.Tensor:
        """
        :return: Most probable actions, ``(batch_size,)``
        """
        if _is_torchs(self):
            return super().mode()
        return self._lean.mode()


class LeanMultiCategorical(MultiCategoricalDistribution):
    """SB3's, without torch's ``Categorical``."""

    def proba_distribution(self, action_logits: th.Tensor) -> "LeanMultiCategorical":
        """
        :param action_logits: Logits of all sub-actions, ``(batch_size, sum of their numbers of values)``
        :return: self
        """
        vars(self).pop("distribution", None)
        self._action_logits = action_logits.split(list(self.action_dims), dim=1)
        self._lean = [_Categorical(logits) for logits in self._action_logits]
        return self

    @cached_property
    def distribution(self) -> list[Categorical]:  # type: ignore[override]
        """Torch's, as SB3 has them, made when they are asked for."""
        return [Categorical(logits=logits) for logits in self._action_logits]

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """
        :param actions: Actions, ``(batch_size, n_sub_actions)``
        :return: Log-probabilities, ``(batch_size,)``
        """
        if _is_torchs(self):
            return super().log_prob(actions)
        sub_actions = actions.unbind(dim=1)
        return th.stack([lean.log_prob(action) for lean, action in zip(self._lean, sub_actions, strict=True)], dim=1).sum(
            dim=1
        )

    def entropy(self) -> th.Tensor:
        """
        :return: Entropies, ``(batch_size,)``
        """
        if _is_torchs(self):
            return super().entropy()
        return th.stack([lean.entropy() for lean in self._lean], dim=1).sum(dim=1)

    def sample(self) -> th.Tensor:
        """
        :return: Actions, ``(batch_size, n_sub_actions)``
        """
        if _is_torchs(self):
            return super().sample()
        return th.stack([lean.sample() for lean in self._lean], dim=1)

    def mode(self) -> th.Tensor:
        """
        :return: Most probable actions, ``(batch_size, n_sub_actions)``
        """
        if _is_torchs(self):
            return super().mode()
        return th.stack([lean.mode() for lean in self._lean], dim=1)


class LeanBernoulli(BernoulliDistribution):
    """SB3's, without torch's ``Bernoulli``."""

    def proba_distribution(self, action_logits: th.Tensor) -> "LeanBernoulli":
        """
        :param action_logits: Logits, ``(batch_size, n_sub_actions)``
        :return: self
        """
        vars(self).pop("distribution", None)
        self._action_logits = action_logits
        return self

    @cached_property
    def distribution(self) -> Bernoulli:  # type: ignore[override]
        """Torch's, as SB3 has it, made when it is asked for."""
        return Bernoulli(logits=self._action_logits)

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """
        :param actions: Actions, ``(batch_size, n_sub_actions)``
        :return: Log-probabilities, ``(batch_size,)``
        """
        if _is_torchs(self):
            return super().log_prob(actions)
        return (-F.binary_cross_entropy_with_logits(self._action_logits, actions, reduction="none")).sum(dim=1)

    def entropy(self) -> th.Tensor:
        """
        :return: Entropies, ``(batch_size,)``
        """
        if _is_torchs(self):
            return super().entropy()
        probs = self._action_logits.sigmoid()
        return F.binary_cross_entropy_with_logits(self._action_logits, probs, reduction="none").sum(dim=1)

    def sample(self) -> th.Tensor:
        """
        :return: Actions, ``(batch_size, n_sub_actions)``
        """
        if _is_torchs(self):
            return super().sample()
        return _without_nan(self._action_logits.detach().sigmoid()).bernoulli()

    def mode(self) -> th.Tensor:
        """
        :return: Most probable actions, ``(batch_size, n_sub_actions)``
        """
        if _is_torchs(self):
            return super().mode()
        return _without_nan(self._action_logits.sigmoid()).round()


class LeanDiagGaussian(DiagGaussianDistribution):
    """SB3's, without torch's ``Normal``."""

    def proba_distribution(self, mean_actions: th.Tensor, log_std: th.Tensor) -> "LeanDiagGaussian":
        """
        :param mean_actions: Means, ``(batch_size, action_dim)``
        :param log_std: Logarithms of the standard deviations, ``(action_dim,)``
        :return: self
        """
        vars(self).pop("distribution", None)
        self._mean = mean_actions
        self._std = th.ones_like(mean_actions) * log_std.exp()
        return self

    @cached_property
    def distribution(self) -> Normal:  # type: ignore[override]
        """Torch's, as SB3 has it, made when it is asked for."""
        return Normal(self._mean, self._std)

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """
        :param actions: Actions, ``(batch_size, action_dim)``
        :return: Log-densities, ``(batch_size,)``
        """
        if _is_torchs(self):
            return super().log_prob(actions)
        variance = self._std**2
        squares = -((actions - self._mean) ** 2) / (2 * variance)
        return sum_independent_dims(squares - self._std.log() - math.log(math.sqrt(2 * math.pi)))

    def entropy(self) -> th.Tensor:
        """
        :return: Entropies, ``(batch_size,)``
        """
        if _is_torchs(self):
            return sum_independent_dims(self.distribution.entropy())
        return sum_independent_dims(0.5 + 0.5 * math.log(2 * math.pi) + self._std.log())

    def sample(self) -> th.Tensor:
        """
        :return: Actions, ``(batch_size, action_dim)``, through which gradients flow
        """
        if _is_torchs(self):
            return super().sample()
        noise = th.empty(self._mean.shape, dtype=self._mean.dtype, device=self._mean.device).normal_()
        return _without_nan(self._mean + noise * self._std)

    def mode(self) -> th.Tensor:
        """
        :return: Means, ``(batch_size, action_dim)``
        """
        if _is_torchs(self):
            return super().mode()
        return _without_nan(self._mean)


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

    Nothing changes for a policy with a method of its own that makes or uses its distribution, and for distributions other than
    SB3's categorical, multi-categorical, Bernoulli and diagonal Gaussian ones (gSDE, the maskable ones of sb3-contrib).

    An action is never drawn from NaN, as with torch's distributions. Where it came from is said by a
    :class:`~sb3_cchain.algorithms.FiniteCheck` among the callbacks, which looks at the policy once per rollout.

    :param model: A model of any on-policy algorithm
    :return: The same model
    """
    policy = uncompiled(model.policy)
    # The very class: a subclass may do something else
    make = _LEAN.get(type(policy.action_dist))
    if make is not None and is_sb3s(policy.action_dist) and all(_is_method_of_sb3(getattr(policy, name)) for name in _METHODS):
        policy.action_dist = make(policy.action_dist)
    return model


# Of a policy, those that make its distribution or use it
_METHODS = ("_get_action_dist_from_latent", "get_distribution", "forward", "evaluate_actions", "_predict")


def _is_method_of_sb3(method: Callable[..., Any]) -> bool:
    return method.__module__.startswith(("stable_baselines3.", "sb3_contrib."))
