"""The churn loss of a network against itself one update ago, for any training loop."""

from collections.abc import Callable
from typing import Any

import torch as th
from torch import nn

from sb3_cchain.churn.coefficient import ChurnCoefficient
from sb3_cchain.churn.divergence import Divergence

Observations = th.Tensor | dict[str, th.Tensor]


class ChurnReducer(nn.Module):
    r"""
    Continual Churn Approximated Reduction (C-CHAIN), https://arxiv.org/abs/2506.00592, for any training loop::

        reducer = ChurnReducer(network, mean_squared_difference, ChurnCoefficient(0.1))
        for batch, reference in batches:        # `reference` shares no sample with `batch`
            optimizer.zero_grad()
            reducer.backward(reference)         # adds the gradient of λ·L_churn
            loss(network(batch)).backward()
            optimizer.step()

    Update :math:`t-1` was made on ``batch``; the churn that it caused is how far the outputs on its ``reference`` moved,
    :math:`L_{churn}(\theta_t) = D(f_{\theta_{t-1}}(x_{ref}), f_{\theta_t}(x_{ref}))`, and update :math:`t` is made on the
    usual loss plus :math:`\lambda L_{churn}`. The released code copies the network at every update to have
    :math:`\theta_{t-1}`. Here the outputs that are needed of it are computed while it is still the current network, so no
    copy is made: one forward pass, and one forward and backward pass per update.

    The first update has no previous one, and so no churn loss.

    The reference batch that awaits its next update, the outputs on it, and the history of λ are in ``state_dict()``.

    :param outputs: Maps observations to the outputs that should not churn. Called with gradients enabled or disabled.
    :param divergence: Compares outputs before and after, ``divergence(old, new)``
    :param coefficient: λ
    """

    def __init__(
        self,
        outputs: Callable[[Any], th.Tensor],
        divergence: Divergence,
        coefficient: ChurnCoefficient,
    ):
        super().__init__()
        # Not a submodule, where it is a module: the network is not part of the reducer's state
        self._outputs = [outputs]
        self.divergence = divergence
        self.coefficient = coefficient
        # Whether the training loop has warned that it found no reference batch outside the minibatch
        self.warned_of_overlap = False
        self.reference: Observations | None = None
        self.old_outputs: th.Tensor | None = None
        # Since the last `end_iteration()`, one for each update: the churn loss, and the outputs before and after
        self.losses: list[float] = []
        self.compared: list[tuple[th.Tensor, th.Tensor]] = []

    def backward(self, reference: Observations, backward: Callable[[th.Tensor], Any] = th.Tensor.backward) -> None:
        """
        Add the gradient of λ·L_churn, and remember the present outputs on ``reference`` for the next update.

        To be called once per update, between ``zero_grad()`` and the optimiser's step.

        :param reference: Observations outside the minibatch of the update that is about to be made
        :param backward: Takes λ·L_churn and adds its gradient
        :raises ValueError: When the churn loss is NaN or infinite. The parameters have not been touched.
        """
        if self.reference is not None:
            with th.enable_grad():
                loss = self.loss(self._outputs[0](self.reference))
            if loss.requires_grad:  # not all that the outputs depend on is frozen
                backward(loss)
        self.remember(reference)

    def loss(self, new_outputs: th.Tensor) -> th.Tensor:
        """
        For a training loop that has the outputs on ``self.reference`` from a forward pass of its own.

        :param new_outputs: The present outputs on ``self.reference``, which must not be None
        :return: λ·L_churn
        :raises ValueError: When the churn loss is NaN or infinite
        """
        assert self.old_outputs is not None
        churn_loss = self.divergence(self.old_outputs, new_outputs)
        loss = churn_loss.item()
        if not -float("inf") < loss < float("inf"):
            raise ValueError(
                f"The churn loss is {loss}: the network's outputs, or the observations, hold NaN or infinite values. "
                "The parameters have not been updated. Lower the learning rate or `churn_coef`, or set `max_grad_norm`."
            )
        if not self.losses:  # λ changes between iterations only
            self._coef = self.coefficient.value
        self.losses.append(loss)
        self.compared.append((self.old_outputs, new_outputs.detach()))
        return self._coef * churn_loss

    def remember(self, reference: Observations, outputs: th.Tensor | None = None) -> None:
        """
        Keep the present outputs on ``reference`` for the next update.

        :param reference: Observations outside the minibatch of the update that is about to be made
        :param outputs: The outputs, without gradient, where the training loop has them
        """
        if outputs is None:
            with th.no_grad():
                outputs = self._outputs[0](reference)
        self.reference, self.old_outputs = reference, outputs

    def mean_churn(self) -> float:
        """
        :return: Mean over the samples since the last ``end_iteration()`` of the churn loss less its value were there no churn;
            with the cross-entropy, the Kullback-Leibler divergence KL(old ‖ new). NaN before the second update.
        """
        if not self.losses:
            return float("nan")
        sizes = [len(old) for old, _ in self.compared]
        mean_loss = sum(loss * size for loss, size in zip(self.losses, sizes, strict=True)) / sum(sizes)
        unmoved = th.cat([old for old, _ in self.compared])
        return mean_loss - self.divergence(unmoved, unmoved).item()

    def end_iteration(self, base_loss: float) -> None:
        """
        Give λ the losses since the last call; without an update in between there is nothing to give.

        :param base_loss: The mean over these updates of the loss that the churn loss was added to
        """
        if self.losses:
            self.coefficient.update(base_loss, sum(self.losses) / len(self.losses))
        self.discard_losses()

    def discard_losses(self) -> None:
        """Forget the losses since the last ``end_iteration()``, as when training was interrupted in between."""
        self.losses, self.compared = [], []

    def forget_reference(self) -> None:
        """Drop the reference batch: the next update has no churn loss (after the network was replaced, say)."""
        self.reference = self.old_outputs = None

    def move_reference(self, device: th.device | str) -> None:
        """
        :param device: Where the network is; the state that was loaded may come from elsewhere
        """
        if isinstance(self.reference, dict):
            self.reference = {key: tensor.to(device) for key, tensor in self.reference.items()}
        elif self.reference is not None:
            self.reference = self.reference.to(device)
        if self.old_outputs is not None:
            self.old_outputs = self.old_outputs.to(device)

    def get_extra_state(self) -> dict[str, Any]:
        """
        :return: What ``state_dict()`` holds beside the buffers
        """
        return {"reference": self.reference, "old_outputs": self.old_outputs}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """
        :param state: What ``get_extra_state()`` returned
        """
        self.reference = state["reference"]
        self.old_outputs = state["old_outputs"]
