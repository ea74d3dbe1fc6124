"""What is compared: one row for each case. Those from which the default β come are in ``betas``."""

from typing import Any

from sb3_contrib import QRDQN, MaskablePPO, RecurrentPPO
from stable_baselines3 import DQN, PPO, SAC, TD3, HerReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv
from torch import nn

from benchmarks.family.betas import BETAS
from benchmarks.family.case import Case, Variant, action_noise
from benchmarks.family.masked_symbols import continual_masked_symbols
from benchmarks.rl_zoo_settings import DQN_CARTPOLE
from sb3_cchain import CChainDQN, CChainPPO, CChainSAC, CChainTD3, DoubleDQN
from sb3_cchain.algorithms.contrib import CChainMaskablePPO, CChainQRDQN, CChainRecurrentPPO

RL_ZOO = "RL Zoo's settings"
CHAIN = "settings of the code released with CHAIN"

# C-CHAIN's DQN has Double Q-learning, so Double DQN is what it is compared with
_DQN = {
    "double_dqn": Variant("Double DQN", DoubleDQN),
    "cchain": Variant("C-CHAIN DQN", CChainDQN),
    "dqn": Variant("DQN", DQN),
}
_SAC = {
    "sac": Variant("SAC", SAC),
    "cchain": Variant("C-CHAIN SAC, β 5e-5", CChainSAC, {"target_churn_ratio": 5e-5}),
    "cchain_5e-6": Variant("C-CHAIN SAC, β 5e-6 (default)", CChainSAC, {"target_churn_ratio": 5e-6}),
    "cchain_value": Variant("C-CHAIN SAC (values)", CChainSAC, {"churn_target": "value"}),
}
_TD3 = {
    "td3": Variant("TD3", TD3),
    "cchain": Variant("C-CHAIN TD3", CChainTD3),
    "cchain_value": Variant("C-CHAIN TD3 (values)", CChainTD3, {"churn_target": "value"}),
}
_CONTINUAL_CARTPOLE: dict[str, Any] = {
    **{"steps": 60_000, "eval_freq": 1500, "seeds": 3, "n_tasks": 4},
    "env_kwargs": {"n_tasks": 4, "steps_per_task": 15_000},
}
# Of the base algorithms; docs/results/family.md says what differs. CHAIN's buffer of 1e6 holds everything, as this one does
_CHAIN: dict[str, Any] = {"learning_starts": 5000, "buffer_size": 150_000}
_CHAIN_TD3: dict[str, Any] = {**_CHAIN, "learning_rate": 3e-4, "policy_kwargs": {"net_arch": [256, 256]}}

# Does it help or harm?
EVIDENCE = {
    "her_bit_flipping": Case(
        "Bit flipping with hindsight experience replay, DQN",
        "SB3's own test of HerReplayBuffer",
        BitFlippingEnv,
        _DQN,
        steps=1500,
        eval_freq=150,
        settings={
            **{"replay_buffer_class": HerReplayBuffer, "learning_rate": 2e-3, "gradient_steps": 2, "learning_starts": 20},
            **{"train_freq": 1, "exploration_final_eps": 0.02, "target_update_interval": 100, "batch_size": 32},
            **{"buffer_size": 100_000, "replay_buffer_kwargs": {"n_sampled_goal": 5, "goal_selection_strategy": "future"}},
        },
        env_kwargs={"n_bits": 10, "continuous": False},
        n_envs=2,
        n_eval_episodes=50,
        policy="MultiInputPolicy",
        score="success_rate",
    ),
    "dqn_cartpole": Case(
        "CartPole, DQN",
        RL_ZOO,
        "CartPole-v1",
        _DQN,
        steps=50_000,
        eval_freq=2500,
        settings={**DQN_CARTPOLE, "policy_kwargs": {"net_arch": [256, 256]}},
    ),
    "dqn_lunar_lander": Case(
        "LunarLander, DQN",
        RL_ZOO,
        "LunarLander-v3",
        _DQN,
        steps=100_000,
        eval_freq=5000,
        settings={
            **{"learning_rate": 6.3e-4, "batch_size": 128, "buffer_size": 50_000, "learning_starts": 0, "gamma": 0.99},
            **{"target_update_interval": 250, "train_freq": 4, "gradient_steps": -1},
            **{"exploration_fraction": 0.12, "exploration_final_eps": 0.1, "policy_kwargs": {"net_arch": [256, 256]}},
        },
    ),
    "sac_pendulum": Case(
        "Pendulum, SAC", RL_ZOO, "Pendulum-v1", _SAC, steps=20_000, eval_freq=1000, settings={"learning_rate": 1e-3}
    ),
    "td3_pendulum": Case(
        "Pendulum, TD3",
        RL_ZOO,
        "Pendulum-v1",
        _TD3,
        steps=20_000,
        eval_freq=1000,
        settings={
            **{"learning_rate": 1e-3, "gamma": 0.98, "buffer_size": 200_000, "learning_starts": 10_000, "train_freq": 1},
            **{"gradient_steps": 1, "action_noise": action_noise(1), "policy_kwargs": {"net_arch": [400, 300]}},
        },
    ),
    "qrdqn_continual_cartpole": Case(
        "Continual CartPole, QRDQN",
        "RL Zoo's settings of CartPole",
        "Continual/CartPole-v1",
        {
            "qrdqn": Variant("QRDQN", QRDQN),
            "cchain": Variant("C-CHAIN QRDQN, β 0.01", CChainQRDQN, {"target_churn_ratio": 0.01}),
            "cchain_1e-3": Variant("C-CHAIN QRDQN, β 1e-3 (default)", CChainQRDQN, {"target_churn_ratio": 1e-3}),
            "cchain_1e-4": Variant("C-CHAIN QRDQN, β 1e-4", CChainQRDQN, {"target_churn_ratio": 1e-4}),
        },
        settings={**DQN_CARTPOLE, "policy_kwargs": {"net_arch": [256, 256], "n_quantiles": 10}},
        **_CONTINUAL_CARTPOLE,
    ),
    "dqn_continual_cartpole": Case(
        "Continual CartPole, DQN",
        "RL Zoo's settings of CartPole",
        "Continual/CartPole-v1",
        {
            "double_dqn": Variant("Double DQN", DoubleDQN),
            "cchain": Variant("C-CHAIN DQN, β 0.01 (default)", CChainDQN),
            "cchain_1e-3": Variant("C-CHAIN DQN, β 1e-3", CChainDQN, {"target_churn_ratio": 1e-3}),
        },
        settings={**DQN_CARTPOLE, "policy_kwargs": {"net_arch": [256, 256]}},
        **_CONTINUAL_CARTPOLE,
    ),
    "recurrent_ppo_continual_cartpole": Case(
        "Continual CartPole, RecurrentPPO",
        "an LSTM of 64, rollouts of 512 steps, a learning rate of 1e-3, SB3's settings otherwise",
        "Continual/CartPole-v1",
        {
            "recurrent_ppo": Variant("RecurrentPPO", RecurrentPPO),
            "cchain": Variant("C-CHAIN RecurrentPPO, β 1e4", CChainRecurrentPPO, {"target_churn_ratio": 1e4}),
            "cchain_1e2": Variant("C-CHAIN RecurrentPPO, β 1e2 (default)", CChainRecurrentPPO, {"target_churn_ratio": 1e2}),
        },
        steps=90_000,
        eval_freq=3000,
        seeds=3,
        settings={"n_steps": 64, "learning_rate": 1e-3, "policy_kwargs": {"lstm_hidden_size": 64}},
        env_kwargs={"n_tasks": 3, "steps_per_task": 30_000},
        n_envs=8,
        n_tasks=3,
        policy="MlpLstmPolicy",
    ),
    "maskable_ppo_continual_symbols": Case(
        "Continual symbols with invalid actions, MaskablePPO",
        "rollouts of 512 steps, a learning rate of 1e-3, SB3's settings otherwise",
        continual_masked_symbols,
        {
            "maskable_ppo": Variant("MaskablePPO", MaskablePPO),
            "cchain": Variant("C-CHAIN MaskablePPO, β 1e4", CChainMaskablePPO, {"target_churn_ratio": 1e4}),
            "cchain_1e3": Variant("C-CHAIN MaskablePPO, β 1e3", CChainMaskablePPO, {"target_churn_ratio": 1e3}),
            "cchain_1e2": Variant("C-CHAIN MaskablePPO, β 1e2 (default)", CChainMaskablePPO, {"target_churn_ratio": 1e2}),
        },
        steps=120_000,
        eval_freq=3000,
        seeds=3,
        settings={"n_steps": 64, "learning_rate": 1e-3},
        env_kwargs={"n_tasks": 4, "steps_per_task": 30_000},
        n_envs=8,
        n_tasks=4,
    ),
    "ppo_cartpole": Case(
        "CartPole for a long time, PPO",
        "SB3's settings",
        "CartPole-v1",
        {
            "ppo": Variant("PPO", PPO),
            "cchain_1e4": Variant("C-CHAIN PPO, β 1e4 (default)", CChainPPO, {"target_churn_ratio": 1e4}),
            "cchain_1e3": Variant("C-CHAIN PPO, β 1e3", CChainPPO, {"target_churn_ratio": 1e3}),
        },
        steps=1_000_000,
        eval_freq=10_000,
        solved=475.0,
    ),
    # Users report that PPO falls there: https://github.com/DLR-RM/rl-baselines3-zoo/issues/376
    "ppo_hopper": Case(
        "Hopper for a long time, PPO",
        RL_ZOO,
        "Hopper-v5",
        {"ppo": Variant("PPO", PPO), "cchain": Variant("C-CHAIN PPO, β 0.05 (default)", CChainPPO)},
        steps=1_000_000,
        eval_freq=10_000,
        seeds=3,
        settings={
            **{"batch_size": 32, "n_steps": 512, "gamma": 0.999, "learning_rate": 9.80828e-05, "ent_coef": 0.00229519},
            **{"clip_range": 0.2, "n_epochs": 5, "gae_lambda": 0.99, "max_grad_norm": 0.7, "vf_coef": 0.835671},
            "policy_kwargs": {
                **{"log_std_init": -2, "ortho_init": False, "activation_fn": nn.ReLU},
                "net_arch": {"pi": [256, 256], "vf": [256, 256]},
            },
        },
        n_eval_episodes=5,
        normalize=True,
        solved=1000.0,
    ),
    "sac_hopper": Case(
        "Hopper, SAC", CHAIN, "Hopper-v5", _SAC, steps=150_000, eval_freq=5000, seeds=3, settings=_CHAIN, n_eval_episodes=5
    ),
    "td3_hopper": Case(
        "Hopper, TD3",
        CHAIN,
        "Hopper-v5",
        _TD3,
        steps=150_000,
        eval_freq=5000,
        seeds=3,
        settings={**_CHAIN_TD3, "action_noise": action_noise(3)},
        n_eval_episodes=5,
    ),
    "sac_walker": Case(
        "Continual Walker, SAC",
        CHAIN,
        "Continual/Walker-v0",
        _SAC,
        steps=100_000,
        eval_freq=5000,
        seeds=3,
        settings=_CHAIN,
        env_kwargs={"tasks": ["stand", "walk"], "steps_per_task": 50_000},
        n_eval_episodes=5,
        n_tasks=2,
    ),
    "td3_walker": Case(
        "Continual Walker, TD3",
        CHAIN,
        "Continual/Walker-v0",
        _TD3,
        steps=100_000,
        eval_freq=5000,
        seeds=3,
        settings={**_CHAIN_TD3, "action_noise": action_noise(6)},
        env_kwargs={"tasks": ["stand", "walk"], "steps_per_task": 50_000},
        n_eval_episodes=5,
        n_tasks=2,
    ),
}

CASES = {**EVIDENCE, **BETAS}
