"""The churn loss of a network against itself one update ago, for any training loop."""

import math
import warnings
from collections.abc import Callable
from typing import Any

import torch as th
from torch import nn

from sb3_cchain.churn.coefficient import LOSS_EPS, ChurnCoefficient
from sb3_cchain.churn.divergence import Divergence, mean_squared_difference

# A tensor, or tensors by names; dicts nest
Observations = th.Tensor | dict[str, Any]


class ChurnReducer(nn.Module):
    r"""
    Continual Churn Approximated Reduction (C-CHAIN), https://arxiv.org/abs/2506.00592, for any training loop::

        reducer = ChurnReducer(network, mean_squared_difference, ChurnCoefficient(0.1))
        for batch, reference in batches:        # `reference` shares no sample with `batch`
            optimizer.zero_grad()
            reducer.backward(reference)         # adds the gradient of λ·L_churn
            loss(network(batch)).backward()
            optimizer.step()

    Update :math:`t-1` was made on ``batch``. The churn that it caused is how far the outputs on its ``reference`` moved,
    :math:`L_{churn}(\theta_t) = D(f_{\theta_{t-1}}(x_{ref}), f_{\theta_t}(x_{ref}))`. Update :math:`t` is made on the
    usual loss plus :math:`\lambda L_{churn}`. The released code copies the network at every update to have
    :math:`\theta_{t-1}`. Here the outputs that it is needed for are computed while it is still the current network. This
    takes no copy, but one forward pass, and one forward and backward pass, per update.

    The first update has no churn loss, because there is no update before it.

    The reference batch that awaits its next update, the outputs on it, and the history of λ are in ``state_dict()``.

    :param outputs: Maps observations to the outputs that should not churn. Called with gradients enabled or disabled, and with
        the further keyword arguments of :meth:`backward` and :meth:`remember`.
    :param divergence: Compares outputs before and after, ``divergence(old, new)``
    :param coefficient: λ
    :raises TypeError: When ``outputs`` or ``divergence`` cannot be called, or ``coefficient`` is a number
    """

    def __init__(
        self,
        outputs: Callable[..., th.Tensor],
        divergence: Divergence,
        coefficient: ChurnCoefficient,
    ):
        super().__init__()
        for name, function in (("outputs", outputs), ("divergence", divergence)):
            if not callable(function):
                raise TypeError(f"`{name}` must be a function, got {function!r}")
        if not isinstance(coefficient, ChurnCoefficient):
            raise TypeError(f"`coefficient` must be a ChurnCoefficient, as ChurnCoefficient(0.1), got {coefficient!r}")
        # In a list, so that a network is not registered as a submodule: it is not part of the reducer's state
        self._outputs = [outputs]
        self.divergence = divergence
        self.coefficient = coefficient
        self.reference: Observations | None = None
        self.old_outputs: th.Tensor | None = None
        # For a training loop that takes the next reference batch from data which it will not have any more
        self.next_reference: Observations | None = None
        # The churn loss of each update since the last `end_iteration()`
        self.losses: list[float] = []
        # The samples since the last `end_iteration()`: their number, and the sum of their loss minus the loss without churn
        self._n_samples, self._churn_sum = 0, 0.0
        # The last iterations in a row in which the outputs hardly moved
        self._n_still = 0
        self._has_warned = False

    def backward(
        self, reference: Observations, backward: Callable[[th.Tensor], Any] = th.Tensor.backward, **inputs: Any
    ) -> th.Tensor | None:
        """
        Add the gradient of λ·L_churn, and remember the present outputs on ``reference`` for the next update.

        To be called once per update, between ``zero_grad()`` and the optimiser's step.

        :param reference: Observations outside the minibatch of the update that is about to be made
        :param backward: Takes λ·L_churn and adds its gradient
        :param inputs: Further arguments of ``outputs``, such as the network where it does not hold it
        :return: The present outputs on the reference batch of the update before; None where there is none
        :raises ValueError: When the churn loss, or λ times it, is NaN or infinite; the parameters and their gradients have not
            been touched. When the reference batch is empty.
        """
        outputs = None
        if self.reference is not None:
            with th.enable_grad():
                outputs = self._outputs[0](self.reference, **inputs)
                loss = self.loss(outputs)
            if loss.requires_grad:  # not all that the outputs depend on is frozen
                backward(loss)
        self.remember(reference, **inputs)
        return outputs

    def loss(self, new_outputs: th.Tensor) -> th.Tensor:
        """
        For a training loop that has the outputs on ``self.reference`` from a forward pass of its own.

        :param new_outputs: The present outputs on ``self.reference``, which must not be None
        :return: λ·L_churn
        :raises ValueError: When the churn loss, or λ times it, is NaN or infinite
        """
        assert self.old_outputs is not None
        churn_loss = self.divergence(self.old_outputs, new_outputs)
        self.record(churn_loss)
        return self._coef * churn_loss

    def record(self, churn_loss: th.Tensor) -> None:
        """
        Count a churn loss as that of the update that is about to be made. :meth:`loss` does so by itself.

        :param churn_loss: L_churn on ``self.reference``, not multiplied by λ
        :raises ValueError: When it, or λ times it, is NaN or infinite
        """
        assert self.old_outputs is not None
        if not self.losses:  # λ changes between iterations only
            self._coef = self.coefficient.value
        loss = churn_loss.item()
        _check_finite(loss, self._coef, th.finfo(churn_loss.dtype).max)
        self.losses.append(loss)
        if self.divergence is mean_squared_difference:
            loss_without_churn = 0.0  # not computed, because each update of DQN would pay for it
        else:
            loss_without_churn = self.divergence(self.old_outputs, self.old_outputs).item()
        n_samples = len(self.old_outputs)
        self._n_samples += n_samples
        self._churn_sum += n_samples * (loss - loss_without_churn)

    def remember(self, reference: Observations, outputs: th.Tensor | None = None, **inputs: Any) -> None:
        """
        Keep the present outputs on ``reference`` for the next update.

        :param reference: Observations outside the minibatch of the update that is about to be made. They are kept as they are,
            not copied: do not change them in place
        :param outputs: The outputs, without gradient, where the training loop has them
        :param inputs: As for :meth:`backward`
        :raises ValueError: When the reference batch is empty
        """
        if outputs is None:
            with th.no_grad():
                outputs = self._outputs[0](reference, **inputs)
        if outputs.numel() == 0:
            raise ValueError(f"The reference batch must not be empty, got outputs of shape {tuple(outputs.shape)}")
        self.reference, self.old_outputs = reference, outputs

    def mean_churn(self) -> float:
        """
        :return: Mean over the samples since the last ``end_iteration()`` of the churn loss minus its value without any churn;
            with the cross-entropy, the Kullback-Leibler divergence KL(old ‖ new). NaN before the second update.
        """
        return self._churn_sum / self._n_samples if self._n_samples else float("nan")

    def end_iteration(self, base_loss: float, each_update: bool = False) -> None:
        """
        Adapt λ to the losses since the last call. Without an update in between, nothing happens.

        Warns once when, over a whole window, λ could not hold the churn loss at its ratio to the base loss, or there was no
        churn.

        :param base_loss: The mean over these updates of the loss that the churn loss was added to
        :param each_update: Whether each update counts as an iteration of λ's warm-up and window, instead of all of them as one
        :raises ValueError: When it is NaN or infinite
        """
        losses, churn = self.losses, self.mean_churn()
        self.discard_losses()
        if not losses:
            return
        for churn_loss in losses if each_update else [sum(losses) / len(losses)]:
            self.coefficient.update(base_loss, churn_loss)
            self._n_still = self._n_still + 1 if abs(churn) <= LOSS_EPS else 0
            problem = None if self._has_warned else self.coefficient.problem(self._n_still)
            if problem is not None:
                self._has_warned = True
                warnings.warn(problem)

    def discard_losses(self) -> None:
        """Forget the losses since the last ``end_iteration()``, as when training was interrupted in between."""
        self.losses = []
        self._n_samples, self._churn_sum = 0, 0.0

    def forget_reference(self) -> None:
        """Drop the reference batch, for instance after the network was replaced: the next update has no churn loss."""
        self.reference = self.old_outputs = None

    def move_reference(self, device: th.device | str) -> None:
        """
        :param device: The device of the network; a state that was loaded may come from another one
        """
        for name in ("reference", "old_outputs", "next_reference"):
            setattr(self, name, _moved(getattr(self, name), device))

    def get_extra_state(self) -> dict[str, Any]:
        """
        :return: What ``state_dict()`` holds besides the buffers
        """
        state = {"reference": self.reference, "old_outputs": self.old_outputs}
        return state if self.next_reference is None else {**state, "next_reference": self.next_reference}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """
        :param state: What ``get_extra_state()`` returned
        """
        self.reference = state["reference"]
        self.old_outputs = state["old_outputs"]
        self.next_reference = state.get("next_reference")


class ChurnReducers(nn.ModuleDict):
    """Churn reducers by the name of what they hold still: ``"policy"``, ``"value"`` or both."""

    def __getitem__(self, key: str) -> ChurnReducer:
        reducer = super().__getitem__(key)
        assert isinstance(reducer, ChurnReducer)
        return reducer

    def values(self) -> list[ChurnReducer]:  # type: ignore[override]
        """
        :return: The reducers
        """
        return [self[name] for name in self]

    @property
    def first(self) -> ChurnReducer:
        """The only reducer, or the first of several."""
        return self[next(iter(self))]

    def active(self) -> dict[str, ChurnReducer]:
        """
        :return: Those with a λ that is not, and stays, 0
        """
        return {name: self[name] for name in self if not self[name].coefficient.is_zero}


def _moved(value: Any, device: th.device | str) -> Any:
    if isinstance(value, dict):
        return {key: _moved(each, device) for key, each in value.items()}
    return None if value is None else value.to(device)


def _check_finite(loss: float, coef: float, greatest: float) -> None:
    if not math.isfinite(loss):
        problem = f"The churn loss is {loss}: the network's outputs, or the observations, hold NaN or infinite values."
        advice = "Look for NaN or infinite rewards, lower the learning rate or `churn_coef`, or set `max_grad_norm`."
    elif coef > greatest or not abs(coef * loss) <= greatest:
        problem = f"λ times the churn loss, {coef:.3g} * {loss:.3g}, is beyond the network's precision."
        advice = "Look for huge rewards, or lower `target_churn_ratio` or `churn_coef`."
    else:
        return
    raise ValueError(f"{problem} This update has not been made. {advice}")
