"""The weight λ of the churn loss: fixed, or set so that the churn loss keeps its ratio to the base loss."""

import math
from collections.abc import Callable
from typing import Any

import torch as th
from torch import nn

from sb3_cchain.validation import check_number

# λ multiplies a loss in single precision
GREATEST = th.finfo(th.float32).max
# Beside the churn loss, as in the released code: a network that does not churn at all has no ratio
LOSS_EPS = 1e-8


class ChurnCoefficient(nn.Module):
    """
    A fixed λ. Also the interface of every λ: ``value``, ``is_zero``, ``update(base_loss, churn_loss)``, ``reset()`` and
    ``problem()``.

    :param initial: λ; 0 switches churn reduction off
    :raises ValueError: When it is negative, NaN, infinite or beyond single precision
    """

    def __init__(self, initial: float):
        super().__init__()
        _check_factor("churn_coef", initial)
        self.initial: float = float(initial)

    @property
    def value(self) -> float:
        """λ, the factor of the churn loss."""
        return self.initial

    @property
    def is_zero(self) -> bool:
        """Whether λ is and stays 0."""
        return self.initial == 0

    def update(self, base_loss: float, churn_loss: float) -> None:
        """
        Take the losses of a finished iteration (or update) into account.

        :param base_loss: The loss that the churn loss is added to
        :param churn_loss: The churn loss, not multiplied by λ
        :raises ValueError: When one of them is NaN or infinite; nothing has changed then
        """
        for name, loss in (("base_loss", base_loss), ("churn_loss", churn_loss)):
            if not math.isfinite(loss):
                raise ValueError(
                    f"`{name}` must be finite, got {loss}: look for NaN or infinite rewards and observations, or a learning "
                    "rate that is too high."
                )

    def problem(self, n_still: int = 0) -> str | None:
        """
        :param n_still: The last iterations in a row in which the outputs moved by no more than ``LOSS_EPS``
        :return: Why λ cannot do what it is for; None where it can
        """
        return None

    def reset(self) -> None:
        """Forget the losses seen, as the released code does when the task switches."""


class AdaptiveChurnCoefficient(ChurnCoefficient):
    r"""
    :math:`\lambda = \beta \, \overline{|L|} \, / \, \overline{|L_{churn}|}`, with running means over a window
    (Appendix A.1 of the C-CHAIN paper; warm-up, window and minimum as in the released code).

    An iteration is what happens between two calls of ``update``: one ``train()`` of PPO, one gradient step of DQN.
    The history is kept in buffers, in double precision and on the CPU, so it is saved and restored with ``state_dict``. An
    update costs the same for any window.

    :param target_ratio: β, the size of λ·L_churn relative to L
    :param initial: λ during the warm-up
    :param warmup: Iterations (calls of ``update``) until λ adapts
    :param window: Iterations that the running means go over
    :param minimum: λ after the warm-up is at least this
    :raises ValueError: Naming the argument that is out of its range
    """

    base_losses: th.Tensor
    churn_losses: th.Tensor
    sums: th.Tensor
    n_seen: th.Tensor

    def __init__(self, target_ratio: float, initial: float = 1.0, warmup: int = 10, window: int = 50, minimum: float = 0.0):
        super().__init__(initial)
        _check_factor("target_churn_ratio", target_ratio, exclusive=True)
        check_number("churn_warmup", warmup, minimum=0, integer=True)
        check_number("churn_window", window, minimum=1, integer=True)
        _check_factor("churn_coef_min", minimum)
        self.target_ratio: float = float(target_ratio)
        self.warmup = warmup
        self.minimum: float = float(minimum)
        self.register_buffer("base_losses", th.zeros(window, dtype=th.float64, device="cpu"))
        self.register_buffer("churn_losses", th.zeros(window, dtype=th.float64, device="cpu"))
        # Of the base and the churn losses in the window
        self.register_buffer("sums", th.zeros(2, dtype=th.float64, device="cpu"))
        self.register_buffer("n_seen", th.zeros((), dtype=th.int64, device="cpu"))

    def _apply(self, fn: Callable[..., Any], recurse: bool = True) -> "AdaptiveChurnCoefficient":
        """Stay on the CPU in double precision, which not every device has: only numbers go in and out."""
        return self

    @property
    def value(self) -> float:
        """λ, the factor of the churn loss."""
        n_seen = int(self.n_seen)
        if n_seen < max(self.warmup, 1):
            return self.initial
        n_kept = min(n_seen, len(self.base_losses))
        base_sum, churn_sum = self.sums.tolist()
        return max(self.target_ratio * base_sum / (churn_sum + n_kept * LOSS_EPS), self.minimum)

    @property
    def is_zero(self) -> bool:
        """Whether λ is and stays 0."""
        return False

    def update(self, base_loss: float, churn_loss: float) -> None:
        """
        Take the losses of a finished iteration into account.

        :param base_loss: The loss that the churn loss is added to; its absolute value counts
        :param churn_loss: The churn loss, not multiplied by λ; its absolute value counts
        :raises ValueError: When one of them is NaN or infinite; nothing has changed then
        """
        super().update(base_loss, churn_loss)
        slot = int(self.n_seen) % len(self.base_losses)
        sums = self.sums.numpy()
        for index, (buffer, loss) in enumerate(((self.base_losses, base_loss), (self.churn_losses, churn_loss))):
            history = buffer.numpy()  # the same memory; elements of a tensor take ten times as long to read and write
            forgotten = float(history[slot])
            history[slot] = abs(loss)
            sums[index] += abs(loss) - forgotten
            # Recompute the sum once per window, and when most of it leaves, so that rounding errors do not add up or stay
            if slot == len(history) - 1 or forgotten > sums[index]:
                sums[index] = buffer.sum()
        self.n_seen.add_(1)

    def problem(self, n_still: int = 0) -> str | None:
        """
        :param n_still: The last iterations in a row in which the outputs moved by no more than ``LOSS_EPS``. The churn loss
            does not tell: a cross-entropy holds the entropy of the old policy, too
        :return: Right after a window has ended, why churn reduction did nothing in it; None where it did something, and at
            other times
        """
        n_seen, window = int(self.n_seen), len(self.base_losses)
        if n_seen % window or n_seen < self.warmup or not n_seen:
            return None
        base_loss, churn_loss = (self.sums / window).tolist()
        # First, because the surrogate loss of a policy that stays as it is, is 0, too
        if churn_loss <= LOSS_EPS or n_still >= window:
            loss = f"the outputs of the network hardly change (their mean change is no more than {LOSS_EPS:g})"
            advice = f"there may be no churn to reduce: the churn loss does nothing, with a λ of {self.value:.2g}"
        elif base_loss <= LOSS_EPS:
            loss = f"the loss that it is compared with is almost 0 (mean absolute value {base_loss:.2g})"
            advice = f"churn is hardly reduced: λ is {self.value:.2g}. Give a fixed `churn_coef`, or a `churn_coef_min`"
        else:
            return None
        return f"Over {window} iterations of churn reduction, {loss}; {advice}."

    def reset(self) -> None:
        """Forget the losses seen and begin a new warm-up."""
        for buffer in self.buffers():
            buffer.zero_()


def make_coefficient(
    churn_coef: float | str,
    target_ratio: float | str,
    default_target_ratio: float,
    *,
    warmup: int,
    window: int,
    minimum: float,
) -> ChurnCoefficient:
    """
    Read ``churn_coef`` as SAC reads ``ent_coef``: a number is a fixed λ, ``"auto"`` adapts it, ``"auto_10"`` adapts it
    and uses 10 during the warm-up.

    :param churn_coef: λ, ``"auto"`` or ``"auto_<initial value>"``
    :param target_ratio: β, or ``"auto"`` for the default
    :param default_target_ratio: The default β
    :param warmup: Iterations until λ adapts
    :param window: Iterations that the running means go over
    :param minimum: λ after the warm-up is at least this
    :return: The coefficient
    :raises ValueError: Naming the argument, when it cannot be read or lies outside its range
    """
    is_adaptive = isinstance(churn_coef, str) and churn_coef.startswith("auto")
    initial = 1.0
    if churn_coef != "auto":
        number = str(churn_coef).removeprefix("auto_") if is_adaptive else churn_coef
        initial = _number("churn_coef", churn_coef, number, _CHURN_COEF)
    if target_ratio == "auto":
        target_ratio = default_target_ratio
    ratio = _number("target_churn_ratio", target_ratio, target_ratio, ' or "auto"')
    # Made for a fixed λ, too, so that all arguments are checked
    adaptive = AdaptiveChurnCoefficient(ratio, initial, warmup, window, minimum)
    return adaptive if is_adaptive else ChurnCoefficient(initial)


_CHURN_COEF = ', "auto", or "auto_" followed by the value during warm-up, as in "auto_10"'


def _number(name: str, value: object, number: object, alternatives: str) -> float:
    # Strings too: that is how numbers come from a command line
    try:
        if isinstance(number, bool):
            raise TypeError
        return float(number)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise ValueError(f"`{name}` must be a number{alternatives}; got {value!r}") from None


def _check_factor(name: str, value: float, exclusive: bool = False) -> None:
    check_number(name, value, minimum=0, exclusive=exclusive)
    if value > GREATEST:
        raise ValueError(f"`{name}` must be at most {GREATEST:.3g}, the greatest number in single precision, got {value!r}")
