"""Activation functions: a list of those of torch, and concatenated ReLU."""

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
