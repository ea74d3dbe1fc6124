"""
The trainings whose models the doctor is tried on. A healthy one has RL Zoo's or SB3's settings. A sick one has a setting that
is known to break it in one way, of which ``expected`` names the finding. Thresholds were chosen on the rows of ``CHOSEN_ON``.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TransformObservation, TransformReward
from sb3_contrib import ARS, QRDQN, TQC, TRPO, CrossQ, MaskablePPO, RecurrentPPO
from sb3_contrib.common.wrappers import ActionMasker
from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise
from torch import nn

from benchmarks.rl_zoo_settings import DQN_CARTPOLE


@dataclass(frozen=True)
class Case:
    """
    A training.

    :param algorithm: Class of the algorithm
    :param env: Environment id
    :param ages: Environment steps after which the model is saved
    :param settings: Arguments of the algorithm
    :param expected: Findings that the settings must lead to; none for a healthy model
    :param cause: What is wrong with the settings
    :param n_envs: Environments side by side
    :param normalize: Whether ``VecNormalize`` normalises observations and rewards
    :param wrap: What is put around each environment
    :param prepare: What is done to the model before training
    :param policy: Policy
    :param seed: Seed
    """

    algorithm: type[BaseAlgorithm]
    env: str
    ages: tuple[int, ...]
    settings: Mapping[str, Any] = field(default_factory=dict)
    expected: tuple[str, ...] = ()
    cause: str = ""
    n_envs: int = 1
    normalize: bool = False
    wrap: Callable[[gym.Env], gym.Env] | None = None
    prepare: Callable[[BaseAlgorithm], None] | None = None
    policy: str = "MlpPolicy"
    seed: int = 0


def _rewards_times(factor: float, env: gym.Env) -> gym.Env:
    return TransformReward(env, lambda reward: factor * float(reward))


def _observations_times(factor: float, env: gym.Env) -> gym.Env:
    return TransformObservation(env, lambda observation: (factor * observation).astype(np.float32), None)


def _pay_for(action: int, env: gym.Env) -> gym.Env:
    """Whatever happens, the reward is 1 for one action and -1 for the others."""

    class Paid(gym.Wrapper):
        def step(self, taken: Any) -> Any:
            observation, _, *rest = self.env.step(taken)
            return observation, 1.0 if taken == action else -1.0, *rest

    return Paid(env)


def _all_actions_allowed(env: gym.Env) -> gym.Env:
    assert isinstance(env.action_space, spaces.Discrete)
    mask = np.ones(env.action_space.n, dtype=bool)
    return ActionMasker(env, lambda _: mask)


def _shift_biases(shift: float, model: BaseAlgorithm) -> None:
    """Of all hidden layers, those of target networks too."""
    with th.no_grad():
        for module in model.policy.modules():
            if isinstance(module, nn.Sequential):
                for layer, following in zip(module, list(module)[1:], strict=False):
                    if isinstance(layer, nn.Linear) and isinstance(following, nn.ReLU):
                        layer.bias.add_(shift)


def _noise(sigma: float) -> dict[str, Any]:
    return {"action_noise": NormalActionNoise(np.zeros(1), np.full(1, sigma))}


X10000 = partial(_rewards_times, 1e4)
RELU = {"policy_kwargs": {"activation_fn": nn.ReLU}}

# The gradient is clipped, so that each step has the same length, which is far too great
GROWTH: dict[str, Any] = {"learning_rate": 100.0, "policy_kwargs": {"optimizer_class": th.optim.SGD}}

# RL Zoo's settings, without its schedules
PPO_CARTPOLE: dict[str, Any] = {
    **{"n_steps": 32, "batch_size": 256, "gae_lambda": 0.8, "gamma": 0.98, "n_epochs": 20, "learning_rate": 1e-3},
}
PPO_PENDULUM: dict[str, Any] = {"n_steps": 1024, "gamma": 0.9, "learning_rate": 1e-3, "use_sde": True, "sde_sample_freq": 4}
PPO_ACROBOT: dict[str, Any] = {"n_steps": 256, "gae_lambda": 0.94, "n_epochs": 4}
PPO_MOUNTAIN_CAR: dict[str, Any] = {"n_steps": 16, "gae_lambda": 0.98, "n_epochs": 4}
DQN_ACROBOT: dict[str, Any] = {
    **{"learning_rate": 6.3e-4, "batch_size": 128, "buffer_size": 50_000, "learning_starts": 0, "target_update_interval": 250},
    **{"train_freq": 4, "gradient_steps": 1, "exploration_fraction": 0.12, "exploration_final_eps": 0.1},
}
DQN_MOUNTAIN_CAR: dict[str, Any] = {
    **{"learning_rate": 4e-3, "batch_size": 128, "buffer_size": 10_000, "learning_starts": 1000, "gamma": 0.98},
    **{"target_update_interval": 600, "train_freq": 16, "gradient_steps": 8},
    **{"exploration_fraction": 0.2, "exploration_final_eps": 0.07},
}
BIG = {"policy_kwargs": {"net_arch": [256, 256]}}
SMALL = {"policy_kwargs": {"net_arch": [64, 64]}}
SAC_PENDULUM: dict[str, Any] = {"learning_rate": 1e-3, "policy_kwargs": {"net_arch": [64, 64]}}
TD3_PENDULUM: dict[str, Any] = {"learning_rate": 1e-3, "gamma": 0.98, "policy_kwargs": {"net_arch": [64, 64]}}
SAC_MCC: dict[str, Any] = {
    **{"batch_size": 512, "ent_coef": 0.1, "train_freq": 32, "gradient_steps": 32, "gamma": 0.9999, "tau": 0.01},
    **{"learning_starts": 0, "use_sde": True},
    "policy_kwargs": {"log_std_init": -3.67, "net_arch": [64, 64], "use_expln": True},
}
NORMALIZED: Any = {"n_envs": 8, "normalize": True}

CHOSEN_ON: dict[str, Case] = {
    # Healthy
    "ppo_cartpole": Case(PPO, "CartPole-v1", (2048, 10_000, 40_000, 100_000), PPO_CARTPOLE, n_envs=8),
    "ppo_cartpole_sb3": Case(PPO, "CartPole-v1", (4096, 30_000)),
    "ppo_cartpole_relu": Case(PPO, "CartPole-v1", (4096, 16_000), RELU),
    "a2c_cartpole": Case(A2C, "CartPole-v1", (5000, 40_000), {"ent_coef": 0.0}, n_envs=8),
    "dqn_cartpole": Case(DQN, "CartPole-v1", (5000, 30_000), {**DQN_CARTPOLE, **BIG}),
    "ppo_pendulum": Case(PPO, "Pendulum-v1", (4096, 16_384), PPO_PENDULUM, n_envs=4),
    "sac_pendulum": Case(SAC, "Pendulum-v1", (1000, 2500), SAC_PENDULUM),
    "td3_pendulum": Case(TD3, "Pendulum-v1", (1500, 2500), {**TD3_PENDULUM, **_noise(0.1), "learning_starts": 1000}),
    "trpo_cartpole": Case(TRPO, "CartPole-v1", (4096, 8192), {"n_steps": 512, "batch_size": 512}, n_envs=2),
    # Sick
    "ppo_cartpole_rate": Case(
        *(
            PPO,
            "CartPole-v1",
            (20_000,),
            {**PPO_CARTPOLE, "learning_rate": 0.1},
            ("collapsed_policy", "no_exploration", "vanishing_gradients"),
        ),
        cause="learning rate 0.1",
        n_envs=8,
    ),
    "a2c_cartpole_rate": Case(
        *(
            A2C,
            "CartPole-v1",
            (20_000,),
            {"learning_rate": 0.1},
            ("collapsed_policy", "no_exploration", "vanishing_gradients"),
        ),
        cause="learning rate 0.1",
        n_envs=8,
    ),
    "dqn_cartpole_rate": Case(
        *(DQN, "CartPole-v1", (6000,), {**DQN_CARTPOLE, **BIG, "learning_rate": 0.3}, ("exploding_weights",)),
        cause="learning rate 0.3",
    ),
    "ppo_cartpole_growth": Case(
        *(PPO, "CartPole-v1", (8000,), {**PPO_CARTPOLE, **GROWTH}, ("exploding_weights",)),
        cause="SGD at learning rate 100",
        n_envs=8,
    ),
    "ppo_cartpole_updates": Case(
        *(PPO, "CartPole-v1", (10_000,), {**PPO_CARTPOLE, "clip_range": 100.0, "n_epochs": 100, "learning_rate": 5e-3}),
        expected=("too_large_updates",),
        cause="100 epochs at learning rate 5e-3, without clipping",
        n_envs=8,
    ),
    "ppo_cartpole_paid": Case(
        *(PPO, "CartPole-v1", (12_000,), {**PPO_CARTPOLE}, ("collapsed_policy", "no_exploration")),
        cause="a reward for one action, a penalty for the others",
        n_envs=8,
        wrap=partial(_pay_for, 0),
    ),
    "ppo_cartpole_reward": Case(
        *(PPO, "CartPole-v1", (20_000,), PPO_CARTPOLE, ("large_rewards",)), cause="rewards times 10 000", n_envs=8, wrap=X10000
    ),
    "dqn_cartpole_reward": Case(
        *(DQN, "CartPole-v1", (8000,), {**DQN_CARTPOLE, **BIG}, ("large_rewards",)),
        cause="rewards times 10 000",
        wrap=X10000,
    ),
    "ppo_cartpole_dead": Case(
        *(PPO, "CartPole-v1", (20_000,), {**PPO_CARTPOLE, **RELU}),
        expected=("dormant_units", "rank_collapse", "dead_values", "vanishing_gradients"),
        cause="biases of ReLU units moved by -10",
        n_envs=8,
        prepare=partial(_shift_biases, -10.0),
    ),
    "dqn_cartpole_dead": Case(
        *(DQN, "CartPole-v1", (8000,), {**DQN_CARTPOLE, **BIG}),
        expected=("dormant_units", "rank_collapse", "dead_values", "vanishing_gradients"),
        cause="biases of ReLU units moved by -10",
        prepare=partial(_shift_biases, -10.0),
    ),
    "ppo_cartpole_deep": Case(
        *(PPO, "CartPole-v1", (6000,)),
        {**PPO_CARTPOLE, "policy_kwargs": {"net_arch": [32] * 12, "activation_fn": nn.Sigmoid}},
        expected=("vanishing_gradients",),
        cause="twelve layers of sigmoids",
        n_envs=8,
    ),
    "ppo_cartpole_observations": Case(
        *(PPO, "CartPole-v1", (8000,), PPO_CARTPOLE, ("saturated_units",)),
        cause="observations times 1000",
        n_envs=8,
        wrap=partial(_observations_times, 1000.0),
    ),
    "ppo_cartpole_gamma": Case(
        *(PPO, "CartPole-v1", (8000,), {**PPO_CARTPOLE, "gamma": 0.0}, ("short_horizon",)), cause="γ = 0", n_envs=8
    ),
    "ppo_cartpole_values": Case(
        *(PPO, "CartPole-v1", (8000,), {**PPO_CARTPOLE, "vf_coef": 0.0}, ("vanishing_gradients",)),
        cause="vf_coef = 0",
        n_envs=8,
    ),
    "dqn_cartpole_greedy": Case(
        *(DQN, "CartPole-v1", (6000,)),
        {**DQN_CARTPOLE, **BIG, "exploration_initial_eps": 0.0, "exploration_final_eps": 0.0},
        expected=("no_exploration",),
        cause="ε = 0",
    ),
    "td3_pendulum_greedy": Case(
        TD3, "Pendulum-v1", (1500,), TD3_PENDULUM, ("no_exploration",), cause="no action noise", n_envs=1
    ),
    "td3_pendulum_rate": Case(
        *(TD3, "Pendulum-v1", (1500,), {**TD3_PENDULUM, **_noise(0.1), "learning_rate": 0.1}),
        expected=("saturated_actions",),
        cause="learning rate 0.1",
    ),
    "sac_pendulum_reward": Case(
        SAC, "Pendulum-v1", (1000,), SAC_PENDULUM, ("large_rewards",), cause="rewards times 10 000", wrap=X10000
    ),
    "sac_pendulum_fixed_targets": Case(
        *(SAC, "Pendulum-v1", (1500,), {**SAC_PENDULUM, "tau": 1.0, "learning_rate": 0.02, "gamma": 0.9999}),
        expected=("diverged_values",),
        cause="τ = 1, γ = 0.9999 and learning rate 0.02",
    ),
}

HELD_OUT: dict[str, Case] = {
    # Healthy: other environments
    "ppo_acrobot": Case(PPO, "Acrobot-v1", (4096, 16_384), PPO_ACROBOT, **NORMALIZED, seed=2),
    "ppo_acrobot_sb3": Case(PPO, "Acrobot-v1", (4096,), seed=2),
    "a2c_acrobot": Case(A2C, "Acrobot-v1", (6000, 16_000), {"ent_coef": 0.0}, **NORMALIZED, seed=2),
    "dqn_acrobot": Case(DQN, "Acrobot-v1", (3000, 8000), {**DQN_ACROBOT, **SMALL}, seed=2),
    "qrdqn_acrobot": Case(
        QRDQN, "Acrobot-v1", (3000,), {**DQN_ACROBOT, "policy_kwargs": {"net_arch": [64, 64], "n_quantiles": 25}}
    ),
    "ppo_mountain_car": Case(PPO, "MountainCar-v0", (6000, 16_000), PPO_MOUNTAIN_CAR, n_envs=16, normalize=True),
    "dqn_mountain_car": Case(DQN, "MountainCar-v0", (5000, 12_000), {**DQN_MOUNTAIN_CAR, **SMALL}),
    "sac_mountain_car": Case(SAC, "MountainCarContinuous-v0", (1000, 2000), SAC_MCC),
    "trpo_mountain_car": Case(
        TRPO, "MountainCarContinuous-v0", (4096,), {"use_sde": True, "sde_sample_freq": 4}, n_envs=2, normalize=True
    ),
    # Healthy: other seeds and other algorithms
    "ppo_cartpole_seed_1": Case(PPO, "CartPole-v1", (5000, 16_000), PPO_CARTPOLE, n_envs=8, seed=1),
    "ppo_pendulum_seed_1": Case(PPO, "Pendulum-v1", (8192,), PPO_PENDULUM, n_envs=4, seed=1),
    "a2c_cartpole_seed_1": Case(A2C, "CartPole-v1", (16_000,), {"ent_coef": 0.0}, n_envs=8, seed=1),
    "sac_pendulum_seed_1": Case(SAC, "Pendulum-v1", (2000,), SAC_PENDULUM, seed=1),
    "ddpg_pendulum": Case(DDPG, "Pendulum-v1", (2000,), {**TD3_PENDULUM, **_noise(0.1), "learning_starts": 1000}, seed=1),
    "tqc_pendulum": Case(TQC, "Pendulum-v1", (1000,), SAC_PENDULUM, seed=1),
    "crossq_pendulum": Case(CrossQ, "Pendulum-v1", (1000,), {"policy_kwargs": {"net_arch": [64, 64]}}, seed=1),
    "qrdqn_cartpole": Case(
        *(QRDQN, "CartPole-v1", (5000,)),
        {**DQN_CARTPOLE, "policy_kwargs": {"net_arch": [256, 256], "n_quantiles": 10}},
        seed=1,
    ),
    "recurrent_ppo_cartpole": Case(
        *(RecurrentPPO, "CartPole-v1", (3000,)),
        {**PPO_CARTPOLE, "n_epochs": 5, "policy_kwargs": {"lstm_hidden_size": 32}},
        n_envs=8,
        policy="MlpLstmPolicy",
        seed=1,
    ),
    "maskable_ppo_cartpole": Case(
        MaskablePPO, "CartPole-v1", (8000,), PPO_CARTPOLE, n_envs=8, wrap=_all_actions_allowed, seed=1
    ),
    "ars_cartpole": Case(ARS, "CartPole-v1", (3000,), {"n_delta": 2}, policy="LinearPolicy", seed=1),
    # Sick
    "ppo_acrobot_rate": Case(
        *(
            PPO,
            "Acrobot-v1",
            (8192,),
            {**PPO_ACROBOT, "learning_rate": 0.1},
            ("collapsed_policy", "no_exploration", "vanishing_gradients"),
        ),
        cause="learning rate 0.1",
        n_envs=8,
    ),
    "a2c_acrobot_rate": Case(
        *(A2C, "Acrobot-v1", (8000,), {"learning_rate": 0.1}, ("collapsed_policy", "no_exploration", "vanishing_gradients")),
        cause="learning rate 0.1",
        n_envs=8,
    ),
    "dqn_acrobot_rate": Case(
        *(DQN, "Acrobot-v1", (3000,), {**DQN_ACROBOT, **SMALL, "learning_rate": 0.3}, ("exploding_weights",)),
        cause="learning rate 0.3",
    ),
    "a2c_acrobot_growth": Case(
        *(A2C, "Acrobot-v1", (10_000,), GROWTH, ("exploding_weights",)), cause="SGD at learning rate 100", n_envs=8
    ),
    "dqn_mountain_car_growth": Case(
        *(DQN, "MountainCar-v0", (4000,), {**DQN_MOUNTAIN_CAR, **GROWTH}, ("exploding_weights",)),
        cause="SGD at learning rate 100",
    ),
    "ppo_acrobot_updates": Case(
        *(PPO, "Acrobot-v1", (4096,), {**PPO_ACROBOT, "clip_range": 100.0, "n_epochs": 40, "learning_rate": 5e-3}),
        expected=("too_large_updates",),
        cause="40 epochs at learning rate 5e-3, without clipping",
        n_envs=8,
    ),
    "ppo_acrobot_paid": Case(
        *(PPO, "Acrobot-v1", (16_000,), {**PPO_ACROBOT, "learning_rate": 1e-3}, ("collapsed_policy", "no_exploration")),
        cause="a reward for one action, a penalty for the others",
        n_envs=8,
        wrap=partial(_pay_for, 1),
    ),
    "ppo_acrobot_entropy": Case(
        *(PPO, "Acrobot-v1", (12_000,), {**PPO_ACROBOT, "learning_rate": 1e-3, "ent_coef": -0.5}, ("no_exploration",)),
        cause="ent_coef = -0.5",
        **NORMALIZED,
    ),
    "ppo_acrobot_reward": Case(
        *(PPO, "Acrobot-v1", (6000,), PPO_ACROBOT, ("large_rewards",)), cause="rewards times 10 000", n_envs=8, wrap=X10000
    ),
    "dqn_mountain_car_reward": Case(
        *(DQN, "MountainCar-v0", (4000,), {**DQN_MOUNTAIN_CAR, **SMALL}, ("large_rewards",)),
        cause="rewards times 10 000",
        wrap=X10000,
    ),
    "sac_mountain_car_reward": Case(
        *(SAC, "MountainCarContinuous-v0", (1000,), SAC_MCC, ("large_rewards",)), cause="rewards times 10 000", wrap=X10000
    ),
    "ppo_acrobot_dead": Case(
        *(PPO, "Acrobot-v1", (6000,), {**PPO_ACROBOT, **RELU}),
        expected=("dormant_units", "rank_collapse", "dead_values", "vanishing_gradients"),
        cause="biases of ReLU units moved by -40",
        n_envs=8,
        prepare=partial(_shift_biases, -40.0),
    ),
    "dqn_mountain_car_dead": Case(
        *(DQN, "MountainCar-v0", (4000,), {**DQN_MOUNTAIN_CAR, **SMALL}),
        expected=("dormant_units", "rank_collapse", "dead_values", "vanishing_gradients"),
        cause="biases of ReLU units moved by -10",
        prepare=partial(_shift_biases, -10.0),
    ),
    "a2c_acrobot_deep": Case(
        *(A2C, "Acrobot-v1", (4000,), {"policy_kwargs": {"net_arch": [32] * 12, "activation_fn": nn.Sigmoid}}),
        expected=("vanishing_gradients",),
        cause="twelve layers of sigmoids",
        n_envs=8,
    ),
    "ppo_acrobot_observations": Case(
        *(PPO, "Acrobot-v1", (6000,), PPO_ACROBOT, ("saturated_units",)),
        cause="observations times 1000",
        n_envs=8,
        wrap=partial(_observations_times, 1000.0),
    ),
    "dqn_acrobot_gamma": Case(
        DQN, "Acrobot-v1", (3000,), {**DQN_ACROBOT, **SMALL, "gamma": 0.0}, ("short_horizon",), cause="γ = 0"
    ),
    "ppo_acrobot_values": Case(
        *(PPO, "Acrobot-v1", (8192,), {**PPO_ACROBOT, "vf_coef": 0.0}, ("vanishing_gradients",)),
        cause="vf_coef = 0",
        **NORMALIZED,
    ),
    "dqn_acrobot_greedy": Case(
        *(DQN, "Acrobot-v1", (3000,)),
        {**DQN_ACROBOT, **SMALL, "exploration_initial_eps": 0.0, "exploration_final_eps": 0.0},
        expected=("no_exploration",),
        cause="ε = 0",
    ),
    "ddpg_mountain_car_greedy": Case(
        *(DDPG, "MountainCarContinuous-v0", (1000,), TD3_PENDULUM, ("no_exploration",)), cause="no action noise"
    ),
    "ppo_pendulum_std": Case(
        *(PPO, "Pendulum-v1", (4096,), {"gamma": 0.9, "policy_kwargs": {"log_std_init": -8.0}}, ("no_exploration",)),
        cause="log_std_init = -8",
        n_envs=4,
        seed=1,
    ),
    "ddpg_pendulum_rate": Case(
        *(DDPG, "Pendulum-v1", (1000,), {**TD3_PENDULUM, **_noise(0.1), "learning_rate": 0.1}),
        expected=("saturated_actions",),
        cause="learning rate 0.1",
        seed=1,
    ),
    "td3_mountain_car_rate": Case(
        *(TD3, "MountainCarContinuous-v0", (1000,), {**TD3_PENDULUM, **_noise(0.5), "learning_rate": 0.1}),
        expected=("saturated_actions",),
        cause="learning rate 0.1",
    ),
    "tqc_pendulum_fixed_targets": Case(
        *(TQC, "Pendulum-v1", (1000,), {**SAC_PENDULUM, "tau": 1.0, "learning_rate": 0.02, "gamma": 0.9999}),
        expected=("diverged_values",),
        cause="τ = 1, γ = 0.9999 and learning rate 0.02",
        seed=1,
    ),
}

CASES = {**CHOSEN_ON, **HELD_OUT}
