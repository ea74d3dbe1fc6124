"""Scales rewards."""

from typing import SupportsFloat

import gymnasium as gym


class RewardScale(gym.RewardWrapper):
    """
    Multiplies each reward by a constant. A class, where Gymnasium's ``TransformReward`` takes a function, so that a YAML
    file can name it.

    :param env: The environment
    :param scale: The factor
    """

    def __init__(self, env: gym.Env, scale: float):
        super().__init__(env)
        self.scale = scale

    def reward(self, reward: SupportsFloat) -> float:
        """
        :param reward: Of the wrapped environment
        :return: Reward times ``scale``
        """
        return float(reward) * self.scale
