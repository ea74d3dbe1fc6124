"""TRAC."""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch.optim.optimizer import ParamsT

from sb3_cchain.methods.optimizer_wrapper import OptimizerWrapper
from sb3_cchain.tensorboard.layout import add_charts
from sb3_cchain.validation import check_list, check_number

add_charts("Related methods", {"TRAC: scale": "trac/scale(_.+)?"})


class TRAC(OptimizerWrapper):
    """
    TRAC, a parameter-free tuner around any optimiser. It scales the distance by which the base has moved the parameters from
    where they started. The factor S grows while the gradients agree with that direction, and shrinks, down to 0, when not.

    Paper: https://arxiv.org/abs/2405.16642 (Muppidi et al., NeurIPS 2024, Algorithms 1 and 2). With parameters θ, which start
    at θ_ref, gradient g, base update u, and a tuner for each discount β with σ (1e-8 at first) and v (0), an update is

    - h = ⟨g, d⟩, where d = (θ − θ_ref) / (S + ε)
    - v ← β² v + h², σ ← β σ − h
    - S = Σ_β s₀ · erfi(σ / (√(2v) + ε)) / erfi(1/√2)
    - θ ← θ_ref + (d + u) · max(S, 0)

    with one S over all parameters. Up to rounding it equals the authors' package, ``trac-optimizer`` 0.0.2, including that
    package's approximation of erfi, which is off by up to 1.1 % near 0. Unlike the package, it can be saved and loaded, writes
    no file, and leaves gradients enabled when something fails.

    Logged: ``trac/scale``, max(S, 0).

    Each update costs a copy of the parameters and a few operations per parameter tensor (on a GPU, one synchronisation). One
    more copy of the parameters is kept.

    :param params: Parameters or parameter groups
    :param lr: Learning rate of the base
    :param betas: Discounts, one or more, with a tuner for each
    :param s_init: s₀, the scale to start from
    :param eps: ε
    :param kwargs: ``base_class`` and ``base_kwargs``, as for :class:`~sb3_cchain.methods.OptimizerWrapper`
    :raises TypeError: When ``betas`` is not a list
    :raises ValueError: Naming the argument that is out of its range; in ``step()``, when the gradients are not finite
    """

    name = "trac"

    def __init__(
        self,
        params: ParamsT,
        lr: float | th.Tensor = 1e-3,
        *,
        betas: Iterable[float] = (0.9, 0.99, 0.999, 0.9999, 0.99999, 0.999999),
        s_init: float = 1e-8,
        eps: float = 1e-8,
        **kwargs: Any,
    ):
        self.betas = check_list("betas", betas, of="numbers")
        if not self.betas:
            raise ValueError("`betas` must be one discount or more, got an empty list")
        for beta in self.betas:
            check_number("betas", beta, minimum=0, maximum=1)
        check_number("s_init", s_init, minimum=0, exclusive=True)
        check_number("eps", eps, minimum=0, exclusive=True)
        self.s_init = s_init
        self.eps = eps
        super().__init__(params, lr, **kwargs)

    def _step(self) -> None:
        own = self.own_state
        scale = own.get("scale", 0.0)
        trained = [(p, start) for p, start in zip(self.parameters(), self.reference(), strict=True) if p.grad is not None]
        before = [parameter.clone() for parameter, _ in trained]
        directions = [(parameter - start) / (scale + self.eps) for parameter, start in trained]
        h = float(sum((d * p.grad).sum() for d, (p, _) in zip(directions, trained, strict=True)))
        if not math.isfinite(h):
            raise ValueError(f"TRAC needs finite gradients; their product with the distance moved is {h}")

        super()._step()

        own["scale"] = scale = self._tune(h)
        for (parameter, start), old, direction in zip(trained, before, directions, strict=True):
            parameter.copy_(start + (direction + (parameter - old)) * max(scale, 0.0))

    def _tune(self, h: float) -> float:
        own = self.own_state
        betas = np.array(self.betas)
        sigma = betas * own.get("sigma", np.full(len(betas), 1e-8)) - h
        variance = betas**2 * own.get("variance", np.zeros(len(betas))) + h**2
        own["sigma"], own["variance"] = sigma.tolist(), variance.tolist()  # as lists, `th.load(weights_only=True)` takes them
        scales = erfi(sigma / (np.sqrt(2 * variance) + self.eps)) / erfi(np.sqrt([0.5]))
        return float(self.s_init * scales.sum())

    def metrics(self) -> dict[str, float]:
        """
        :return: ``trac/scale``, and the metrics of the wrappers inside
        """
        return {**super().metrics(), "trac/scale": max(self.own_state.get("scale", 0.0), 0.0)}


def _weideman_coefficients(n: int = 128) -> tuple[float, NDArray[Any]]:
    """
    Coefficients of Weideman's rational approximation of w(z) = exp(−z²) erfc(−iz) (SIAM J. Numer. Anal. 31(5), 1994). He takes
    4n points and the value 0 at infinity. trac-optimizer leaves out the value at infinity, so it is left out here too.

    :param n: Number of terms
    :return: The scale L, and the coefficients, highest power first
    """
    scale = math.sqrt(n / math.sqrt(2))
    points = scale * np.tan(np.arange(1 - 2 * n, 2 * n) * math.pi / (4 * n))
    values = np.exp(-(points**2)) * (scale**2 + points**2)
    return scale, (np.fft.fft(np.fft.fftshift(values)).real / (4 * n))[n:0:-1]


_L, _COEFFICIENTS = _weideman_coefficients()


def erfi(x: NDArray[Any]) -> NDArray[Any]:
    """
    The imaginary error function as ``trac-optimizer`` computes it: up to 1.1 % too small near 0, 0.2 % too large at 2.

    :param x: Real numbers, ``(n,)``
    :return: −i·erf(ix) = exp(x²)·Im w(x), nearly, ``(n,)``; infinite beyond the range of floating-point numbers
    """
    denominator = _L - 1j * x
    powers = np.vander((_L + 1j * x) / denominator, len(_COEFFICIENTS))
    w = 2 * (powers @ _COEFFICIENTS) / denominator**2 + 1 / (math.sqrt(math.pi) * denominator)
    with np.errstate(over="ignore"):
        return np.exp(x**2) * w.imag
