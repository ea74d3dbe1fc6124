"""The empirical neural tangent kernel (NTK) of a policy or a Q-network."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN, HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import obs_as_tensor
from torch import nn

from sb3_cchain.algorithms.replay_observations import unchanged
from sb3_cchain.analysis.metrics.gradients import Objective, minibatch_gradients
from sb3_cchain.analysis.metrics.ntk import gram_matrix
from sb3_cchain.networks.algorithm_kinds import is_recurrent
from sb3_cchain.networks.evaluation_mode import evaluation_mode


def has_ntk(model: BaseAlgorithm) -> bool:
    """
    :param model: A model
    :return: Whether its NTK can be computed: of on-policy algorithms without recurrent networks, DQN and QRDQN
    """
    is_known = isinstance(model, (OnPolicyAlgorithm, DQN)) or hasattr(model, "quantile_net")
    return is_known and not is_recurrent(model)


def policy_ntk(model: OnPolicyAlgorithm, n_minibatches: int = 100) -> th.Tensor:
    r"""
    The empirical NTK of a policy, Appendix B of the C-CHAIN paper: the rollout is divided at random into minibatches of equal
    size, and :math:`N(i, j) = g_i^\top g_j` with the gradient :math:`g_i` of the policy objective on minibatch :math:`i`,

    .. math:: \frac{1}{|B_i|} \sum_{(s, a) \in B_i} \frac{\pi_\theta(a|s)}{\pi_{old}(a|s)} \hat A(s, a),

    with respect to the policy's parameters. Call it when the rollout is complete and ``train()`` has not begun: θ are then the
    parameters that the rollout was collected with, so nothing is clipped yet, the gradients of PPO, of its surrogate and of
    A2C are the same, and it is computed as that of :math:`\log \pi_\theta(a|s)\, \hat A(s, a)`. It has no entropy bonus. The
    advantages are normalised over the rollout to mean 0 and standard deviation 1, for every algorithm, so that their scale
    does not enter the comparison between tasks.

    The global NumPy generator draws the division.

    :param model: A model with a complete rollout
    :param n_minibatches: m, the size of the matrix; limited by the size of the rollout
    :return: ``(m, m)``
    """
    buffer, policy = model.rollout_buffer, model.policy
    n_samples = buffer.buffer_size * buffer.n_envs
    n_minibatches = min(n_minibatches, n_samples)
    indices = np.random.permutation(n_samples)[: n_samples // n_minibatches * n_minibatches].reshape(n_minibatches, -1)

    def minibatches_of(array: Any) -> Any:
        """``(n_steps, n_envs, ...)`` to ``(n_minibatches, batch_size, ...)``"""
        if isinstance(array, dict):
            return {key: minibatches_of(part) for key, part in array.items()}
        return obs_as_tensor(array[np.divmod(indices, buffer.n_envs)], model.device)

    advantages = minibatches_of((buffer.advantages - buffer.advantages.mean()) / (buffer.advantages.std() + 1e-8))
    # As in the buffer's own minibatches; the buffer keeps MultiBinary actions as integers
    actions = minibatches_of(buffer.actions.astype(np.float32, copy=False))
    if isinstance(model.action_space, spaces.Discrete):
        actions = actions.long().flatten(start_dim=1)
    minibatches: tuple[Any, ...] = (minibatches_of(buffer.observations), actions, advantages)
    masks = getattr(buffer, "action_masks", None)  # of sb3-contrib's MaskablePPO
    if masks is not None:
        minibatches += (minibatches_of(masks.reshape(*buffer.advantages.shape, -1)),)

    def objective(minibatch: tuple[Any, ...]) -> th.Tensor:
        observations, actions, advantages, *masks = minibatch
        _, log_prob, _ = policy.evaluate_actions(observations, actions, *masks)
        return (log_prob * advantages).mean()

    return _ntk(policy, objective, minibatches)


def q_ntk(model: DQN, n_transitions: int = 100) -> th.Tensor:
    r"""
    The empirical NTK of a Q-network, by its definition (Eq. 2 of the C-CHAIN paper) on transitions of the replay buffer:
    :math:`N(i, j) = \nabla_\theta Q_\theta(s_i, a_i)^\top \nabla_\theta Q_\theta(s_j, a_j)`.

    :param model: A model whose replay buffer is not empty
    :param n_transitions: m, the size of the matrix; limited by the number of time steps in the buffer
    :return: ``(m, m)``
    """
    assert model.replay_buffer is not None
    # Without repetition, as equal transitions are one dimension; but a HerReplayBuffer draws goals as well as transitions
    buffer = model.replay_buffer
    with unchanged(buffer):
        if isinstance(buffer, HerReplayBuffer):
            replay: Any = buffer.sample(n_transitions, env=model._vec_normalize_env)
        else:
            indices = np.random.permutation(buffer.size())[:n_transitions]
            replay = buffer._get_samples(indices, env=model._vec_normalize_env)
    # QRDQN's values are the means of quantiles
    quantile_net = getattr(model, "quantile_net", None)

    def q_values(observations: Any) -> th.Tensor:
        return model.q_net(observations) if quantile_net is None else quantile_net(observations).mean(dim=1)

    def objective(minibatch: Any) -> th.Tensor:
        observations, actions = minibatch
        return q_values(observations).gather(1, actions).mean()

    observations = replay.observations
    if isinstance(observations, dict):
        observations = {key: tensor[:, None] for key, tensor in observations.items()}
    else:
        observations = observations[:, None]
    return _ntk(quantile_net or model.q_net, objective, (observations, replay.actions.long()[:, None]))


def _ntk(network: nn.Module, objective: Objective, minibatches: Any) -> th.Tensor:
    # Vectorised convolutions take more memory and time than one minibatch after the other
    vectorize = not any(isinstance(module, nn.modules.conv._ConvNd) for module in network.modules())
    # A policy keeps its last distribution, which must not consist of vmap's tensors
    distribution = getattr(network, "action_dist", None)
    before = dict(vars(distribution)) if distribution is not None else {}
    try:
        with evaluation_mode(network):
            return gram_matrix(minibatch_gradients(network, objective, minibatches, vectorize))
    finally:
        if distribution is not None:
            vars(distribution).update(before)
