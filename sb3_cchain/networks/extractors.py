"""Feature extractors."""

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn


class _ImageExtractor(BaseFeaturesExtractor):
    """
    Convolutions and linear layers on images of either layout.

    :param observation_space: ``Box`` of shape (height, width, channels), of any dtype; or an image that SB3 has transposed to
        (channels, height, width)
    :param features_dim: Number of features
    :param min_size: Least height and width
    :raises ValueError: For another observation space, or a smaller one
    """

    cnn: nn.Sequential
    linear: nn.Sequential
    channels_first: bool
    n_channels: int
    height: int
    width: int

    def __init__(self, observation_space: spaces.Box, features_dim: int, min_size: int = 1):
        super().__init__(observation_space, features_dim)
        needs = (
            f"{type(self).__name__} needs Box observations of shape (height, width, channels), at least {min_size} high and "
            f"wide; got {observation_space}"
        )
        shape = observation_space.shape
        if not isinstance(observation_space, spaces.Box) or len(shape) != 3:
            raise ValueError(needs)
        # SB3 transposes images: `uint8`, from 0 to 255
        self.channels_first = is_image_space(observation_space) and shape[0] < shape[2]
        self.n_channels, self.height, self.width = shape if self.channels_first else (shape[2], *shape[:2])
        if min(self.height, self.width) < min_size:
            raise ValueError(needs)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """
        :param observations: A batch of them
        :return: Features ``(batch_size, features_dim)``
        """
        images = observations if self.channels_first else observations.permute(0, 3, 1, 2)
        # The layout that convolutions are fastest in; flattened in the order that it lies in memory, which spares a copy
        images = images.contiguous(memory_format=th.channels_last)
        return self.linear(self.cnn(images).permute(0, 2, 3, 1).flatten(start_dim=1))


def _normalized_layers(n_flatten: int, features_dim: int) -> nn.Sequential:
    """What follows the convolutions, with a LayerNorm before each ReLU."""
    return nn.Sequential(
        nn.LayerNorm(n_flatten), nn.ReLU(), nn.Linear(n_flatten, features_dim), nn.LayerNorm(features_dim), nn.ReLU()
    )


class MinAtarCNN(_ImageExtractor):
    """
    The network of the MinAtar paper (https://arxiv.org/abs/1903.03176): a convolution of 16 filters, 3×3, stride 1, and a
    linear layer of 128 units, each followed by ReLU.

    Give it as ``features_extractor_class`` to any policy, with ``net_arch=[]`` (PPO: ``net_arch=dict(pi=[], vf=[])``) to have
    nothing between the features and the outputs.

    :param observation_space: ``Box`` of shape (height, width, channels), of any dtype; or an image that SB3 has transposed to
        (channels, height, width)
    :param features_dim: Number of features
    :param layer_norm: Whether both ReLUs have a LayerNorm before them: of the flattened convolutional features (1024 for the
        games), and of the output of the linear layer, as in :class:`ImpalaCNN`
    :raises ValueError: For another observation space, or one smaller than 3×3
    """

    def __init__(self, observation_space: spaces.Box, features_dim: int = 128, layer_norm: bool = False):
        super().__init__(observation_space, features_dim, min_size=3)
        convolution = nn.Conv2d(self.n_channels, 16, kernel_size=3)
        n_flatten = 16 * (self.height - 2) * (self.width - 2)
        if layer_norm:
            self.cnn = nn.Sequential(convolution)
            self.linear = _normalized_layers(n_flatten, features_dim)
        else:
            self.cnn = nn.Sequential(convolution, nn.ReLU())
            self.linear = nn.Sequential(nn.Linear(n_flatten, features_dim), nn.ReLU())


class ImpalaCNN(_ImageExtractor):
    """
    The residual network of IMPALA (https://arxiv.org/abs/1802.01561, Figure 3, without its LSTM): three blocks, each of a 3×3
    convolution, a 3×3 max-pooling that halves height and width, and two residual blocks; then ReLU, a linear layer and ReLU.
    The weights have Xavier's initialisation (uniform, gain 1) and the biases are zero, as in the C-CHAIN paper.

    Give it as ``features_extractor_class`` to any policy, with ``net_arch=[]`` to have nothing between the features and the
    outputs. For PPO and A2C take :class:`~sb3_cchain.networks.ImpalaPolicy`: their policies initialise the features
    again.

    :param observation_space: ``Box`` of shape (height, width, channels), of any dtype; or an image that SB3 has transposed to
        (channels, height, width)
    :param features_dim: Number of features
    :param channels: Filters in each block
    :param layer_norm: Whether both ReLUs at the end have a LayerNorm before them: of the flattened convolutional features
        (2048 for 64×64 pixels), and of the output of the linear layer (the paper's LayerNorm, after
        https://arxiv.org/abs/2402.18762)
    :raises ValueError: For another observation space
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        features_dim: int = 256,
        channels: tuple[int, ...] = (16, 32, 32),
        layer_norm: bool = False,
    ):
        super().__init__(observation_space, features_dim)
        blocks: list[nn.Module] = []
        n_inputs, height, width = self.n_channels, self.height, self.width
        for n_filters in channels:
            blocks += [
                nn.Conv2d(n_inputs, n_filters, kernel_size=3, padding=1),
                nn.MaxPool2d(kernel_size=3, stride=2, padding=1),
                ResidualBlock(n_filters),
                ResidualBlock(n_filters),
            ]
            n_inputs, height, width = n_filters, (height + 1) // 2, (width + 1) // 2
        self.cnn = nn.Sequential(*blocks)
        n_flatten = n_inputs * height * width
        if layer_norm:
            self.linear = _normalized_layers(n_flatten, features_dim)
        else:
            self.linear = nn.Sequential(nn.ReLU(), nn.Linear(n_flatten, features_dim), nn.ReLU())
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draw new weights."""
        for module in self.modules():
            if isinstance(module, (nn.Conv2d, nn.Linear)):
                nn.init.xavier_uniform_(module.weight)
                nn.init.zeros_(module.bias)  # type: ignore[arg-type]
            elif isinstance(module, nn.LayerNorm):
                module.reset_parameters()


class ResidualBlock(nn.Module):
    """
    The input, plus two convolutions of it, each after ReLU.

    :param n_channels: Channels of input and output
    """

    def __init__(self, n_channels: int):
        super().__init__()
        self.residual = nn.Sequential(
            nn.ReLU(),
            nn.Conv2d(n_channels, n_channels, kernel_size=3, padding=1),
            nn.ReLU(),
            nn.Conv2d(n_channels, n_channels, kernel_size=3, padding=1),
        )

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """
        :param inputs: ``(batch_size, n_channels, height, width)``
        :return: The same shape
        """
        return inputs + self.residual(inputs)
