"""Activation functions: a list of those of torch, concatenated ReLU, and sines with cosines."""

import torch as th
from torch import nn

# They act on each entry alone. Dropout is not listed: it does nothing while a policy acts.
ELEMENTWISE_ACTIVATIONS = (
    nn.CELU,
    nn.ELU,
    nn.GELU,
    nn.Hardswish,
    nn.Hardtanh,
    nn.LeakyReLU,
    nn.Mish,
    nn.ReLU,
    nn.ReLU6,
    nn.SELU,
    nn.Sigmoid,
    nn.SiLU,
    nn.Softplus,
    nn.Tanh,
)

# Their units are off, and pass no gradient, for inputs below 0
RECTIFIERS = (nn.ReLU, nn.ReLU6)


class CReLU(nn.Module):
    """
    Concatenated ReLU, ``[relu(x), relu(-x)]``: twice as many features as units. One of the two features of a
    unit is active unless the unit's output is zero.

    Shang et al. (ICML 2016), https://arxiv.org/abs/1603.05201; against the loss of plasticity: Abbas et al. (CoLLAs 2023),
    https://arxiv.org/abs/2303.07507.
    """

    # Features for each unit
    expansion = 2

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """
        :param inputs: ``(batch_size, n_units, ...)``
        :return: ``(batch_size, 2 * n_units, ...)``
        """
        return th.cat([inputs, -inputs], dim=1).relu()


class FourierFeatures(nn.Module):
    """
    Deep Fourier features, ``[sin(x), cos(x)]``: twice as many features as units. Where the one is saturated, the other is
    close to linear, so a unit always passes a gradient.

    "Plastic Learning with Deep Fourier Features", Lewandowski et al. (2024), https://arxiv.org/abs/2410.20634. It is assumed
    here that all hidden layers have them, without a factor on the inputs or the features. To compare networks of as many
    features, halve the number of units.
    """

    # Features for each unit
    expansion = 2

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """
        :param inputs: ``(batch_size, n_units, ...)``
        :return: ``(batch_size, 2 * n_units, ...)``
        """
        return th.cat([inputs.sin(), inputs.cos()], dim=1)
