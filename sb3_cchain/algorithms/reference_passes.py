"""How reference batches go through a PPO policy: by themselves, or together with the minibatches."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_cchain.algorithms.reference_batches import ReferenceBatches
from sb3_cchain.churn import ChurnReducer, component_backward
from sb3_cchain.networks.joint_evaluation import evaluate_jointly
from sb3_cchain.networks.policy_inputs import n_observations, rows
from sb3_cchain.networks.policy_outputs import of_action_net
from sb3_cchain.replaced import replaced


@contextmanager
def separate_passes(
    policy: ActorCriticPolicy, reducer: ChurnReducer, references: ReferenceBatches, component: str
) -> Iterator[Callable[[], None]]:
    """
    Reference batches go through the policy by themselves, and the churn loss has a backward pass of its own.

    :param policy: The policy
    :param reducer: The reducer of its churn
    :param references: Where its reference batches come from
    :param component: Which component of the churn gradient is used
    :return: What adds the churn gradient, to be called right after ``zero_grad()``
    """
    full = component == "full"
    with nullcontext(th.Tensor.backward) if full else component_backward(list(policy.parameters()), component) as add_gradient:
        yield lambda: reducer.backward(references.current, add_gradient)


@contextmanager
def joint_passes(
    policy: ActorCriticPolicy, reducer: ChurnReducer, references: ReferenceBatches
) -> Iterator[Callable[[], None]]:
    """
    The reference batch whose churn loss is due goes through the actor together with the minibatch. The gradient of the churn
    loss is added where the actor's outputs receive that of PPO's loss, so that one backward pass serves both.

    :param policy: A policy, of which ``can_evaluate_jointly()`` is true
    :param reducer: The reducer of its churn
    :param references: Where its reference batches come from
    :return: What adds the churn gradient, to be called right after ``zero_grad()``
    """
    outputs: th.Tensor
    due: slice

    def evaluate_actions(observations: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        nonlocal outputs, due
        reference = reducer.reference
        further = None
        if reference is not None:
            n_shared, n_reference = references.n_shared, n_observations(reference)
            start = 0 if n_shared else n_observations(observations)
            due = slice(start, start + n_reference)
            if n_shared < n_reference:
                further = rows(reference, slice(n_shared, None))
        values, log_prob, entropy, outputs = evaluate_jointly(policy, observations, actions, further)
        return values, log_prob, entropy

    def add_gradient() -> None:
        if reducer.reference is not None:
            with th.enable_grad():
                new_outputs = outputs[due].detach().requires_grad_()
                loss = reducer.loss(of_action_net(policy, new_outputs))
            if outputs.requires_grad:  # not all that the outputs depend on is frozen
                [churn_gradient] = th.autograd.grad(loss, new_outputs)
                outputs.register_hook(_adder(churn_gradient, due))
        reducer.remember(references.current)

    with replaced(policy, "evaluate_actions", evaluate_actions):
        yield add_gradient


def _adder(churn_gradient: th.Tensor, due: slice) -> Callable[[th.Tensor], th.Tensor]:
    def add(gradient: th.Tensor) -> th.Tensor:
        total = gradient.clone()
        total[due] += churn_gradient
        return total

    return add
