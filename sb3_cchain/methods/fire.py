"""FIRE: Frobenius-isometry reinitialisation."""

import math

import torch as th
from torch import nn

from sb3_cchain.methods.switch_or_interval import SwitchOrInterval
from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.networks.layers import LAYERS
from sb3_cchain.networks.model_optimizers import model_optimizers
from sb3_cchain.tensorboard.layout import add_charts
from sb3_cchain.validation import check_bool, check_number

add_charts("Related methods", {"FIRE: reinitialisations": "fire/n_resets"})


class FIRE(SwitchOrInterval):
    r"""
    Makes the weights of each layer orthogonal, at each task switch or every ``interval`` environment steps (Frobenius-isometry
    reinitialisation): each weight matrix :math:`W` becomes

    .. math:: \sqrt{\frac{d_{out}}{d_{in}}} \; \tilde W, \quad \tilde W = W (W^T W)^{-1/2}
              = \underset{X^T X = I}{\operatorname{argmin}} \|X - W\|_F^2 .

    Of all matrices with equal singular values, on which plasticity is taken to depend, it is the nearest to the trained one.
    :math:`\tilde W` is computed by Newton–Schulz iterations

    .. math:: X_0 = W / \|W\|_F, \quad X \leftarrow 1.5 \, X - 0.5 \, X X^T X,

    which stop short of the least singular values. Biases and the parameters of LayerNorms stay.

    Paper: "FIRE: Frobenius-Isometry Reinitialization for Balancing the Stability-Plasticity Tradeoff",
    https://arxiv.org/abs/2602.08040 (Han et al., ICLR 2026). As in its code (https://github.com/isaac7778/FIRE), all linear
    and convolutional layers are done, output layers included. Of a convolution each position of the kernel is a matrix, and
    the result is divided by the number of positions. Target networks get the same weights. The code's SAC begins with a new
    optimiser, which is the default here. Its DQN keeps the optimiser, and redraws the linear layers instead, for which see
    :class:`LayerReset`.

    It works with any algorithm. Layers that are frozen, as by :class:`PlasticityInjection`, are left alone, and so are
    recurrent ones. The outputs of the network change; SB3's PPO begins with action weights of norm 0.01, which FIRE makes
    larger, so the policy may become more deterministic. It happens between rollouts, so up to a rollout late; see
    :class:`Oracle` for task switches. C-CHAIN then forgets its reference batch. It costs a few matrix products per layer.

    Logged: ``fire/n_resets``, how often it was done since ``learn()`` was called.

    :param interval: Environment steps between two reinitialisations, in all environments together, counted from the start of
        the training; None for one at each task switch
    :param n_iterations: Newton–Schulz iterations
    :param reset_moments: Whether the optimiser forgets the moments and step counts of the weights
    :raises ValueError: Naming the argument that is out of its range
    :raises TypeError: When ``reset_moments`` is not a boolean; when training starts, with ``interval=None`` for an environment
        that is not continual
    """

    name = "fire"

    def __init__(
        self,
        interval: int | None = None,
        n_iterations: int = 10,
        reset_moments: bool = True,
    ):
        super().__init__(interval)
        check_number("n_iterations", n_iterations, 1, integer=True)
        check_bool("reset_moments", reset_moments)
        self.n_iterations = n_iterations
        self.reset_moments = reset_moments

    def _act(self) -> None:
        policy = uncompiled(self.model.policy)
        # A weight that networks share has a name in each of them, and maybe a copy in the target network of one
        weights = dict(policy.named_parameters(remove_duplicate=False))
        isometries = {
            weights[name]: nearest_isometry(weights[name].detach(), self.n_iterations) for name in trained_weights(policy)
        }
        for name, weight in weights.items():
            network, _, rest = name.partition(".")
            online = weights.get(f"{network.removesuffix('_target')}.{rest}", weight)
            if online in isometries:
                with th.no_grad():
                    weight.copy_(isometries[online])
        if self.reset_moments:
            for optimizer in model_optimizers(self.model).values():
                for weight in isometries:
                    optimizer.state.pop(weight, None)


def trained_weights(policy: nn.Module) -> list[str]:
    """
    :param policy: A policy
    :return: Names of the weights of its linear and convolutional layers that are trained
    """
    return [
        f"{name}.weight"
        for name, module in policy.named_modules()
        if isinstance(module, LAYERS) and module.weight.requires_grad and not name.partition(".")[0].endswith("_target")
    ]


def nearest_isometry(weight: th.Tensor, n_iterations: int = 10) -> th.Tensor:
    """
    :param weight: Of a linear layer, ``(n_outputs, n_inputs)``, or of a convolution, with the positions of the kernel behind
    :param n_iterations: Newton–Schulz iterations
    :return: The nearest isometry times √(n_outputs / n_inputs), divided by the number of positions, of the same shape
    """
    n_outputs, n_inputs = weight.shape[:2]
    matrices = weight.flatten(start_dim=2).movedim(2, 0) if weight.dim() > 2 else weight[None]
    scale = math.sqrt(n_outputs / n_inputs) / len(matrices)
    is_wide = n_inputs > n_outputs
    isometry = matrices.mT if is_wide else matrices
    isometry = isometry / isometry.norm(dim=(1, 2), keepdim=True).clamp(min=th.finfo(weight.dtype).tiny)
    for _ in range(n_iterations):
        isometry = 1.5 * isometry - 0.5 * isometry @ (isometry.mT @ isometry)
    isometry = isometry.mT if is_wide else isometry
    return scale * (isometry.movedim(0, 2).reshape(weight.shape) if weight.dim() > 2 else isometry[0])
