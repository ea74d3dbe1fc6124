"""Scales rewards."""

from typing import SupportsFloat

import gymnasium as gym

from sb3_cchain.validation import check_number


class RewardScale(gym.RewardWrapper):
    """
    Multiplies each reward by a constant. A class, where Gymnasium's ``TransformReward`` takes a function, so that a YAML
    file can name it.

    :param env: The environment
    :param scale: The factor
    :raises ValueError: When ``scale`` is not a finite number
    """

    def __init__(self, env: gym.Env, scale: float):
        super().__init__(env)
        check_number("scale", scale)
        self.scale = scale

    def reward(self, reward: SupportsFloat) -> float:
        """
        :param reward: Of the wrapped environment
        :return: Reward times ``scale``
        """
        return float(reward) * self.scale
