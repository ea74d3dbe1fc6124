"""Churn reduction of an unmodified ``DQN.train()``: where reference batches come from, where the gradient goes in."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext

import torch as th
from stable_baselines3 import DQN

from sb3_cchain.churn import ChurnCoefficient, ChurnReducer, extra_gradient, mean_squared_difference
from sb3_cchain.common.policy_outputs import as_it_acts, has_training_mode

# β when `target_churn_ratio="auto"`: the paper's
DEFAULT_TARGET_RATIO = 0.01


def make_q_reducer(model: DQN, make_coefficient: Callable[[float], ChurnCoefficient]) -> ChurnReducer:
    """
    :param model: A model, whose policy exists
    :param make_coefficient: Makes λ, given the default β
    :return: The reducer of the Q-network's churn: the mean squared change of all action values
    """
    return ChurnReducer(
        lambda observations: model.q_net(observations), mean_squared_difference, make_coefficient(DEFAULT_TARGET_RATIO)
    )


@contextmanager
def reduced_q_churn(model: DQN, reducer: ChurnReducer, batch_size: int) -> Iterator[None]:
    """
    Run ``model``'s own ``train()`` in this block to train it with churn reduction.

    The reference batch is a sample of the replay buffer, of the minibatch's size and independent of it.

    Afterwards λ has been updated and ``churn/…`` logged, averaged over the calls of ``train()`` between two logs:

    - ``churn/loss``: mean churn loss L_churn over the updates, the mean squared change of all action values
    - ``churn/coef``: the λ it was multiplied by
    - ``churn/relative_loss``: λ·L_churn / L, which an adaptive λ holds near β; L is the TD loss
    - ``churn/value_churn``: mean absolute change of the action values by an update
    - ``churn/greedy_action_changes``: share of the states whose greedy action an update changed

    :param model: A DQN model
    :param reducer: Its churn reducer
    :param batch_size: Size of the reference batches
    """
    acting = (lambda: as_it_acts(model.policy)) if has_training_mode(model.policy) else nullcontext
    coef = reducer.coefficient.value

    def backward() -> None:
        assert model.replay_buffer is not None
        reference = model.replay_buffer.sample(batch_size, env=model._vec_normalize_env).observations
        with acting():
            reducer.backward(reference)

    with extra_gradient(model.policy.optimizer, backward):
        yield

    if reducer.losses:
        base_loss = float(model.logger.name_to_value["train/loss"])
        churn_loss = sum(reducer.losses) / len(reducer.losses)
        old, new = (th.cat(outputs) for outputs in zip(*reducer.compared, strict=True))
        greedy_action_changes = (old.argmax(dim=1) != new.argmax(dim=1)).float().mean()
        model.logger.record_mean("churn/loss", churn_loss)
        model.logger.record_mean("churn/coef", coef)
        model.logger.record_mean("churn/relative_loss", coef * churn_loss / (base_loss + 1e-8))
        model.logger.record_mean("churn/value_churn", (new - old).abs().mean().item())
        model.logger.record_mean("churn/greedy_action_changes", greedy_action_changes.item())
        reducer.end_iteration(base_loss)
