"""
The outputs of the networks of any Stable-Baselines3 or sb3-contrib policy on a batch, with gradient: of its actor, and of its
value function.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch as th
from torch import nn

from sb3_cchain.networks.policy_inputs import episode_start
from sb3_cchain.networks.policy_outputs import distribution_outputs, policy_outputs

# "observations", a tensor or a dict of tensors, as the networks get them; "actions", "action_masks", and the inputs of
# recurrent networks for algorithms that have them
Batch = dict[str, Any]
# Maps a policy and a batch to outputs whose first dimension is the batch's
OutputsOf = Callable[[Any, Batch], th.Tensor]


def actor_critic_actions(policy: Any, batch: Batch) -> th.Tensor:
    """
    :param policy: An actor-critic policy of an on-policy algorithm
    :param batch: ``observations``; of MaskablePPO the ``action_masks``, if they should apply
    :return: As of :func:`~sb3_cchain.networks.policy_outputs.policy_outputs`
    """
    if "action_masks" in batch:
        return distribution_outputs(policy.get_distribution(batch["observations"], batch["action_masks"]))
    return policy_outputs(policy, batch["observations"])


def actor_critic_values(policy: Any, batch: Batch) -> th.Tensor:
    """
    :param policy: An actor-critic policy of an on-policy algorithm
    :param batch: ``observations``
    :return: State values ``(batch_size, 1)``
    """
    return policy.predict_values(batch["observations"])


def recurrent_actions(policy: Any, batch: Batch) -> th.Tensor:
    """
    :param policy: A recurrent policy of sb3-contrib
    :param batch: ``observations``. Sequences also have the ``lstm_states`` of the actor that they begin with (``hidden``,
        ``cell``), ``episode_starts``, and a ``mask`` that is 0 where they are padded. Without ``lstm_states``, each
        observation is taken as an episode's first.
    :return: As of :func:`actor_critic_actions`, without the padding
    """
    distribution, _ = policy.get_distribution(batch["observations"], *_memory(policy, batch))
    return _without_padding(distribution_outputs(distribution), batch)


def recurrent_values(policy: Any, batch: Batch) -> th.Tensor:
    """
    :param policy: A recurrent policy of sb3-contrib
    :param batch: As for :func:`recurrent_actions`, with the ``lstm_states`` of the critic
    :return: State values ``(batch_size, 1)``, without the padding
    """
    return _without_padding(policy.predict_values(batch["observations"], *_memory(policy, batch)), batch)


def _memory(policy: Any, batch: Batch) -> tuple[tuple[th.Tensor, th.Tensor], th.Tensor]:
    if "lstm_states" not in batch:
        return episode_start(policy, batch["observations"])
    return (batch["lstm_states"]["hidden"], batch["lstm_states"]["cell"]), batch["episode_starts"]


def _without_padding(outputs: th.Tensor, batch: Batch) -> th.Tensor:
    return outputs[batch["mask"] > 1e-8] if "mask" in batch else outputs


def action_values(policy: Any, batch: Batch) -> th.Tensor:
    """
    :param policy: A policy of DQN
    :param batch: ``observations``
    :return: Values of all actions ``(batch_size, n_actions)``
    """
    return policy.q_net(batch["observations"])


def action_quantiles(policy: Any, batch: Batch) -> th.Tensor:
    """
    :param policy: A policy of QRDQN
    :param batch: ``observations``
    :return: Quantiles of the values of all actions ``(batch_size, n_quantiles, n_actions)``
    """
    return policy.quantile_net(batch["observations"])


def deterministic_actions(policy: Any, batch: Batch) -> th.Tensor:
    """
    :param policy: A policy of SAC, TQC, CrossQ, TD3 or DDPG
    :param batch: ``observations``
    :return: The actions without noise, as the actor gives them: squashed, between -1 and 1, ``(batch_size, action_dim)``
    """
    return policy._predict(batch["observations"], deterministic=True)


def critic_values(policy: Any, batch: Batch) -> th.Tensor:
    """
    :param policy: A policy of SAC, TQC, CrossQ, TD3 or DDPG
    :param batch: ``observations`` and ``actions``
    :return: Each critic's values of these actions ``(batch_size, n_critics)``, of TQC their quantiles
        ``(batch_size, n_critics, n_quantiles)``
    """
    values = policy.critic(batch["observations"], batch["actions"])
    return th.cat(values, dim=1) if isinstance(values, tuple) else values


@dataclass(frozen=True)
class PolicyKind:
    """
    :param actions: Outputs of the actor; None for a policy without one
    :param values: Outputs of the value function; None for a policy without one
    :param quantiles: The dimension of the quantiles in the latter, where it has a third dimension
    """

    actions: OutputsOf | None = None
    values: OutputsOf | None = None
    quantiles: int = 1

    def mean_values(self, policy: Any, batch: Batch) -> th.Tensor:
        """
        :param policy: A policy of this kind, which has values
        :param batch: A batch
        :return: Its values; where a network predicts their quantiles, the mean of these
        """
        assert self.values is not None
        values = self.values(policy, batch)
        return values.mean(dim=self.quantiles) if values.dim() > 2 else values


def policy_kind(policy: nn.Module) -> PolicyKind | None:
    """
    :param policy: A policy
    :return: What outputs it has; None for a policy that is not known here
    """
    for attributes, kind in _KINDS.items():
        if all(hasattr(policy, attribute) for attribute in attributes):
            return kind
    return None


# By attributes of the policy, because sb3-contrib need not be installed. The first match counts.
_KINDS: dict[tuple[str, ...], PolicyKind] = {
    ("lstm_actor",): PolicyKind(recurrent_actions, recurrent_values),
    ("predict_values",): PolicyKind(actor_critic_actions, actor_critic_values),
    ("q_net",): PolicyKind(None, action_values),
    ("quantile_net",): PolicyKind(None, action_quantiles),
    ("actor", "critic"): PolicyKind(deterministic_actions, critic_values, quantiles=2),
    ("action_net",): PolicyKind(lambda policy, batch: policy._predict(batch["observations"])),  # ARS
}
