"""Runs a network as it acts, inside of training."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

from torch import nn

from sb3_cchain.networks.policy_networks import FORWARD_HOOKS
from sb3_cchain.networks.spectral_norm import SpectralNormLinear

# Switching the mode twice per update costs several per cent of an MLP's update, so it is done only where it may matter
_MODE_FREE_PACKAGES = (
    "stable_baselines3.",
    "sb3_cchain.",
    # Not `common.torch_layers`, which has BatchRenorm
    *(f"sb3_contrib.{package}." for package in ("common.maskable", "common.recurrent", "crossq", "qrdqn", "tqc")),
    "torch._dynamo.eval_frame",  # what torch.compile() wraps around a module
    "torch.nn.modules.activation",
    "torch.nn.modules.container",
    "torch.nn.modules.conv",
    "torch.nn.modules.flatten",
    "torch.nn.modules.linear",
    "torch.nn.modules.normalization",
    "torch.nn.modules.pooling",
    "torch.nn.modules.rnn",
)
_MODE_DEPENDENT_MODULES = (nn.RReLU, nn.MultiheadAttention, SpectralNormLinear)


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


def has_training_mode(policy: nn.Module) -> bool:
    """
    :param policy: A policy
    :return: Whether it may act otherwise in training than in evaluation mode, as it does with BatchNorm, dropout, a module
        that is not known here, or a forward hook, such as that of ``torch.nn.utils.spectral_norm()``
    """
    return any(
        not type(module).__module__.startswith(_MODE_FREE_PACKAGES)
        or isinstance(module, _MODE_DEPENDENT_MODULES)
        or (isinstance(module, nn.RNNBase) and module.dropout > 0)
        or any(getattr(module, kind) for kind in FORWARD_HOOKS)
        for module in policy.modules()
    )


def as_it_acts(network: nn.Module) -> AbstractContextManager[None]:
    """
    :param network: A network
    :return: :func:`evaluation_mode`, where that makes a difference
    """
    return evaluation_mode(network) if has_training_mode(network) else nullcontext()
