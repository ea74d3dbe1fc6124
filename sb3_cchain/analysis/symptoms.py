"""What the doctor measures in a model: how it acts, its units and weights, its values, its updates."""

import math
import re
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.distributions import StateDependentNoiseDistribution
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from torch import nn

from sb3_cchain.algorithms.replay_observations import unchanged
from sb3_cchain.analysis.health_figures import group_of, hidden_activations, trained_groups, unit_outputs
from sb3_cchain.analysis.metrics.dormancy import dormant_scores, mean_activity
from sb3_cchain.analysis.metrics.rank import singular_values, srank
from sb3_cchain.analysis.model_outputs import ModelOutputs, model_outputs
from sb3_cchain.networks.batch_outputs import Batch, policy_kind
from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.networks.evaluation_mode import evaluation_mode
from sb3_cchain.networks.policy_inputs import episode_start

# By name; of parts of the networks by "name/part"
Symptoms = dict[str, float]

# A unit of a bounded activation function, or an action, within 1 % of its bound counts as saturated
SATURATED = 0.99
# Greatest score of a unit that is dormant, Sokar et al. (2023)
DORMANT = 0.025
# Groups of layers that end in values
_OF_VALUES = re.compile("value_net|critic|q_net|quantile_net")
_BOUNDED_UNITS: dict[type[nn.Module], tuple[float, float]] = {nn.Tanh: (-1.0, 1.0), nn.Sigmoid: (0.0, 1.0)}


def acting_symptoms(model: BaseAlgorithm, batch: Batch, outputs: ModelOutputs) -> Symptoms:
    """
    How the model acts.

    - ``action_diversity``: how different its actions are over the batch's observations, from 0 (always the same) to 1 (all
      equally often). Of actions that are chosen from a list, the entropy of how often each is taken, divided by that of a
      uniform choice; of continuous ones, their standard deviation, divided by half their range, which may be more than 1.
    - ``exploration``: the same, but what of it is chance, for one observation: the mean entropy, the standard deviation of the
      distribution or of the action noise, or, of DQN and QRDQN, ε. Not for ARS, and not for action noise of unknown kinds.
    - ``saturated_actions``: share of continuous actions that are, before noise, within 1 % of a bound or beyond it

    :param model: A model
    :param batch: Observations, with what belongs to them
    :param outputs: Its outputs on the batch
    :return: Those that it has, by name
    """
    symptoms: Symptoms = {}
    exploration = _exploration(model, batch, outputs)
    if outputs.action_means is not None:
        low, high, scale = _bounds(model)
        means = outputs.action_means
        if model.policy.squash_output and isinstance(model, OnPolicyAlgorithm):
            means = means.tanh()
        actions = means.clamp(low, high)
        spread = actions.var(dim=0, unbiased=False)
        noise = th.zeros_like(low) if exploration is None else exploration * th.ones_like(low)
        symptoms["action_diversity"] = ((spread / scale**2 + noise**2).sqrt()).mean().item()
        beyond = ((means - (low + scale)) / scale).abs() > SATURATED
        symptoms["saturated_actions"] = beyond.float().mean().item()
    else:
        symptoms["action_diversity"] = _diversity(model, outputs)
    if exploration is not None:
        symptoms["exploration"] = float(exploration.mean())
    return symptoms


def _bounds(model: BaseAlgorithm) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    """Of the actions as the networks give them: least and greatest, and half the range. SB3 takes finite bounds only."""
    space = model.action_space
    assert isinstance(space, spaces.Box)
    low, high = (th.as_tensor(bound.flatten(), device=model.device, dtype=th.float32) for bound in (space.low, space.high))
    if model.policy.squash_output:
        low, high = -th.ones_like(low), th.ones_like(high)
    return low, high, high / 2 - low / 2


def _diversity(model: BaseAlgorithm, outputs: ModelOutputs) -> float:
    if outputs.probabilities is not None:
        return _relative_entropy(model.action_space, outputs.probabilities.mean(dim=0, keepdim=True)).item()
    assert outputs.greedy_actions is not None
    n_actions = int(model.action_space.n)  # type: ignore[attr-defined]
    counts = th.bincount(outputs.greedy_actions.long().flatten(), minlength=n_actions)
    return _relative_entropy(model.action_space, (counts / counts.sum())[None]).item()


def _relative_entropy(space: spaces.Space[Any], probabilities: th.Tensor) -> th.Tensor:
    """From 0 to 1, of each distribution, ``(n, n_actions)`` or ``(n, n_sub_actions, max_n)``; mean over sub-actions."""
    entropy = th.special.entr(probabilities).sum(dim=-1)
    if isinstance(space, spaces.Discrete):
        return entropy / math.log(max(int(space.n), 2))
    sizes = space.nvec.flatten() if isinstance(space, spaces.MultiDiscrete) else np.full(entropy.shape[-1], 2)
    largest = th.as_tensor(np.log(np.maximum(sizes, 2)), device=entropy.device, dtype=entropy.dtype)
    return (entropy / largest).mean(dim=-1)


def _exploration(model: BaseAlgorithm, batch: Batch, outputs: ModelOutputs) -> th.Tensor | None:
    if outputs.probabilities is not None:
        return _relative_entropy(model.action_space, outputs.probabilities).mean()
    exploration_rate = getattr(model, "exploration_rate", None)
    if exploration_rate is not None:
        return th.tensor(float(exploration_rate))
    if outputs.action_means is None or not isinstance(model, (OnPolicyAlgorithm, OffPolicyAlgorithm)):
        return None
    std = action_std(model, batch)
    if std is not None:
        return std.mean(dim=0) / _bounds(model)[2]
    noise: Any = getattr(model, "action_noise", None)
    if hasattr(noise, "noises"):  # one of each environment
        noise = noise.noises[0]
    sigma = 0.0 if noise is None else getattr(noise, "_sigma", None)
    return None if sigma is None else th.as_tensor(np.asarray(sigma, dtype=np.float32), device=model.device)


def action_std(model: BaseAlgorithm, batch: Batch) -> th.Tensor | None:
    """
    :param model: A model with continuous actions
    :param batch: Observations
    :return: Standard deviation of the Gaussian that its actions are drawn from, before any squashing, ``(n_observations,
        action_dim)`` or ``(1, action_dim)``; None for a deterministic policy
    """
    policy: Any = uncompiled(model.policy)
    observations = batch["observations"]
    with th.no_grad(), evaluation_mode(policy):
        if isinstance(model, OnPolicyAlgorithm):
            if not isinstance(policy.action_dist, StateDependentNoiseDistribution):
                return policy.log_std.exp().reshape(1, -1)
            if hasattr(policy, "lstm_actor"):
                distribution, _ = policy.get_distribution(observations, *episode_start(policy, observations))
            else:
                distribution = policy.get_distribution(observations)
            return distribution.distribution.stddev
        actor: Any = getattr(policy, "actor", None)
        if not hasattr(actor, "get_action_dist_params"):
            return None
        mean, log_std, latent = actor.get_action_dist_params(observations)
        return actor.action_dist.proba_distribution(mean, log_std, **latent).distribution.stddev


def network_symptoms(model: BaseAlgorithm, batch: Batch) -> Symptoms:
    r"""
    What is in the networks. The first three are of the units behind the activation functions that
    :func:`~sb3_cchain.analysis.health_figures.network_health` finds, and are given for each group of layers or each layer.

    - ``dormant_units``: share of the units with a score of at most 0.025 (Sokar et al., ICML 2023,
      https://arxiv.org/abs/2302.12902)
    - ``saturated_units``: share of the pairs of unit and observation with an output within 1 % of a bound of its activation
      function, for each layer of tanh or sigmoid units. Not for the last hidden layer before values: where values are large,
      it is saturated in healthy models, too.
    - ``feature_rank``: :func:`~sb3_cchain.analysis.metrics.rank.srank` with δ = 0.01 of the features of a group, their mean
      over the batch taken off; 0 where the features are the same for all observations. Not for a single feature.
    - ``weight_gain``: for each weight matrix, :math:`\sqrt{n}` times the root mean square of its entries, for n inputs: what
      it makes of the size of random inputs. 1.4 after PPO's initialisation, 0.6 after PyTorch's. Infinite where a parameter is
      not finite.

    :param model: A model
    :param batch: Observations, with what belongs to them
    :return: By name and part
    """
    policy = uncompiled(model.policy)
    flags: dict[str, list[th.Tensor]] = {}
    features: dict[str, th.Tensor] = {}
    last_of_values: dict[str, str] = {}
    for name, outputs in hidden_activations(policy, batch["observations"]).items():
        module, group = policy.get_submodule(name), group_of(name)
        for output in outputs:
            units = unit_outputs(module, output)
            flags.setdefault(f"dormant_units/{group}", []).append(dormant_scores(mean_activity(units)) <= DORMANT)
            if type(module) in _BOUNDED_UNITS:
                low, high = _BOUNDED_UNITS[type(module)]
                distance = (output - (low + high) / 2).abs() / ((high - low) / 2)
                flags.setdefault(f"saturated_units/{name}", []).append(distance > SATURATED)
            if _OF_VALUES.search(group):
                last_of_values[group] = name
            features[group] = output.flatten(start_dim=1)  # the last one stays
    for name in last_of_values.values():
        flags.pop(f"saturated_units/{name}", None)
    symptoms = {name: th.cat([flag.flatten() for flag in layers]).float().mean().item() for name, layers in flags.items()}
    for group, matrix in features.items():
        if matrix.isfinite().all() and min(matrix.shape) > 1:
            symptoms[f"feature_rank/{group}"] = _centred_rank(matrix)
    return symptoms | weight_symptoms(model)


def _centred_rank(features: th.Tensor) -> float:
    centred = features.double() - features.double().mean(dim=0)
    # What is left of equal features is rounding
    if centred.abs().max() <= 1e-6 * features.abs().max():
        return 0.0
    return float(srank(singular_values(centred)))


def is_finite(model: BaseAlgorithm) -> bool:
    """
    :param model: A model
    :return: Whether all parameters of its policy are numbers
    """
    return all(bool(parameter.isfinite().all()) for parameter in uncompiled(model.policy).parameters())


def weight_symptoms(model: BaseAlgorithm) -> Symptoms:
    """
    :param model: A model
    :return: ``weight_gain``, see :func:`network_symptoms`, of each trained weight matrix; of ARS, which has no optimiser, of
        all
    """
    groups = trained_groups(model) or {"": dict(uncompiled(model.policy).named_parameters())}
    symptoms = {}
    for name, parameter in (item for parameters in groups.values() for item in parameters.items()):
        if not parameter.isfinite().all():
            symptoms[f"weight_gain/{name}"] = math.inf
        elif parameter.dim() > 1:
            matrix = parameter.detach().flatten(start_dim=1)
            symptoms[f"weight_gain/{name}"] = matrix.square().mean().mul(matrix.shape[1]).sqrt().item()
    return symptoms


def value_symptoms(model: OnPolicyAlgorithm | OffPolicyAlgorithm, batch_size: int) -> Symptoms:
    r"""
    What the values are like. They are compared with what they are trained on: of an on-policy algorithm the returns of the
    rollout; off-policy :math:`r + \gamma V(s')` on a batch of the replay buffer, with the networks that act and without
    SAC's entropy. The value of a state is the greatest of its action values (DQN, QRDQN), or the mean of the critics' (of the
    action in the buffer, or of the next one).

    - ``value_spread``: standard deviation of the values, divided by that of their targets; 0 for values that are all the
      same. Not where the targets are all the same.
    - ``value_scale``: root mean square of the targets
    - ``value_excess``: the greatest :math:`|V|`, divided by :math:`\max |r| / (1 - \gamma)`, which no true value exceeds. Only
      off-policy: the rewards of a rollout include what SB3 adds where a time limit ends an episode. With ``n_steps`` above 1,
      the buffer gives sums of rewards :math:`R` and discounts :math:`\gamma^n`, and the bound is
      :math:`\max (|R| / (1 - \gamma^n))`. The entropy bonus of SAC, TQC and CrossQ is not in the bound: where it is large
      beside the rewards, true values exceed it.

    Rewards and values are as the algorithm sees them, after any normalisation.

    :param model: A model with a complete rollout, or a replay buffer
    :param batch_size: Size of the batch of the replay buffer
    :return: By name; nothing where values are NaN or infinite, as those of huge weights are
    """
    if isinstance(model, OnPolicyAlgorithm):
        values, targets = (getattr(model.rollout_buffer, name).astype(np.float64) for name in ("values", "returns"))
        bound = 0.0
    else:
        values, targets, bound = _replayed_values(model, batch_size)
    if not np.isfinite(values).all():
        return {}
    symptoms = {"value_scale": float(np.sqrt(np.mean(targets**2)))}
    if targets.std() > 1e-6 * np.abs(targets).max():
        symptoms["value_spread"] = float(values.std() / targets.std())
    if 0 < bound < math.inf:
        symptoms["value_excess"] = float(np.abs(values).max() / bound)
    return symptoms


def _replayed_values(model: OffPolicyAlgorithm, batch_size: int) -> tuple[NDArray[Any], NDArray[Any], float]:
    """Values, their targets, and the greatest value that the rewards can add up to."""
    assert model.replay_buffer is not None
    with unchanged(model.replay_buffer):
        sample = model.replay_buffer.sample(batch_size, env=model._vec_normalize_env)
    policy: Any = uncompiled(model.policy)
    kind = policy_kind(policy)
    assert kind is not None

    def values_of(observations: Any, actions: th.Tensor | None) -> th.Tensor:
        if kind.actions is not None and actions is None:
            actions = kind.actions(policy, {"observations": observations})
        values = kind.mean_values(policy, {"observations": observations, "actions": actions})
        return values.max(dim=1).values if kind.actions is None else values.mean(dim=1)

    with th.no_grad(), evaluation_mode(policy):
        values = values_of(sample.observations, sample.actions)
        following = values_of(sample.next_observations, None)
    rewards = sample.rewards.flatten()
    # γ, or of each sample that of its n steps
    discounts = th.full_like(rewards, model.gamma) if sample.discounts is None else sample.discounts.flatten()
    targets = rewards + discounts * (1 - sample.dones.flatten()) * following
    bound = float((rewards.abs() / (1 - discounts)).max()) if model.gamma < 1 else math.inf
    return values.double().cpu().numpy(), targets.double().cpu().numpy(), bound


def policy_change(old: ModelOutputs, new: ModelOutputs, old_std: th.Tensor | None, new_std: th.Tensor | None) -> float | None:
    """
    :param old: Outputs before an iteration
    :param new: Outputs after it, on the same batch
    :param old_std: :func:`action_std` before it, of continuous actions
    :param new_std: The same after it
    :return: KL(old ‖ new) of the policy in nats, mean over the batch; several sub-actions are summed. Infinite where a
        standard deviation has become 0 or infinite.
    """
    if old.probabilities is not None and new.probabilities is not None:
        tiny = th.finfo(old.probabilities.dtype).tiny
        terms = th.xlogy(old.probabilities, old.probabilities.clamp(min=tiny) / new.probabilities.clamp(min=tiny))
        return terms.flatten(start_dim=1).sum(dim=1).mean().item()
    if old.action_means is None or new.action_means is None or old_std is None or new_std is None:
        return None
    before = th.distributions.Normal(old.action_means, old_std, validate_args=False)
    after = th.distributions.Normal(new.action_means, new_std, validate_args=False)
    divergence = th.distributions.kl_divergence(before, after).sum(dim=1).mean().item()
    return math.inf if math.isnan(divergence) else divergence


def weight_matrices(model: BaseAlgorithm) -> dict[str, nn.Parameter]:
    """
    :param model: A model
    :return: Its trained weight matrices, and the kernels of convolutions, by name
    """
    parameters = {name: parameter for group in trained_groups(model).values() for name, parameter in group.items()}
    return {name: parameter for name, parameter in parameters.items() if parameter.dim() > 1}


def note_gradients(sizes: Symptoms, weights: dict[str, nn.Parameter], optimizer: th.optim.Optimizer) -> None:
    """
    Keep the greatest ``gradient_size`` of each weight matrix: the root mean square of its gradient's entries, as the optimiser
    gets it, divided by the ε of the optimiser (1e-8 where it has none). Adam and RMSprop divide gradients by their size, but
    add ε to it: gradients far below ε move nothing.

    :param sizes: What was found in earlier updates
    :param weights: :func:`weight_matrices`
    :param optimizer: An optimiser that is about to make a step
    """
    epsilons = {p: float(group.get("eps", 1e-8)) for group in optimizer.param_groups for p in group["params"]}
    for name, weight in weights.items():
        if weight in epsilons and weight.grad is not None:
            size = weight.grad.square().mean().sqrt().item() / epsilons[weight]
            sizes[f"gradient_size/{name}"] = max(size, sizes.get(f"gradient_size/{name}", 0.0))


def symptoms_of(model: BaseAlgorithm, batch: Batch) -> Symptoms:
    """
    :param model: A model
    :param batch: Observations, with what belongs to them
    :return: What can be measured without training
    """
    outputs = model_outputs(model, batch)
    symptoms = {**acting_symptoms(model, batch, outputs), **network_symptoms(model, batch)}
    if isinstance(model, (OnPolicyAlgorithm, OffPolicyAlgorithm)):
        symptoms |= {"discount": float(model.gamma)}
    return symptoms
