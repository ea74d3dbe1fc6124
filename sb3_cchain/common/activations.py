"""Which of torch's modules are activation functions."""

from torch import nn

# Of each entry by itself. Dropout is none: it does nothing to a policy that acts.
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

# Those whose units are off, and pass no gradient, for inputs below 0
RECTIFIERS = (nn.ReLU, nn.ReLU6)
