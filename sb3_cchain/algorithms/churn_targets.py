"""What churn reduction holds still, for each algorithm of Stable-Baselines3 and sb3-contrib."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.distributions import (
    BernoulliDistribution,
    CategoricalDistribution,
    DiagGaussianDistribution,
    MultiCategoricalDistribution,
)
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_cchain.churn import ChurnCoefficient, ChurnReducer, ChurnReducers, make_coefficient
from sb3_cchain.churn.divergence import Divergence, cross_entropy, mean_squared_difference
from sb3_cchain.churn.reducer import Observations
from sb3_cchain.networks.batch_outputs import (
    OutputsOf,
    action_quantiles,
    action_values,
    actor_critic_actions,
    actor_critic_values,
    critic_values,
    deterministic_actions,
    recurrent_actions,
    recurrent_values,
)
from sb3_cchain.networks.policy_outputs import has_own_distribution
from sb3_cchain.validation import check_choice

# The names in `churn_target`
CHURN_TARGETS = ("auto", "policy", "value", "both")


def policy_divergence(policy: Any) -> Divergence:
    """
    :param policy: An actor-critic policy
    :return: Cross-entropy where actions are discrete, mean squared difference of the action means where they are Gaussian
    :raises TypeError: For an action distribution that is neither, or where there is none to ask for
    """
    if not hasattr(policy, "mlp_extractor") and not has_own_distribution(policy):
        raise TypeError(
            f"Churn reduction needs the action distribution of {type(policy).__name__}, which has no networks of SB3's: "
            'define `get_distribution(observations)`, or hold the values still (churn_target="value").'
        )
    distribution = policy.action_dist
    # Those of sb3-contrib's MaskablePPO have no common base with them
    if isinstance(distribution, (CategoricalDistribution, MultiCategoricalDistribution, BernoulliDistribution)) or (
        type(distribution).__name__.startswith("Maskable")
    ):
        return cross_entropy
    # StateDependentNoiseDistribution (gSDE) has no common base with it but is a Gaussian too
    if isinstance(distribution, DiagGaussianDistribution) or policy.use_sde:
        return mean_squared_difference
    raise TypeError(
        f"Churn reduction does not know the outputs of {type(distribution).__name__}. It supports categorical, "
        "multi-categorical, Bernoulli, diagonal Gaussian and state-dependent (gSDE) action distributions."
    )


def squared_difference(policy: BasePolicy) -> Divergence:
    """
    :param policy: Any policy
    :return: Mean squared difference
    """
    return mean_squared_difference


@dataclass(frozen=True)
class ChurnTarget:
    """
    Outputs that are held still.

    :param outputs: The outputs of a batch, with gradient
    :param losses: Names of the logged losses that the churn loss is compared with, each with the attribute of the model that
        it is multiplied by. Their sum is the base loss L.
    :param target_ratios: The default β for each divergence
    :param divergence: How far a policy's outputs moved
    :param optimizer: Name of the optimiser, as of :func:`~sb3_cchain.networks.model_optimizers.model_optimizers`
    :param needs: What a reference batch holds beside the observations. A batch that needs nothing else is the observations
        themselves.
    """

    outputs: OutputsOf
    losses: Mapping[str, str | None]
    target_ratios: Mapping[Divergence, float]
    divergence: Callable[[Any], Divergence] = squared_difference
    optimizer: str = ""
    needs: tuple[str, ...] = ()

    def of_reference(self, reference: Observations, policy: Any) -> th.Tensor:
        """
        :param reference: A reference batch
        :param policy: A policy
        :return: Its outputs
        """
        if self.needs:
            assert isinstance(reference, dict)
            return self.outputs(policy, reference)
        return self.outputs(policy, {"observations": reference})

    def base_loss(self, model: BaseAlgorithm, logged: Mapping[str, float], without_entropy: bool = False) -> float:
        """
        :param model: A model, right after its ``train()``
        :param logged: What ``train()`` has given to ``record()``
        :param without_entropy: Whether only the first of the losses counts
        :return: L
        :raises ValueError: When ``train()`` has not logged what L is made of
        """
        # By `record_mean()`, too, or on a logger that `train()` put in place
        logged = {**getattr(model.logger, "name_to_value", {}), **logged}
        losses = list(self.losses.items())[:1] if without_entropy else list(self.losses.items())
        missing = [name for name, _ in losses if name not in logged]
        if missing:
            raise ValueError(
                f"`train()` of {type(model).__name__} must log {' and '.join(missing)}, as SB3's does: churn reduction "
                "measures the churn loss by it"
            )
        return sum(logged[name] * (1.0 if factor is None else getattr(model, factor)) for name, factor in losses)


@dataclass(frozen=True)
class ChurnKind:
    """
    Churn reduction of an algorithm.

    :param targets: What it can hold still, by name
    :param default: What it holds still by default
    :param warmup: Iterations until λ adapts, by default
    :param window: Iterations that the running means of the losses cover, by default
    :param without_policy: Why there is no ``"policy"``, for an algorithm that has none to hold still
    """

    targets: Mapping[str, ChurnTarget]
    default: str
    warmup: int = 0
    window: int = 1000
    without_policy: str = ""


# β when `target_churn_ratio="auto"`. Tang et al. (ICML 2025) use 1e3, 1e4 (default of the released code) or 1e5 with the
# cross-entropy of discrete policies, 0.05 or 0.5 with the mean squared difference of action means, and 0.01 with action values
_OF_POLICIES: dict[Divergence, float] = {cross_entropy: 1e4, mean_squared_difference: 0.05}
# With 1e4, MaskablePPO and RecurrentPPO learned more slowly after switches than without churn reduction
# (docs/results/family.md)
_OF_MASKED_AND_RECURRENT: dict[Divergence, float] = {cross_entropy: 1e2, mean_squared_difference: 0.05}
_OF_VALUES: dict[Divergence, float] = {mean_squared_difference: 0.01}
# Where 0.01 made learning slower, or in some seeds worse, or stopped it after a switch (docs/modules/family.md)
_OF_SENSITIVE_VALUES: dict[Divergence, float] = {mean_squared_difference: 1e-3}
# A2C's policy loss, of advantages that are not normalised, is about a hundred times PPO's clipped surrogate, which is near 0.
# With PPO's β it learns next to nothing (docs/modules/family.md)
_OF_A2C: dict[Divergence, float] = {cross_entropy: 10.0, mean_squared_difference: 5e-5}
# Released code of Tang and Berseth (NeurIPS 2024) for TD3
_OF_ACTIONS: dict[Divergence, float] = {mean_squared_difference: 5e-5}
# With 5e-5 SAC hardly learned in Walker (docs/results/family.md)
_OF_SENSITIVE_ACTIONS: dict[Divergence, float] = {mean_squared_difference: 5e-6}

_PPO_LOSSES = {"train/policy_gradient_loss": None, "train/entropy_loss": "ent_coef"}
_A2C_LOSSES = {"train/policy_loss": None, "train/entropy_loss": "ent_coef"}
_VALUE_LOSS = {"train/value_loss": "vf_coef"}
_SEQUENCES = ("lstm_states", "episode_starts", "mask")

_POLICY = ChurnTarget(actor_critic_actions, _PPO_LOSSES, _OF_POLICIES, policy_divergence)
_VALUE = ChurnTarget(actor_critic_values, _VALUE_LOSS, _OF_VALUES)
_ACTOR_LOSS = {"train/actor_loss": None}
_ACTOR = ChurnTarget(deterministic_actions, _ACTOR_LOSS, _OF_ACTIONS, optimizer="actor")
_SENSITIVE_ACTOR = ChurnTarget(deterministic_actions, _ACTOR_LOSS, _OF_SENSITIVE_ACTIONS, optimizer="actor")
_CRITIC = ChurnTarget(critic_values, {"train/critic_loss": None}, _OF_SENSITIVE_VALUES, optimizer="critic", needs=("actions",))
_VALUE_OF_A2C = ChurnTarget(actor_critic_values, _VALUE_LOSS, _OF_SENSITIVE_VALUES)
_NO_POLICY = "it has no policy of its own: its actions follow from the values"

# By the name of the algorithm, because sb3-contrib need not be installed
KINDS = {
    "PPO": ChurnKind({"policy": _POLICY, "value": _VALUE}, "policy", warmup=10, window=50),
    "MaskablePPO": ChurnKind(
        {
            "policy": ChurnTarget(
                actor_critic_actions, _PPO_LOSSES, _OF_MASKED_AND_RECURRENT, policy_divergence, needs=("action_masks",)
            ),
            "value": _VALUE,
        },
        default="policy",
        warmup=10,
        window=50,
    ),
    "RecurrentPPO": ChurnKind(
        {
            "policy": ChurnTarget(
                recurrent_actions, _PPO_LOSSES, _OF_MASKED_AND_RECURRENT, policy_divergence, needs=_SEQUENCES
            ),
            "value": ChurnTarget(recurrent_values, _VALUE_LOSS, _OF_VALUES, needs=_SEQUENCES),
        },
        default="policy",
        warmup=10,
        window=50,
    ),
    # One update in each iteration
    "A2C": ChurnKind(
        {"policy": ChurnTarget(actor_critic_actions, _A2C_LOSSES, _OF_A2C, policy_divergence), "value": _VALUE_OF_A2C},
        "policy",
    ),
    "TRPO": ChurnKind(
        {"value": ChurnTarget(actor_critic_values, {"train/value_loss": None}, _OF_SENSITIVE_VALUES)},
        default="value",
        warmup=0,
        window=50,
        without_policy="its policy has no optimiser, and its step is bounded in KL divergence already",
    ),
    "DQN": ChurnKind(
        {"value": ChurnTarget(action_values, {"train/loss": None}, _OF_VALUES)}, "value", without_policy=_NO_POLICY
    ),
    "QRDQN": ChurnKind(
        {"value": ChurnTarget(action_quantiles, {"train/loss": None}, _OF_SENSITIVE_VALUES)},
        "value",
        without_policy=_NO_POLICY,
    ),
    **dict.fromkeys(("SAC", "TQC"), ChurnKind({"policy": _SENSITIVE_ACTOR, "value": _CRITIC}, default="policy")),
    **dict.fromkeys(("CrossQ", "TD3"), ChurnKind({"policy": _ACTOR, "value": _CRITIC}, default="policy")),  # DDPG is a TD3
}


def churn_kind(algorithm: type[BaseAlgorithm]) -> ChurnKind:
    """
    :param algorithm: Class of an algorithm, or a subclass of one
    :return: Its churn reduction
    :raises TypeError: For an algorithm that is not known here
    """
    for base in algorithm.__mro__:
        if base.__name__ in KINDS:
            return KINDS[base.__name__]
    raise TypeError(f"Churn reduction is for {', '.join(KINDS)} and DDPG, got {algorithm.__name__}")


@dataclass(frozen=True)
class ChurnArguments:
    """
    The arguments that all forms of churn reduction have, by their names.

    :param churn_target: ``"policy"``, ``"value"``, ``"both"``, or ``"auto"`` for the algorithm's default
    :param churn_coef: λ, one for all or a dict of one for each target
    :param target_churn_ratio: β, one for all or a dict of one for each target
    :param churn_warmup: Iterations until λ adapts; None for the algorithm's default
    :param churn_window: Iterations that the running means of both losses cover; None for the algorithm's default
    :param churn_coef_min: Least value of λ once it adapts
    """

    churn_target: str = "auto"
    churn_coef: float | str | dict[str, float | str] = "auto"
    target_churn_ratio: float | str | dict[str, float | str] = "auto"
    churn_warmup: int | None = None
    churn_window: int | None = None
    churn_coef_min: float = 0.0

    def check(self) -> None:
        """
        Raise on values that no algorithm takes.

        :raises ValueError: Naming the argument that is out of its range
        """
        check_choice("churn_target", self.churn_target, CHURN_TARGETS)
        for argument in ("churn_coef", "target_churn_ratio"):
            value = getattr(self, argument)
            if isinstance(value, dict) and not (value and set(value) <= {"policy", "value"}):
                raise ValueError(f"`{argument}` must be one value or a dict with the keys 'policy' and 'value', got {value!r}")
        for name in ("policy", "value"):
            self.make_coefficient(name, _ANY, default_target_ratio=1.0)

    def target_names(self, kind: ChurnKind, algorithm: str) -> tuple[str, ...]:
        """
        :param kind: Churn reduction of the algorithm
        :param algorithm: Name of the algorithm, for the error
        :return: What is held still
        :raises ValueError: When the algorithm has no such target, or a dict is not of these targets
        """
        chosen = kind.default if self.churn_target == "auto" else self.churn_target
        names = ("policy", "value") if chosen == "both" else (chosen,)
        if "policy" in names and "policy" not in kind.targets:
            raise ValueError(
                f'`churn_target` of {algorithm} must be "value" ({kind.without_policy}), got {self.churn_target!r}'
            )
        for argument in ("churn_coef", "target_churn_ratio"):
            value = getattr(self, argument)
            if isinstance(value, dict) and set(value) != set(names):
                raise ValueError(f"`{argument}` must be one value or a dict with the keys {list(names)}, got {value!r}")
        return names

    def make_coefficient(self, name: str, kind: ChurnKind, default_target_ratio: float) -> ChurnCoefficient:
        """
        :param name: Name of a target
        :param kind: Churn reduction of the algorithm
        :param default_target_ratio: The default β
        :return: Its λ
        """
        return make_coefficient(
            _of_target(self.churn_coef, name),
            _of_target(self.target_churn_ratio, name),
            default_target_ratio,
            warmup=kind.warmup if self.churn_warmup is None else self.churn_warmup,
            window=kind.window if self.churn_window is None else self.churn_window,
            minimum=self.churn_coef_min,
        )

    def make_reducers(self, model: Any) -> ChurnReducers:
        """
        :param model: A model, whose policy exists
        :return: A churn reducer for each target, by name
        :raises ValueError: When the algorithm has no such target
        :raises TypeError: When the algorithm, or the policy's action distribution, is not supported
        """
        kind = churn_kind(type(model))
        reducers = ChurnReducers()
        _say_when_there_is_no_other_data(model)
        for name in self.target_names(kind, type(model).__name__):
            target = kind.targets[name]
            # Without churn reduction any policy will do
            is_off = self.make_coefficient(name, kind, 1.0).is_zero
            divergence = mean_squared_difference if is_off else target.divergence(model.policy)
            # The reducer is given the policy at each call: a model that it held would be freed by the garbage collector alone
            reducers[name] = ChurnReducer(
                target.of_reference, divergence, self.make_coefficient(name, kind, target.target_ratios[divergence])
            )
        return reducers


def _say_when_there_is_no_other_data(model: Any) -> None:
    batch_size = getattr(model, "batch_size", None)  # A2C has none
    if model.verbose >= 1 and isinstance(model, OnPolicyAlgorithm) and batch_size is not None:
        n_samples = model.n_steps * model.n_envs
        if n_samples <= batch_size:
            print(
                f"A rollout of n_steps * n_envs = {n_samples} steps is a single minibatch of "
                f"batch_size={batch_size}: there is no data outside it to measure churn on, so the minibatch is its own "
                "reference batch. Choose a `batch_size` of at most half a rollout."
            )


# Stands for an algorithm that is not yet known
_ANY = ChurnKind({}, "")


def _of_target(value: float | str | dict[str, float | str], name: str) -> float | str:
    if isinstance(value, dict):
        return value[name] if name in value else next(iter(value.values()))
    return value
