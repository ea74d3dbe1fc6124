"""Runs a network as it acts, inside of training."""

from collections.abc import Iterator
from contextlib import contextmanager

from torch import nn


@contextmanager
def evaluation_mode(network: nn.Module) -> Iterator[None]:
    """
    Running BatchNorm statistics and no dropout inside the ``with`` block. Recurrent layers keep their mode, because cuDNN
    computes no gradient of them in evaluation mode; their dropout is 0 meanwhile.

    :param network: A network; each of its modules gets its mode back afterwards
    """
    modes = [(module, module.training) for module in network.modules()]
    recurrent = [(module, module.training, module.dropout) for module in network.modules() if isinstance(module, nn.RNNBase)]
    network.eval()
    for layer, training, _ in recurrent:
        layer.training, layer.dropout = training, 0.0
    try:
        yield
    finally:
        for layer, _, dropout in recurrent:
            layer.dropout = dropout
        for module, training in modes:
            module.training = training
