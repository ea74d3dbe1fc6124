"""Continual environments: sequences of tasks as Gymnasium environments."""

from sb3_cchain.envs.continual_env import ContinualEnv
from sb3_cchain.envs.gym_control import ContinualGymControl, ObservationOffset
from sb3_cchain.envs.minatar import ChannelPadding, ContinualMinAtar, NoRewardLimit, PixelFrames, SeededStickyAction
from sb3_cchain.envs.registration import register_envs
from sb3_cchain.envs.reward_scale import RewardScale

__all__ = [
    "ChannelPadding",
    "ContinualEnv",
    "ContinualGymControl",
    "ContinualMinAtar",
    "NoRewardLimit",
    "ObservationOffset",
    "PixelFrames",
    "RewardScale",
    "SeededStickyAction",
    "register_envs",
]
