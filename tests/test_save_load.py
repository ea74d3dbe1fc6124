"""Saved and loaded, training goes on as if it had never stopped."""

import base64
import copy
import json
import zipfile

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import set_random_seed

from sb3_cchain import CChainCallback, CChainDQN, CChainPPO
from sb3_cchain.networks.policy_outputs import policy_outputs
from tests.envs import RandomEnv

SETTINGS = dict(n_steps=32, batch_size=8, n_epochs=2, seed=0, device="cpu", churn_warmup=2, churn_window=4)
DICT = spaces.Dict({"a": spaces.Box(-1, 1, (2,), np.float32), "b": spaces.Discrete(3)})


def make_env(action_space=None, observation_space=None):
    return RandomEnv(observation_space, action_space)


def one_more_iteration(model, callback=None):
    """From the same random numbers and the same first observation."""
    set_random_seed(7)
    model.env.seed(7)
    model._last_obs = None
    model.learn(32, callback, reset_num_timesteps=False)
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


# --- What stock algorithms load, and the other way round -------------------------------------------------------------------

DQN_SETTINGS = dict(learning_starts=20, buffer_size=200, batch_size=8, train_freq=1, seed=0, device="cpu")
KINDS = {
    "PPO": (PPO, lambda: CChainPPO("MlpPolicy", make_env(), **SETTINGS).learn(64)),
    "DQN": (DQN, lambda: CChainDQN("MlpPolicy", make_env(), **DQN_SETTINGS).learn(64)),
    "callback": (PPO, lambda: PPO("MlpPolicy", make_env(), **PLAIN).learn(64, CChainCallback(churn_warmup=1))),
}
PLAIN = {key: value for key, value in SETTINGS.items() if "churn" not in key}


@pytest.mark.parametrize("kind", KINDS)
def test_stock_algorithms_load_it(kind, tmp_path):
    stock, make = KINDS[kind]
    model = make()
    model.save(tmp_path / "model")
    loaded = stock.load(tmp_path / "model", env=make_env(), device="cpu")
    for name, tensor in model.policy.state_dict().items():
        assert th.equal(tensor, loaded.policy.state_dict()[name]), name
    loaded.learn(64)
    stock("MlpPolicy", make_env(), device="cpu").set_parameters(tmp_path / "model")
    # Nothing of it needs this package
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        data = json.loads(archive.read("data"))
    pickles = [base64.b64decode(value[":serialized:"]) for value in data.values() if ":serialized:" in str(value)]
    assert len(pickles) > 5
    assert not any(b"sb3_cchain" in pickled for pickled in pickles)


@pytest.mark.parametrize("kind", KINDS)
def test_saved_again_by_a_stock_algorithm_the_history_is_kept(kind, tmp_path):
    stock, make = KINDS[kind]
    model = make()
    model.save(tmp_path / "model")
    loaded = stock.load(tmp_path / "model", env=make_env(), device="cpu")
    loaded.save(tmp_path / "unchanged")
    loaded.learn(64, reset_num_timesteps=False).save(tmp_path / "trained")
    for name, has_reference in (("unchanged", True), ("trained", False)):
        if kind == "callback":
            again = PPO.load(tmp_path / name, env=make_env(), device="cpu")
            callback = CChainCallback(churn_warmup=1)
            again.set_logger(configure(None, []))
            callback.init_callback(again)
            reducer = callback.churn_reducer
        else:
            again = type(model).load(tmp_path / name, env=make_env(), device="cpu")
            reducer = again.churn_reducer
        assert reducer.coefficient.value == model.churn_state.reducer.coefficient.value
        # What changed on the reference batch in training without churn reduction is no churn
        assert (reducer.reference is not None) == has_reference


@pytest.mark.parametrize("kind", KINDS)
def test_parameters_are_tensors_by_the_names_of_the_stock_algorithm(kind):
    stock, make = KINDS[kind]
    model = make()
    parameters = model.get_parameters()
    assert set(parameters) == {"policy", "policy.optimizer"}
    assert all(th.is_tensor(tensor) for tensor in parameters["policy"].values())
    stock("MlpPolicy", make_env(), device="cpu").set_parameters(parameters)
    for missing in parameters:
        some = {name: state for name, state in parameters.items() if name != missing}
        with pytest.raises(ValueError, match="Names of parameters do not match"):
            model.set_parameters(some)
        model.set_parameters(some, exact_match=False)


def test_callback_goes_on_after_loading_as_if_never_stopped(tmp_path):
    arguments = dict(churn_warmup=2, churn_window=4)
    model = PPO("MlpPolicy", make_env(), **PLAIN).learn(4 * 32, CChainCallback(**arguments))
    model.save(tmp_path / "model")
    loaded = PPO.load(tmp_path / "model", env=make_env(), device="cpu")
    without = PPO.load(tmp_path / "model", env=make_env(), device="cpu")
    values = []
    for goes_on, callback in ((model, CChainCallback(**arguments)), (loaded, CChainCallback(**arguments)), (without, None)):
        one_more_iteration(goes_on, callback)
        values.append(goes_on.logger.name_to_value.get("churn/coef"))
    assert values[0] == values[1] not in (None, 1.0)
    for name, tensor in model.policy.state_dict().items():
        assert th.equal(tensor, loaded.policy.state_dict()[name]), name
    assert not th.equal(model.policy.action_net.weight, without.policy.action_net.weight)


@pytest.mark.parametrize("kind", ["PPO", "DQN"])
def test_set_parameters_from_a_path_and_from_a_dict(kind, tmp_path):
    model = KINDS[kind][1]()
    model.save(tmp_path / "model")
    other = type(model)("MlpPolicy", make_env(), device="cpu", **{k: v for k, v in SETTINGS.items() if "churn" in k})
    other.churn_window = model.churn_window
    other.set_parameters(tmp_path / "model.zip", device="cpu")
    assert other.churn_reducer.coefficient.n_seen == model.churn_reducer.coefficient.n_seen > 0
    assert th.equal(other.churn_reducer.old_outputs, model.churn_reducer.old_outputs)
    other.set_parameters(model.get_parameters())
    # A dict has no history: these are the parameters of a network that has not churned yet
    assert other.churn_reducer.reference is None and other.churn_reducer.coefficient.n_seen == 0
    other.save(tmp_path / "other")
    assert type(model).load(tmp_path / "other", device="cpu").churn_reducer.coefficient.n_seen == 0


def test_the_task_is_kept(tmp_path):
    """So that λ starts over at a switch that a resumed training begins with."""
    model = CChainPPO("MlpPolicy", make_env(), reset_churn_coef=True, **SETTINGS).learn(32)
    model._task_switch.task_id = 1
    model.save(tmp_path / "model")
    loaded = CChainPPO.load(tmp_path / "model", device="cpu")
    assert loaded._task_switch.task_id == 1
