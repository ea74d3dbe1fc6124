"""Feature extractors."""

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

_NEEDS = "MinAtarCNN needs Box observations of shape (height, width, channels), at least 3 high and wide; got {}"


class MinAtarCNN(BaseFeaturesExtractor):
    """
    The network of the MinAtar paper (https://arxiv.org/abs/1903.03176): a convolution of 16 filters, 3×3, stride 1, and a
    linear layer of 128 units, each followed by ReLU.

    Give it as ``features_extractor_class`` to any policy, with ``net_arch=[]`` (PPO: ``net_arch=dict(pi=[], vf=[])``) to have
    nothing between the features and the outputs.

    :param observation_space: ``Box`` of shape (height, width, channels), of any dtype; or an image that SB3 has transposed to
        (channels, height, width)
    :param features_dim: Number of features
    :raises ValueError: For another observation space, or one smaller than 3×3
    """

    def __init__(self, observation_space: spaces.Box, features_dim: int = 128):
        super().__init__(observation_space, features_dim)
        shape = observation_space.shape
        if not isinstance(observation_space, spaces.Box) or len(shape) != 3:
            raise ValueError(_NEEDS.format(observation_space))
        # SB3 transposes images: `uint8`, from 0 to 255
        self.channels_first = is_image_space(observation_space) and shape[0] < shape[2]
        n_channels, height, width = shape if self.channels_first else (shape[2], *shape[:2])
        if min(height, width) < 3:
            raise ValueError(_NEEDS.format(observation_space))
        self.cnn = nn.Sequential(nn.Conv2d(n_channels, 16, kernel_size=3), nn.ReLU())
        self.linear = nn.Sequential(nn.Linear(16 * (height - 2) * (width - 2), features_dim), nn.ReLU())

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """
        :param observations: A batch of them
        :return: Features ``(batch_size, features_dim)``
        """
        images = observations if self.channels_first else observations.permute(0, 3, 1, 2)
        # Flattened in the order that they lie in memory, channels last, which spares a copy
        return self.linear(self.cnn(images).permute(0, 2, 3, 1).flatten(start_dim=1))
