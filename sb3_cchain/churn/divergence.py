"""
How far a network's outputs moved: pure functions of the outputs before (``old``) and after (``new``) an update.

A divergence, from which a loss is made, returns a scalar tensor: the mean over the batch. ``old`` is a constant: no gradient
flows into it. The other functions return numbers to log.
"""

from collections.abc import Callable

import torch as th
from torch.nn import functional as F

Divergence = Callable[[th.Tensor, th.Tensor], th.Tensor]

# Inside the logarithm, as in the code released with the paper
LOG_EPS = 1e-8


def cross_entropy(old: th.Tensor, new: th.Tensor) -> th.Tensor:
    r"""
    Cross-entropy of categorical distributions, :math:`-\sum_a p_{old}(a) \log(p_{new}(a) + 10^{-8})`.

    Its value includes the entropy of ``old``, which sets the scale of the target ratio β (1e3 to 1e5 in the paper).
    ``cross_entropy(old, new) - cross_entropy(old, old)`` is the Kullback-Leibler divergence KL(old ‖ new).

    :param old: Probabilities before the update, ``(batch_size, ..., n_categories)``. Dimensions between the first and
        the last are independent distributions (the sub-actions of ``MultiDiscrete``); they are summed.
    :param new: Probabilities after the update, of the same shape
    :return: Mean over the batch
    :raises ValueError: When the shapes differ or the batch is empty
    """
    check_batches(old, new, n_dims=2)
    return th.xlogy(old, new + LOG_EPS).sum() / -len(old)


def mean_squared_difference(old: th.Tensor, new: th.Tensor) -> th.Tensor:
    """
    Mean squared difference over batch and outputs: action means of a Gaussian policy, or action values.

    :param old: Outputs before the update, ``(batch_size, ...)``
    :param new: Outputs after the update, of the same shape
    :return: Mean over all elements
    :raises ValueError: When the shapes differ or the batch is empty
    """
    check_batches(old, new)
    return F.mse_loss(new, old)


def mean_absolute_change(old: th.Tensor, new: th.Tensor) -> float:
    """
    :param old: Values before, of any shape
    :param new: Values after, of the same shape
    :return: Mean over all elements of the absolute difference
    :raises ValueError: When the shapes differ or the batch is empty
    """
    check_batches(old, new)
    return (new - old).abs().mean().item()


def action_changes(old: th.Tensor, new: th.Tensor) -> float:
    """
    :param old: Actions before, ``(batch_size,)`` or ``(batch_size, n_sub_actions)``
    :param new: Actions after, of the same shape
    :return: Share of the states in which the action, or any of its sub-actions, is another one
    :raises ValueError: When the shapes differ or the batch is empty
    """
    check_batches(old, new)
    changed = old != new
    if changed.dim() > 1:
        changed = changed.flatten(start_dim=1).any(dim=1)
    return changed.sum().item() / len(old)


def check_batches(old: th.Tensor, new: th.Tensor, n_dims: int = 1) -> None:
    """
    :param old: Outputs before, ``(batch_size, ...)``
    :param new: Outputs after, of the same shape; PyTorch would broadcast other shapes without a word
    :param n_dims: The least number of dimensions
    :raises ValueError: When the shapes differ, have fewer dimensions or the batch is empty
    """
    if old.shape != new.shape:
        raise ValueError(f"`old` and `new` must have the same shape, got {tuple(old.shape)} and {tuple(new.shape)}")
    if old.dim() < n_dims or old.numel() == 0:
        raise ValueError(
            f"`old` and `new` must be batches of {n_dims} or more dimensions that are not empty, got shape {tuple(old.shape)}"
        )
