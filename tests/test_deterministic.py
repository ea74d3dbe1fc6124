"""The same seed gives the same parameters, and a coefficient of 0 those of the algorithm without churn reduction."""

from functools import partial

import pytest
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.env_util import make_vec_env

from sb3_cchain import CChainDQN, CChainPPO, DoubleDQN
from sb3_cchain.algorithms.reference_batches import REFERENCES
from tests.churn_models import ALGORITHMS, DQN_SETTINGS, PPO_SETTINGS, assert_equal


def assert_same_training(plain, other):
    assert_equal(plain, other)
    assert plain._n_updates == other._n_updates > 5
    assert plain.logger.name_to_value["train/loss"] == other.logger.name_to_value["train/loss"]
    assert not any(key.startswith("churn/") for key in other.logger.name_to_value)


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
@pytest.mark.parametrize("coef", [0.0, 0, "0.0"])
def test_zero_coefficient_is_ppo_to_the_bit(env_id, coef):
    settings = dict(PPO_SETTINGS, ent_coef=0.01)
    plain = PPO("MlpPolicy", env_id, **settings).learn(3 * 32)
    assert_same_training(plain, CChainPPO("MlpPolicy", env_id, churn_coef=coef, **settings).learn(3 * 32))


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("n_steps, gradient_steps", [(1, 1), (3, 4)])
def test_without_double_q_and_coefficient_it_is_dqn_to_the_bit(n_envs, n_steps, gradient_steps):
    settings = dict(DQN_SETTINGS, n_steps=n_steps, gradient_steps=gradient_steps, train_freq=2, target_update_interval=50)
    plain = DQN("MlpPolicy", make_vec_env("CartPole-v1", n_envs), **settings).learn(120)
    for make in (partial(CChainDQN, churn_coef=0.0), DoubleDQN):
        other = make("MlpPolicy", make_vec_env("CartPole-v1", n_envs), double_q=False, loss="huber", **settings).learn(120)
        assert_same_training(plain, other)


@pytest.mark.parametrize("churn_reference", REFERENCES)
def test_zero_coefficient_is_double_dqn_to_the_bit(churn_reference):
    settings = dict(DQN_SETTINGS, target_update_interval=50)
    double = DoubleDQN("MlpPolicy", "CartPole-v1", **settings).learn(120)
    settings.update(churn_coef=0.0, churn_reference=churn_reference)
    assert_same_training(double, CChainDQN("MlpPolicy", "CartPole-v1", **settings).learn(120))


@pytest.mark.parametrize(
    "name, env_id",
    [
        *((name, env_id) for name in ALGORITHMS for env_id in ("CartPole-v1", "Continual/Acrobot-v1")),
        ("CChainPPO", "Pendulum-v1"),
    ],
)
def test_same_seed_twice(name, env_id):
    form = ALGORITHMS[name]
    models = [form.learn(env_id, n_timesteps=2 * form.n_timesteps, churn_warmup=1) for _ in range(2)]
    assert_equal(*models)
    assert models[0].churn_reducer.coefficient.value != 1
