"""Linear layers of spectral norm 1."""

import torch as th
from torch import nn
from torch.nn import functional as F

# From a vector that knows nothing of the weight
N_ITERATIONS = 15


class SpectralNormLinear(nn.Linear):
    r"""
    A linear layer whose weight is divided by its greatest singular value: :math:`y = \frac{W}{\sigma(W)} x + b`.

    Paper: https://arxiv.org/abs/1802.05957 (Miyato et al., ICLR 2018), by power iteration as there: with a vector :math:`u` of
    norm 1, :math:`\sigma \approx \|W^\top u\|`, and each forward pass in training mode makes
    :math:`u \leftarrow W W^\top u / \|W W^\top u\|` for the next one. In evaluation mode :math:`u` stays.

    The vector is called ``running_u``, because Stable-Baselines3 copies to target networks, besides the parameters, those
    buffers whose names contain ``running_``. The target network therefore computes what the network computed when it was
    copied. (``torch.nn.utils.parametrizations.spectral_norm`` calls it ``_u``, and its copy would be left behind.)

    :param in_features: Number of inputs
    :param out_features: Number of outputs
    """

    running_u: th.Tensor

    def __init__(self, in_features: int, out_features: int):
        super().__init__(in_features, out_features)
        self.register_buffer("running_u", F.normalize(th.randn(out_features), dim=0))
        self.iterate(N_ITERATIONS)

    @th.no_grad()
    def iterate(self, n_iterations: int = 1) -> None:
        """
        Bring the estimated singular value nearer to the greatest one.

        :param n_iterations: Number of power iterations
        """
        for _ in range(n_iterations):
            # In place, because SB3 keeps the tensor
            self.running_u.copy_(F.normalize(self.weight @ (self.weight.T @ self.running_u), dim=0))

    def forward(self, input: th.Tensor) -> th.Tensor:
        """
        :param input: ``(batch_size, in_features)``
        :return: ``(batch_size, out_features)``
        """
        # A copy, which the gradient needs as it is now
        sigma = (self.weight.T @ self.running_u.clone()).norm().clamp(min=1e-12)
        outputs = F.linear(input, self.weight / sigma, self.bias)
        if self.training:
            self.iterate()
        return outputs


def settle_spectral_norms(network: nn.Module) -> None:
    """
    Estimate the singular values again, after something other than an update has changed the weights.

    :param network: A network, which may have no :class:`SpectralNormLinear`
    """
    for module in network.modules():
        if isinstance(module, SpectralNormLinear):
            module.iterate(N_ITERATIONS)
