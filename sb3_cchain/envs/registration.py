"""The table of registered environments."""

from typing import Any

import gymnasium as gym

from sb3_cchain.envs.procgen import GAME_NAMES

# Keyword arguments of `gymnasium.register` by the id without its namespace. `kwargs` holds only arguments that differ from
# the defaults of the entry point; each of them can be given to `gymnasium.make`, too.
# These are the paper's.
_GYM_CONTROL = {"entry_point": "sb3_cchain.envs.gym_control:ContinualGymControl", "max_episode_steps": 400}
_DM_CONTROL = "sb3_cchain.envs.dm_control:ContinualDMControl"
_PROCGEN = "sb3_cchain.envs.procgen:ContinualProcgen"
CONTINUAL_ENVS: dict[str, dict[str, Any]] = {
    "CartPole-v1": {**_GYM_CONTROL, "kwargs": {"env_id": "CartPole-v1"}},
    "Acrobot-v1": {**_GYM_CONTROL, "kwargs": {"env_id": "Acrobot-v1"}},
    "LunarLander-v3": {**_GYM_CONTROL, "kwargs": {"env_id": "LunarLander-v3"}},
    "MountainCar-v0": {
        **_GYM_CONTROL,
        # σ = 2 is too large for it to be learnable (Appendix A.1 of the paper)
        "kwargs": {"env_id": "MountainCar-v0", "n_tasks": 5, "steps_per_task": 320_000, "offset_std": 0.02},
    },
    "MinAtar-v0": {"entry_point": "sb3_cchain.envs.minatar:ContinualMinAtar"},
    "Walker-v0": {"entry_point": _DM_CONTROL, "kwargs": {"domain": "walker", "tasks": ["stand", "walk", "run"]}},
    "Quadruped-v0": {"entry_point": _DM_CONTROL, "kwargs": {"domain": "quadruped", "tasks": ["walk", "run", "walk"]}},
    "Dog-v0": {"entry_point": _DM_CONTROL, "kwargs": {"domain": "dog", "tasks": ["stand", "walk", "run", "trot"]}},
    **{f"{game}-v0": {"entry_point": _PROCGEN, "kwargs": {"game": game.lower()}} for game in GAME_NAMES},
}

# Those that the paper does not have
OTHER_ENVS: dict[str, dict[str, Any]] = {
    "SlipperyAnt-v0": {"entry_point": "sb3_cchain.envs.slippery_ant:ContinualSlipperyAnt"},
    "MiniGrid-v0": {"entry_point": "sb3_cchain.envs.minigrid:ContinualMiniGrid"},
    "Atari-v0": {"entry_point": "sb3_cchain.envs.atari:ContinualAtari"},
    "Sequence-v0": {"entry_point": "sb3_cchain.envs.space_padding:ContinualSequence"},
}


def register_envs() -> None:
    """Register ``Continual/...`` with Gymnasium. Importing ``sb3_cchain`` does so."""
    for name, registration in (CONTINUAL_ENVS | OTHER_ENVS).items():
        env_id = f"Continual/{name}"
        if env_id not in gym.registry:
            gym.register(env_id, **registration)
