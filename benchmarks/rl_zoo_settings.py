"""Settings of RL Zoo's that several benchmarks train with, without its network. They stay when RL Zoo changes its own."""

from typing import Any

DQN_CARTPOLE: dict[str, Any] = {
    **{"learning_rate": 2.3e-3, "batch_size": 64, "buffer_size": 100_000, "learning_starts": 1000, "gamma": 0.99},
    **{"target_update_interval": 10, "train_freq": 256, "gradient_steps": 128},
    **{"exploration_fraction": 0.16, "exploration_final_eps": 0.04},
}
