"""The same seed gives the same parameters, and no churn loss gives PPO's."""

import pytest
import torch as th
from stable_baselines3 import PPO

from sb3_cchain import CChainPPO

SETTINGS = dict(n_steps=64, batch_size=16, n_epochs=3, ent_coef=0.01, seed=3, device="cpu")


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
