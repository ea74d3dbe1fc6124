"""Saved and loaded, training goes on as if it had never stopped."""

import copy

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.utils import set_random_seed

from sb3_cchain import CChainPPO
from sb3_cchain.networks.policy_outputs import policy_outputs
from tests.envs import RandomEnv

SETTINGS = dict(n_steps=32, batch_size=8, n_epochs=2, seed=0, device="cpu", churn_warmup=2, churn_window=4)
DICT = spaces.Dict({"a": spaces.Box(-1, 1, (2,), np.float32), "b": spaces.Discrete(3)})


def make_env(action_space=None, observation_space=None):
    return RandomEnv(observation_space, action_space)


def one_more_iteration(model):
    """From the same random numbers and the same first observation."""
    set_random_seed(7)
    model.env.seed(7)
    model._last_obs = None
    model.learn(32, reset_num_timesteps=False)
    return model


def assert_equal(model, other):
    for name, tensor in model.policy.state_dict().items():
        assert th.equal(tensor, other.policy.state_dict()[name]), name
    assert model.churn_reducer.coefficient.value == other.churn_reducer.coefficient.value


@pytest.mark.parametrize("policy, observation_space", [("MlpPolicy", None), ("MultiInputPolicy", DICT)])
@pytest.mark.parametrize("action_space", [None, spaces.Box(-1, 1, (2,), np.float32)])
def test_continues_as_if_never_stopped(tmp_path, policy, observation_space, action_space):
    model = CChainPPO(policy, make_env(action_space, observation_space), **SETTINGS).learn(4 * 32)
    model.save(tmp_path / "model")
    loaded = CChainPPO.load(tmp_path / "model", env=make_env(action_space, observation_space), device="cpu")
    assert_equal(model, loaded)
    assert_equal(one_more_iteration(model), one_more_iteration(loaded))
    assert model.num_timesteps == loaded.num_timesteps == 5 * 32
    # λ had adapted, and the first update of the new iteration had a churn loss too
    assert len(model.churn_reducer.coefficient.base_losses.nonzero()) == 4

    # The history matters: a model that lost it goes on otherwise
    forgetful = CChainPPO.load(tmp_path / "model", env=make_env(action_space, observation_space), device="cpu")
    forgetful.churn_reducer.forget_reference()
    one_more_iteration(forgetful)
    assert any(not th.equal(p, q) for p, q in zip(forgetful.policy.parameters(), loaded.policy.parameters(), strict=True))


def test_saved_before_training_and_predicts(tmp_path):
    model = CChainPPO("MlpPolicy", make_env(), **SETTINGS)
    model.save(tmp_path / "model")
    loaded = CChainPPO.load(tmp_path / "model", device="cpu")
    observation = np.zeros((1, 4), dtype=np.float32)
    assert model.predict(observation, deterministic=True)[0] == loaded.predict(observation, deterministic=True)[0]


def test_arguments_can_be_changed_on_loading(tmp_path):
    CChainPPO("MlpPolicy", make_env(), **SETTINGS).learn(32).save(tmp_path / "model")
    loaded = CChainPPO.load(tmp_path / "model", env=make_env(), device="cpu", target_churn_ratio=5.0)
    assert loaded.churn_reducer.coefficient.target_ratio == 5.0


def test_a_fixed_coefficient_takes_over_from_an_adaptive_one(tmp_path):
    CChainPPO("MlpPolicy", make_env(), **SETTINGS).learn(32).save(tmp_path / "model")
    loaded = CChainPPO.load(tmp_path / "model", env=make_env(), device="cpu", churn_coef=0.0)
    assert loaded.churn_reducer.coefficient.is_zero
    loaded.learn(32)


@pytest.mark.parametrize("coef", [0.0, 0.5])
def test_an_adaptive_coefficient_takes_over_from_a_fixed_one(tmp_path, coef):
    CChainPPO("MlpPolicy", make_env(), churn_coef=coef, **SETTINGS).learn(32).save(tmp_path / "model")
    loaded = CChainPPO.load(tmp_path / "model", env=make_env(), device="cpu", churn_coef="auto_3")
    assert loaded.churn_reducer.coefficient.value == 3
    loaded.learn(32)


def test_a_copy_of_the_model_has_a_network_of_its_own():
    model = CChainPPO("MlpPolicy", make_env(), **SETTINGS)  # SB3's PPO cannot be copied once it was trained
    copied = copy.deepcopy(model)
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(1.0)
    reducer, observations = copied.churn_reducer, th.ones(2, 4)
    reducer.remember(observations)
    assert th.equal(reducer.old_outputs, policy_outputs(copied.policy, observations).detach())


def test_another_window_starts_over(tmp_path):
    CChainPPO("MlpPolicy", make_env(), **SETTINGS).learn(4 * 32).save(tmp_path / "model")
    loaded = CChainPPO.load(tmp_path / "model", env=make_env(), device="cpu", churn_window=9)
    assert loaded.churn_reducer.coefficient.value == 1.0
    loaded.learn(32)


def test_takes_a_checkpoint_of_ppo(tmp_path):
    plain = PPO("MlpPolicy", make_env(), n_steps=32, batch_size=8, device="cpu").learn(32)
    plain.save(tmp_path / "ppo")
    model = CChainPPO.load(tmp_path / "ppo", env=make_env(), device="cpu")
    assert all(th.equal(p, q) for p, q in zip(model.policy.parameters(), plain.policy.parameters(), strict=True))
    model.learn(64)
    assert model.churn_reducer.reference is not None
    model.set_parameters(plain.get_parameters())
    # The churn of the network that was replaced is forgotten
    assert model.churn_reducer.reference is None and model.churn_reducer.coefficient.n_seen == 0
    model.set_parameters(str(tmp_path / "ppo.zip"))
    assert all(th.equal(p, q) for p, q in zip(model.policy.parameters(), plain.policy.parameters(), strict=True))


def test_reference_goes_to_the_models_device(tmp_path):
    """As when a model was saved on a GPU; "meta" stands for the other device."""
    model = CChainPPO("MultiInputPolicy", make_env(None, DICT), **SETTINGS).learn(32)
    model.churn_reducer.move_reference("meta")
    assert model.churn_reducer.old_outputs.is_meta and all(t.is_meta for t in model.churn_reducer.reference.values())
    vector = CChainPPO("MlpPolicy", make_env(), **SETTINGS).learn(32)
    vector.churn_reducer.move_reference("meta")
    assert vector.churn_reducer.reference.is_meta


def test_its_policy_loads_without_the_package(tmp_path):
    model = CChainPPO("MlpPolicy", make_env(), **SETTINGS).learn(32)
    model.policy.save(tmp_path / "policy")
    policy = type(model.policy).load(tmp_path / "policy", device="cpu")
    assert all(th.equal(p, q) for p, q in zip(model.policy.parameters(), policy.parameters(), strict=True))
