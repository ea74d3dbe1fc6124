"""The same seed gives the same parameters, and no churn loss gives PPO's."""

from functools import partial

import pytest
import torch as th
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.env_util import make_vec_env

from sb3_cchain import CChainDQN, CChainPPO, DoubleDQN

SETTINGS = dict(n_steps=64, batch_size=16, n_epochs=3, ent_coef=0.01, seed=3, device="cpu")
DQN_SETTINGS = dict(learning_starts=50, buffer_size=300, batch_size=16, learning_rate=1e-3, seed=3, device="cpu")


def assert_equal(model, other):
    for name, tensor in model.policy.state_dict().items():
        assert th.equal(tensor, other.policy.state_dict()[name]), name


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
@pytest.mark.parametrize("coef", [0.0, 0, "0.0"])
def test_zero_coefficient_is_ppo_to_the_bit(env_id, coef):
    plain = PPO("MlpPolicy", env_id, **SETTINGS).learn(6 * 64)
    ours = CChainPPO("MlpPolicy", env_id, churn_coef=coef, **SETTINGS).learn(6 * 64)
    assert_equal(plain, ours)
    assert not any(key.startswith("churn/") for key in ours.logger.name_to_value)


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1", "Continual/Acrobot-v1"])
def test_same_seed_twice(env_id):
    models = [CChainPPO("MlpPolicy", env_id, churn_warmup=1, **SETTINGS).learn(5 * 64) for _ in range(2)]
    assert_equal(*models)
    assert models[0].churn_reducer.coefficient.value == models[1].churn_reducer.coefficient.value


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("n_steps, gradient_steps", [(1, 1), (3, 4)])
def test_zero_coefficient_without_double_q_is_dqn_to_the_bit(n_envs, n_steps, gradient_steps):
    settings = dict(DQN_SETTINGS, n_steps=n_steps, gradient_steps=gradient_steps, train_freq=2)
    plain = DQN("MlpPolicy", make_vec_env("CartPole-v1", n_envs), **settings).learn(300)
    for make in (partial(CChainDQN, churn_coef=0.0), DoubleDQN):
        ours = make("MlpPolicy", make_vec_env("CartPole-v1", n_envs), double_q=False, loss="huber", **settings).learn(300)
        assert plain._n_updates == ours._n_updates > 60
        assert_equal(plain, ours)
        assert plain.logger.name_to_value["train/loss"] == ours.logger.name_to_value["train/loss"]
        assert not any(key.startswith("churn/") for key in ours.logger.name_to_value)


def test_zero_coefficient_is_double_dqn_to_the_bit():
    double = DoubleDQN("MlpPolicy", "CartPole-v1", **DQN_SETTINGS).learn(400)
    assert_equal(double, CChainDQN("MlpPolicy", "CartPole-v1", churn_coef=0.0, **DQN_SETTINGS).learn(400))


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Continual/Acrobot-v1"])
def test_same_seed_twice_dqn(env_id):
    models = [CChainDQN("MlpPolicy", env_id, churn_warmup=1, **DQN_SETTINGS).learn(300) for _ in range(2)]
    assert_equal(*models)
    assert models[0].churn_reducer.coefficient.value == models[1].churn_reducer.coefficient.value
