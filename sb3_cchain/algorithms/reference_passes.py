"""How reference batches go through a PPO policy: by themselves, or together with the minibatches."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_cchain.algorithms.reference_batches import ReferenceBatches
from sb3_cchain.churn import ChurnReducer
from sb3_cchain.churn.gradient import carrying
from sb3_cchain.networks.joint_evaluation import evaluate_jointly
from sb3_cchain.networks.policy_inputs import n_observations, rows
from sb3_cchain.networks.policy_networks import PolicyNetworks
from sb3_cchain.networks.policy_outputs import actor_outputs, of_action_net
from sb3_cchain.replaced import replaced


@contextmanager
def joint_passes(
    policy: ActorCriticPolicy, reducer: ChurnReducer, references: ReferenceBatches
) -> Iterator[Callable[[], None]]:
    """
    The reference batch whose churn loss is due goes through the actor together with the minibatch, and the churn loss is
    attached to what PPO computes for the minibatch, so that one backward pass serves both losses.

    :param policy: A policy, of which ``can_evaluate_jointly()`` is true
    :param reducer: The reducer of its churn
    :param references: Where its reference batches come from
    :return: What completes an update, to be called right after ``zero_grad()``
    """
    networks = PolicyNetworks(policy)
    coef = reducer.coefficient.value
    churn_loss: th.Tensor | None = None

    def evaluate_actions(observations: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        nonlocal churn_loss
        if reducer.reference is None:
            return evaluate_jointly(networks, observations, actions)[:3]
        assert reducer.old_outputs is not None
        further = rows(reducer.reference, slice(references.n_shared, None))
        values, log_prob, entropy, outputs = evaluate_jointly(networks, observations, actions, further)
        # The reference batch begins with the minibatch, or comes after it
        start = 0 if references.n_shared else n_observations(observations)
        outputs = outputs[start : start + len(reducer.old_outputs)]
        churn_loss = reducer.divergence(reducer.old_outputs, of_action_net(policy, outputs))
        return carrying(values, churn_loss, coef), log_prob, entropy

    def complete() -> None:
        nonlocal churn_loss
        if churn_loss is not None:
            reducer.record(churn_loss)
            churn_loss = None
        assert references.current is not None
        with th.no_grad():
            reducer.remember(references.current, actor_outputs(networks, references.current))

    with replaced(policy, "evaluate_actions", evaluate_actions):
        yield complete
