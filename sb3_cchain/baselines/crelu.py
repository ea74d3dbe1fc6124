"""Concatenated ReLU."""

import torch as th
from torch import nn


class CReLU(nn.Module):
    """
    Concatenated ReLU, ``[relu(x), relu(-x)]``: twice as many features as units, of which a unit's one or other is active
    unless its output is zero.

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
