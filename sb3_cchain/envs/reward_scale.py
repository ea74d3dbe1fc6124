"""Scales rewards."""

from typing import SupportsFloat

import gymnasium as gym
from gymnasium.utils import RecordConstructorArgs

from sb3_cchain.validation import check_number


class RewardScale(gym.RewardWrapper, RecordConstructorArgs):
    """
    Multiplies each reward by a constant. A class, where Gymnasium's ``TransformReward`` takes a function, so that a YAML
    file can name it.

    :param env: The environment
    :param scale: The factor
    :raises ValueError: When ``scale`` is not a finite number
    """

    def __init__(self, env: gym.Env, scale: float):
        RecordConstructorArgs.__init__(self, scale=scale)
        gym.RewardWrapper.__init__(self, env)
        check_number("scale", scale)
        self.scale = scale

    def reward(self, reward: SupportsFloat) -> float:
        """
        :param reward: Of the wrapped environment
        :return: Reward times ``scale``
        """
        return float(reward) * self.scale
