"""What the new processes of ``tests/resume_cases.py`` have imported, so that each of them does not take seconds for it."""

import importlib
from contextlib import suppress

from gymnasium.error import DependencyNotInstalled

import tests.resume_cases  # noqa: F401

SLOW = (
    *(
        "torch._dynamo",
        "sb3_contrib",
        "Box2D",
        "minatar",
        "procgen",
        "dm_control.suite",
        "shimmy",
        "gymnasium.envs.classic_control",
    ),
    *("gymnasium.envs.mujoco.ant_v5", "minigrid", "cv2", "sb3_cchain.envs.minigrid"),
    *("gymnasium.envs.box2d", "sb3_cchain.envs.minatar", "sb3_cchain.envs.dm_control", "sb3_cchain.envs.procgen"),
)
for name in SLOW:
    with suppress(ImportError, DependencyNotInstalled):
        importlib.import_module(name)
