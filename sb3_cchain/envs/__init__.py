"""Continual environments: sequences of tasks as Gymnasium environments, and their normalisation."""

from sb3_cchain.envs.atari import AtariTask, ContinualAtari
from sb3_cchain.envs.continual_env import ContinualEnv
from sb3_cchain.envs.dm_control import ContinualDMControl, FlatDMControl
from sb3_cchain.envs.gym_control import ContinualGymControl, ObservationOffset
from sb3_cchain.envs.minatar import ChannelPadding, ContinualMinAtar, NoRewardLimit, PixelFrames, SeededStickyAction
from sb3_cchain.envs.minigrid import ContinualMiniGrid
from sb3_cchain.envs.procgen import ContinualProcgen, ProcgenGame
from sb3_cchain.envs.procgen_vec_env import ContinualProcgenVecEnv
from sb3_cchain.envs.registration import register_envs
from sb3_cchain.envs.reward_scale import RewardScale
from sb3_cchain.envs.slippery_ant import ContinualSlipperyAnt
from sb3_cchain.envs.space_padding import CommonSpaces, ContinualSequence
from sb3_cchain.envs.task_caption import TaskCaption
from sb3_cchain.envs.task_normalize import TaskVecNormalize

__all__ = [
    "AtariTask",
    "ChannelPadding",
    "CommonSpaces",
    "ContinualAtari",
    "ContinualDMControl",
    "ContinualEnv",
    "ContinualGymControl",
    "ContinualMinAtar",
    "ContinualMiniGrid",
    "ContinualProcgen",
    "ContinualProcgenVecEnv",
    "ContinualSequence",
    "ContinualSlipperyAnt",
    "FlatDMControl",
    "NoRewardLimit",
    "ObservationOffset",
    "PixelFrames",
    "ProcgenGame",
    "RewardScale",
    "SeededStickyAction",
    "TaskCaption",
    "TaskVecNormalize",
    "register_envs",
]
