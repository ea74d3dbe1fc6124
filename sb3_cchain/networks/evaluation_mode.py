"""Runs a network as it acts, inside of training."""

from collections.abc import Iterator
from contextlib import contextmanager

from torch import nn


@contextmanager
def evaluation_mode(network: nn.Module) -> Iterator[None]:
    """
    Running BatchNorm statistics and no dropout inside the ``with`` block. Recurrent layers without dropout, which act alike in
    both modes, stay as they are: cuDNN computes no gradient in evaluation mode.

    :param network: A network; each of its modules gets its mode back afterwards
    """
    modes = [(module, module.training) for module in network.modules()]
    network.eval()
    for module, training in modes:
        if isinstance(module, nn.RNNBase) and module.dropout == 0:
            module.training = training
    try:
        yield
    finally:
        for module, training in modes:
            module.training = training
