"""Saved and loaded, training goes on as if it had never stopped."""

import copy

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN
from stable_baselines3.common.utils import set_random_seed

from sb3_cchain import CChainDQN, DoubleDQN
from tests.envs import RandomEnv

SETTINGS = dict(
    learning_starts=20, buffer_size=200, batch_size=8, train_freq=1, seed=0, device="cpu", churn_warmup=5, churn_window=7
)
DICT = spaces.Dict({"a": spaces.Box(-1, 1, (2,), np.float32), "b": spaces.Discrete(3)})


def go_on(model):
    """From the same random numbers and the same first observation."""
    set_random_seed(7)
    model.env.seed(7)
    model.action_space.seed(7)
    model._last_obs = None
    return model.learn(40, reset_num_timesteps=False)


def assert_equal(model, other):
    for name, tensor in model.policy.state_dict().items():
        assert th.equal(tensor, other.policy.state_dict()[name]), name
    assert model.churn_reducer.coefficient.value == other.churn_reducer.coefficient.value


@pytest.mark.parametrize(
    "policy, observation_space, n_steps", [("MlpPolicy", None, 1), ("MlpPolicy", None, 3), ("MultiInputPolicy", DICT, 1)]
)
def test_continues_as_if_never_stopped(tmp_path, policy, observation_space, n_steps):
    model = CChainDQN(policy, RandomEnv(observation_space), loss="mse", n_steps=n_steps, **SETTINGS).learn(50)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")

    def load():
        loaded = CChainDQN.load(tmp_path / "model", env=RandomEnv(observation_space), device="cpu")
        loaded.load_replay_buffer(tmp_path / "buffer")
        return loaded

    loaded, forgetful = load(), load()
    assert (loaded.double_q, loaded.loss) == (True, "mse")
    assert_equal(model, loaded)
    assert_equal(go_on(model), go_on(loaded))
    assert model._n_updates == loaded._n_updates == 70
    # λ had adapted, and the reference batch matters: a model that lost it goes on otherwise
    assert model.churn_reducer.coefficient.value != 50
    forgetful.churn_reducer.forget_reference()
    go_on(forgetful)
    assert any(not th.equal(p, q) for p, q in zip(forgetful.policy.parameters(), loaded.policy.parameters(), strict=True))


@pytest.mark.parametrize("saved, loaded", [(DQN, DoubleDQN), (DQN, CChainDQN), (DoubleDQN, CChainDQN)])
def test_takes_checkpoints_of_its_base(tmp_path, saved, loaded):
    settings = {key: value for key, value in SETTINGS.items() if "churn" not in key}
    model = saved("MlpPolicy", RandomEnv(), **settings).learn(40)
    model.save(tmp_path / "model")
    other = loaded.load(tmp_path / "model", env=RandomEnv(), device="cpu")
    assert all(th.equal(p, q) for p, q in zip(model.policy.parameters(), other.policy.parameters(), strict=True))
    other.learn(40)


def test_arguments_can_be_changed_on_loading(tmp_path):
    CChainDQN("MlpPolicy", RandomEnv(), **SETTINGS).learn(50).save(tmp_path / "model")
    loaded = CChainDQN.load(tmp_path / "model", env=RandomEnv(), device="cpu", loss="mse", double_q=False, churn_window=9)
    assert (loaded.loss, loaded.double_q) == ("mse", False)
    assert loaded.churn_reducer.coefficient.value == 50  # another window starts over
    loaded.learn(50)


@pytest.mark.parametrize("before, after, value", [(0.5, "auto_3", 3), ("auto", 0.5, 0.5), (0.0, "auto_3", 3)])
def test_another_kind_of_coefficient_starts_over(tmp_path, before, after, value):
    CChainDQN("MlpPolicy", RandomEnv(), churn_coef=before, **SETTINGS).learn(50).save(tmp_path / "model")
    loaded = CChainDQN.load(tmp_path / "model", env=RandomEnv(), device="cpu", churn_coef=after)
    assert loaded.churn_reducer.coefficient.value == value
    loaded.learn(50)


@pytest.mark.parametrize("argument, error", [({"loss": "mae"}, ValueError), ({"double_q": "yes"}, TypeError)])
def test_bad_arguments_on_loading(tmp_path, argument, error):
    DoubleDQN("MlpPolicy", RandomEnv(), device="cpu").save(tmp_path / "model")
    ((name, value),) = argument.items()
    with pytest.raises(error, match=f"`{name}` must be .* got {value!r}"):
        DoubleDQN.load(tmp_path / "model", env=RandomEnv(), device="cpu", **argument)


def test_a_copy_of_the_model_has_a_network_of_its_own():
    model = CChainDQN("MlpPolicy", RandomEnv(), **SETTINGS).learn(50)
    copied = copy.deepcopy(model)
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(1.0)
    observations = th.ones(2, 4)
    copied.churn_reducer.remember(observations)
    assert th.equal(copied.churn_reducer.old_outputs, copied.q_net(observations).detach())


def test_predicts_without_an_environment(tmp_path):
    model = CChainDQN("MlpPolicy", RandomEnv(), **SETTINGS).learn(40)
    model.save(tmp_path / "model")
    loaded = CChainDQN.load(tmp_path / "model", device="cpu")
    observations = np.random.default_rng(0).uniform(-1, 1, (20, 4)).astype(np.float32)
    assert np.array_equal(*(m.predict(observations, deterministic=True)[0] for m in (model, loaded)))
