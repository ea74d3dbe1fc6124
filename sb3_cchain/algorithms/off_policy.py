"""Churn reduction of an unmodified ``DQN.train()``: where reference batches come from, where the gradient goes in."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import torch as th
from stable_baselines3 import DQN

from sb3_cchain.churn import ChurnCoefficient, ChurnReducer, extra_gradient, mean_squared_difference
from sb3_cchain.churn.divergence import action_changes, mean_absolute_change
from sb3_cchain.churn.reducer import Observations
from sb3_cchain.networks.policy_inputs import n_observations
from sb3_cchain.networks.policy_outputs import as_it_acts, has_training_mode
from sb3_cchain.replaced import replaced

# β when `target_churn_ratio="auto"`: the paper's
DEFAULT_TARGET_RATIO = 0.01


def make_q_reducer(model: DQN, make_coefficient: Callable[[float], ChurnCoefficient]) -> ChurnReducer:
    """
    :param model: A model, whose policy exists
    :param make_coefficient: Makes λ, given the default β
    :return: The reducer of the Q-network's churn: the mean squared change of all action values
    """
    # A partial, which deepcopy() of the model follows, as it does not a closure
    return ChurnReducer(partial(_q_values, model), mean_squared_difference, make_coefficient(DEFAULT_TARGET_RATIO))


def _q_values(model: DQN, observations: Observations) -> th.Tensor:
    return model.policy.q_net(observations)


@contextmanager
def reduced_q_churn(model: DQN, reducer: ChurnReducer, batch_size: int) -> Iterator[None]:
    """
    Run ``model``'s own ``train()`` in this block to train it with churn reduction.

    The reference batch is a sample of the replay buffer, of the minibatch's size and independent of it.

    Afterwards λ has been updated and ``churn/…`` logged, averaged over the calls of ``train()`` between two logs:

    - ``churn/loss``: mean churn loss L_churn over the updates, the mean squared change of all action values
    - ``churn/coef``: the λ it was multiplied by
    - ``churn/relative_loss``: λ·L_churn / L, where L is the TD loss. The mean of the ratios of single updates lies above the
      ratio of the means, which an adaptive λ holds at β
    - ``churn/value_churn``: mean absolute change of the action values by an update
    - ``churn/greedy_action_changes``: share of the states whose greedy action an update changed

    :param model: A DQN model
    :param reducer: Its churn reducer
    :param batch_size: Size of the reference batches
    """
    reducer.discard_losses()  # of an update that was interrupted
    coef = reducer.coefficient.value

    def sample() -> Observations:
        assert model.replay_buffer is not None
        return model.replay_buffer.sample(batch_size, env=model._vec_normalize_env).observations

    if has_training_mode(model.policy):
        seam = _own_pass(model, reducer, sample)
    else:
        seam = _joint_passes(model, reducer, sample)
    with seam:
        yield

    if reducer.losses:
        base_loss = float(model.logger.name_to_value["train/loss"])
        churn_loss = sum(reducer.losses) / len(reducer.losses)
        old, new = (th.cat(outputs) for outputs in zip(*reducer.compared, strict=True))
        model.logger.record_mean("churn/loss", churn_loss)
        model.logger.record_mean("churn/coef", coef)
        model.logger.record_mean("churn/relative_loss", coef * churn_loss / (base_loss + 1e-8))
        model.logger.record_mean("churn/value_churn", mean_absolute_change(old, new))
        model.logger.record_mean("churn/greedy_action_changes", action_changes(old.argmax(dim=1), new.argmax(dim=1)))
        reducer.end_iteration(base_loss)


@contextmanager
def _own_pass(model: DQN, reducer: ChurnReducer, sample: Callable[[], Observations]) -> Iterator[None]:
    """A forward and a backward pass for the reference batch, in which the network acts as it does in the environment."""

    def backward() -> None:
        reference = sample()
        with as_it_acts(model.policy):
            reducer.backward(reference)

    with extra_gradient(model.policy.optimizer, backward):
        yield


@contextmanager
def _joint_passes(model: DQN, reducer: ChurnReducer, sample: Callable[[], Observations]) -> Iterator[None]:
    """
    The same gradient, up to rounding, in no pass more than Double DQN makes: reference batches go through the network
    together with the minibatch and its next observations, and the churn loss's gradient with respect to the outputs is
    added where SB3's backward pass comes by. (Without Double Q-learning the next observations do not go through the network;
    the old outputs then take a pass without gradient.)
    """
    q_net = model.q_net
    upcoming: tuple[Observations, th.Tensor | None] | None = None  # the next reference batch, and the outputs on it

    def joint_q_net(observations: Observations) -> th.Tensor:
        """Called, with Double Q-learning, for the next observations without gradient; then for the observations."""
        nonlocal upcoming
        if not th.is_grad_enabled():
            reference = sample()
            q_values, outputs = _split(q_net(_cat(observations, reference)), observations)
            upcoming = reference, outputs
            return q_values

        if reducer.reference is None:
            q_values = q_net(observations)
        else:
            both = q_net(_cat(observations, reducer.reference))
            q_values, outputs = _split(both, observations)
            outputs = outputs.detach().requires_grad_()
            (gradient,) = th.autograd.grad(reducer.loss(outputs), outputs)
            both.register_hook(lambda of_both: th.cat([of_both[: -len(gradient)], gradient]))
        reducer.remember(*(upcoming or (sample(), None)))
        upcoming = None
        return q_values

    with replaced(model, "q_net", joint_q_net):
        yield


def _cat(minibatch: Observations, reference: Observations) -> Observations:
    if isinstance(minibatch, dict) and isinstance(reference, dict):
        return {key: th.cat([minibatch[key], reference[key]]) for key in minibatch}
    assert th.is_tensor(minibatch) and th.is_tensor(reference)
    return th.cat([minibatch, reference])


def _split(outputs: th.Tensor, minibatch: Observations) -> tuple[th.Tensor, th.Tensor]:
    size = n_observations(minibatch)
    return outputs[:size], outputs[size:]
