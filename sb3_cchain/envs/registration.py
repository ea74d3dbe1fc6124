"""The table of registered environments."""

import gymnasium as gym

GYM_CONTROL = "sb3_cchain.envs.gym_control:ContinualGymControl"

# Id without its namespace: entry point, and the keyword arguments that differ from the entry point's defaults
CONTINUAL_ENVS: dict[str, tuple[str, dict]] = {
    "CartPole-v1": (GYM_CONTROL, {"env_id": "CartPole-v1"}),
    "Acrobot-v1": (GYM_CONTROL, {"env_id": "Acrobot-v1"}),
    "LunarLander-v3": (GYM_CONTROL, {"env_id": "LunarLander-v3"}),
    "MountainCar-v0": (
        GYM_CONTROL,
        # σ = 2 is too large for it to be learnable (Appendix A.1)
        {"env_id": "MountainCar-v0", "n_tasks": 5, "steps_per_task": 320_000, "offset_std": 0.02},
    ),
}


def register_envs() -> None:
    """Register ``Continual/...`` with Gymnasium. Importing ``sb3_cchain`` does so."""
    for name, (entry_point, kwargs) in CONTINUAL_ENVS.items():
        env_id = f"Continual/{name}"
        if env_id not in gym.registry:
            gym.register(env_id, entry_point=entry_point, kwargs=kwargs)
