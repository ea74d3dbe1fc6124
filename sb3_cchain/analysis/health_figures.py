"""How healthy the networks of a model are: its hidden units, features and parameters, by groups of layers."""

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_cchain.analysis.metrics.dormancy import dormant_scores, mean_activity
from sb3_cchain.analysis.metrics.norms import group_norms
from sb3_cchain.analysis.metrics.rank import effective_rank, singular_values, srank
from sb3_cchain.networks.activations import ELEMENTWISE_ACTIVATIONS, RECTIFIERS, CReLU, FourierFeatures
from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.networks.evaluation_mode import evaluation_mode
from sb3_cchain.networks.forward_hooks import forward_hooks
from sb3_cchain.networks.model_optimizers import model_optimizers
from sb3_cchain.networks.policy_inputs import episode_start


def network_health(model: BaseAlgorithm, observations: PyTorchObs, tau: float = 0.025) -> dict[str, float]:
    r"""
    A group of layers is what the first two parts of the modules' names have in common: ``mlp_extractor.policy_net``,
    ``features_extractor.cnn``, ``action_net``; ``q_net.q_net``; ``actor.latent_pi``, ``critic.qf0``. A parameter that belongs
    to no layer, such as ``log_std``, forms its own group. A network that policy and value share is one group; where they
    have a features extractor each, SB3 calls the policy's ``features_extractor`` and the value's ``vf_features_extractor``.
    Only what an optimiser of the model trains is counted, so no target network.

    Figures of the units behind each activation function on the way from the observations to the actions and values. (A unit of
    a convolution is a filter, as long as its output is not flattened.) Activation functions are modules of PyTorch's usual
    kinds (``networks/activations.py``). Functions such as ``torch.relu`` are not seen, and networks without activation modules
    have none of these figures:

    - ``dormant_share``: share of the units whose score :math:`s_i = E_x|h_i(x)| / \frac{1}{H} \sum_k E_x|h_k(x)|` among the H
      of their layer is at most τ (:func:`~sb3_cchain.analysis.metrics.dormancy.dormant_scores`; Sokar et al., ICML 2023,
      https://arxiv.org/abs/2302.12902)
    - ``active_share``: share of the pairs of unit and observation (and position, for a convolution) for which
      :math:`h_i(x) > 0`; only for ReLU, ReLU6 and CReLU. Fraction of active units (FAU) in Ma et al. (ICLR 2024),
      https://arxiv.org/abs/2310.07418.

    A unit of CReLU has a positive and a negative part, and :math:`h_i` is their sum. The sines and cosines of FourierFeatures
    count as units of their own.

    Figures of the features of a group, the outputs :math:`\Phi` of its last activation function, ``(n_observations,
    n_features)``, flattened where they have positions, neither centred nor normalised:

    - ``feature_srank``: :func:`~sb3_cchain.analysis.metrics.rank.srank` of :math:`\Phi` with δ = 0.01 (Kumar et al.,
      ICLR 2021)
    - ``feature_effective_rank``: :func:`~sb3_cchain.analysis.metrics.rank.effective_rank` of :math:`\Phi`

    Neither can exceed the number of observations. They are not a number where the features are not finite.

    Figures of all parameters θ, biases included:

    - ``weight_norm``: :math:`\|\theta\|_2`
    - ``distance_from_init``: :math:`\|\theta - \theta_0\|_2`, when the model knows its :math:`\theta_0`
      (:func:`remember_initial_parameters`)

    :param model: A model with a PyTorch policy: PPO, A2C, DQN, SAC, TD3, or of sb3-contrib. Recurrent networks see each
        observation as an episode's first.
    :param observations: Observations, as the policy gets them
    :param tau: τ
    :return: Each figure under its name over all groups, except for the ranks, which belong to one matrix; and for each group
        that has it, as ``dormant_share/mlp_extractor.policy_net``. The policy keeps its training mode.
    """
    return {**_unit_health(uncompiled(model.policy), observations, tau), **_parameter_health(model)}


def trained_groups(model: BaseAlgorithm) -> dict[str, dict[str, nn.Parameter]]:
    """
    :param model: A model
    :return: For each group of layers the parameters that an optimiser of the model trains, by name
    """
    groups: dict[str, dict[str, nn.Parameter]] = {}
    optimizers = model_optimizers(model).values()
    trained = {parameter for optimizer in optimizers for group in optimizer.param_groups for parameter in group["params"]}
    policy = uncompiled(model.policy)
    for name, parameter in policy.named_parameters():
        if parameter in trained:
            layer, _, _ = name.rpartition(".")
            is_layer = not any(policy.get_submodule(layer).children())
            groups.setdefault(group_of(layer if is_layer else name), {})[name] = parameter
    return groups


def remember_initial_parameters(model: BaseAlgorithm) -> None:
    """
    Keep a copy of the trained parameters as ``model.initial_parameters``, NumPy arrays by name, if there is none yet. SB3
    saves it with the model, which grows by the size of its parameters.

    :param model: A model
    """
    if not hasattr(model, "initial_parameters"):
        model.initial_parameters = {  # type: ignore[attr-defined]
            name: parameter.detach().cpu().numpy().copy()
            for parameters in trained_groups(model).values()
            for name, parameter in parameters.items()
        }


def _parameter_health(model: BaseAlgorithm) -> dict[str, float]:
    groups = trained_groups(model)
    health = group_norms("weight_norm", {group: parameters.values() for group, parameters in groups.items()})
    initial: dict[str, NDArray[Any]] | None = getattr(model, "initial_parameters", None)
    if initial is not None:
        differences = {
            group: [parameter - th.as_tensor(initial[name], device=model.device) for name, parameter in parameters.items()]
            for group, parameters in groups.items()
        }
        health |= group_norms("distance_from_init", differences)
    return health


def _unit_health(policy: BasePolicy, observations: PyTorchObs, tau: float) -> dict[str, float]:
    dormant: dict[str, list[th.Tensor]] = {}
    active: dict[str, list[th.Tensor]] = {}
    features: dict[str, th.Tensor] = {}
    for name, outputs in hidden_activations(policy, observations).items():
        module, group = policy.get_submodule(name), group_of(name)
        for output in outputs:
            units = unit_outputs(module, output)
            dormant.setdefault(group, []).append(dormant_scores(mean_activity(units)) <= tau)
            if isinstance(module, (*RECTIFIERS, CReLU)):
                active.setdefault(group, []).append(units > 0)
            features[group] = output.flatten(start_dim=1)  # the last one stays
    health = {**_shares("dormant_share", dormant), **_shares("active_share", active)}
    for group, matrix in features.items():
        sigma = singular_values(matrix) if matrix.isfinite().all() else None
        health[f"feature_srank/{group}"] = math.nan if sigma is None else srank(sigma)
        health[f"feature_effective_rank/{group}"] = math.nan if sigma is None else effective_rank(sigma)
    return health


def _shares(name: str, flags: dict[str, list[th.Tensor]]) -> dict[str, float]:
    """The share of flags that are true, among all and in each group."""
    counts = {group: (sum(int(f.sum()) for f in layers), sum(f.numel() for f in layers)) for group, layers in flags.items()}
    if not counts:
        return {}
    n_true, n_all = map(sum, zip(*counts.values(), strict=True))
    return {name: n_true / n_all, **{f"{name}/{group}": true / total for group, (true, total) in counts.items()}}


def group_of(name: str) -> str:
    """
    :param name: Name of a module of a policy
    :return: That of its group of layers
    """
    return ".".join(name.split(".")[:2])


def hidden_activations(policy: Any, observations: PyTorchObs) -> dict[str, list[th.Tensor]]:
    """
    :param policy: A policy, not compiled
    :param observations: Observations, as the policy gets them
    :return: The hidden outputs of each activation function by the name of its module, ``(n_observations, n_units, ...)``, in
        the order of their first use
    """
    names = {
        m: name for name, m in policy.named_modules() if isinstance(m, (*ELEMENTWISE_ACTIVATIONS, CReLU, FourierFeatures))
    }
    activations: dict[str, list[th.Tensor]] = {}

    def watch(forward: Callable[[], Any]) -> Any:
        seen: dict[str, list[th.Tensor]] = {}
        with forward_hooks(names, lambda module, _, output: seen.setdefault(names[module], []).append(output)):
            results = forward()
        for name, outputs in seen.items():
            # A function at the very end, as that of TD3's actions, has no hidden units
            hidden = [o for o in outputs if not any(o is r for r in (results if isinstance(results, tuple) else [results]))]
            if hidden:
                activations.setdefault(name, hidden)  # what actor and critic share is counted once
        return results

    with th.no_grad(), evaluation_mode(policy):
        actions = watch(lambda: _act(policy, observations))
        if hasattr(policy, "actor"):
            watch(lambda: policy.critic(observations, actions))
    return activations


def unit_outputs(module: nn.Module, output: th.Tensor) -> th.Tensor:
    """
    :param module: An activation function
    :param output: What it gave, ``(n_observations, n_features, ...)``
    :return: The outputs of the units, ``(n_observations, n_units, ...)``. A unit of CReLU has two features, one of which is 0:
        its output is their sum
    """
    return output.unflatten(1, (2, -1)).sum(dim=1) if isinstance(module, CReLU) else output


def _act(policy: Any, observations: PyTorchObs) -> Any:
    """Run the policy; the forward pass of an actor-critic policy includes its values."""
    if not hasattr(policy, "lstm_actor"):
        is_ars = hasattr(policy, "action_net") and not hasattr(policy, "predict_values")
        # ARS never acts at random, and has no such argument
        return policy(observations) if is_ars else policy(observations, deterministic=True)
    memory, episode_starts = episode_start(policy, observations)
    return policy(observations, SimpleNamespace(pi=memory, vf=memory), episode_starts, deterministic=True)
