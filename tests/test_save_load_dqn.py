"""Saved and loaded, training goes on as if it had never stopped."""

import copy
import warnings

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN, HerReplayBuffer
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.utils import set_random_seed

from sb3_cchain import CChainDQN, DoubleDQN
from tests.envs import RandomEnv

BASE_SETTINGS = dict(learning_starts=20, buffer_size=200, batch_size=8, train_freq=1, seed=0, device="cpu")
SETTINGS = dict(BASE_SETTINGS, churn_warmup=5, churn_window=7)
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
    assert model.churn_reducer.coefficient.value != 1
    forgetful.churn_reducer.forget_reference()
    go_on(forgetful)
    assert any(not th.equal(p, q) for p, q in zip(forgetful.policy.parameters(), loaded.policy.parameters(), strict=True))


@pytest.mark.parametrize("saved, loaded", [(DQN, DoubleDQN), (DQN, CChainDQN), (DoubleDQN, CChainDQN)])
def test_takes_checkpoints_of_its_base(tmp_path, saved, loaded):
    model = saved("MlpPolicy", RandomEnv(), **BASE_SETTINGS).learn(40)
    model.save(tmp_path / "model")
    other = loaded.load(tmp_path / "model", env=RandomEnv(), device="cpu")
    assert all(th.equal(p, q) for p, q in zip(model.policy.parameters(), other.policy.parameters(), strict=True))
    other.learn(40)


def test_arguments_can_be_changed_on_loading(tmp_path):
    CChainDQN("MlpPolicy", RandomEnv(), **SETTINGS).learn(50).save(tmp_path / "model")
    loaded = CChainDQN.load(tmp_path / "model", env=RandomEnv(), device="cpu", loss="mse", double_q=False, churn_window=9)
    assert (loaded.loss, loaded.double_q) == ("mse", False)
    assert loaded.churn_reducer.coefficient.value == 1  # another window starts over
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


@pytest.mark.parametrize("cls", [DoubleDQN, CChainDQN])
def test_learning_rate_can_be_changed_on_loading(tmp_path, cls):
    cls("MlpPolicy", RandomEnv(), learning_rate=1e-3, **BASE_SETTINGS).learn(40).save(tmp_path / "model")
    loaded = cls.load(tmp_path / "model", env=RandomEnv(), device="cpu", learning_rate=0.5)
    loaded.learn(40)
    assert loaded.policy.optimizer.param_groups[0]["lr"] == 0.5


@pytest.mark.parametrize("cls", [DoubleDQN, CChainDQN])
def test_n_steps_can_be_changed_on_loading(tmp_path, cls):
    cls("MlpPolicy", RandomEnv(), **BASE_SETTINGS).learn(40).save(tmp_path / "model")
    loaded = cls.load(tmp_path / "model", env=RandomEnv(), device="cpu", n_steps=3, replay_buffer_class=None)
    assert isinstance(loaded.replay_buffer, NStepReplayBuffer) and loaded.replay_buffer.n_steps == 3
    loaded.learn(40)
    assert loaded._n_updates == 40


class Watch(BaseCallback):
    """Lists the environment steps at which the target network is copied, and the exploration rate of each step."""

    def __init__(self):
        super().__init__()
        self.copies, self.rates = [], []

    def _on_step(self):
        # The model copies at the end of the step, after its callbacks
        if (self.model._n_calls + 1) % self.model.target_update_interval == 0:
            self.copies.append(self.num_timesteps)
        self.rates.append(self.model.exploration_rate)
        return True


@pytest.mark.parametrize("cls", [DoubleDQN, CChainDQN])
def test_exploration_and_target_updates_go_on_over_several_loads(tmp_path, cls):
    settings = {**BASE_SETTINGS, "target_update_interval": 30, "exploration_fraction": 0.5}
    watch = Watch()
    model = cls("MlpPolicy", RandomEnv(), **settings).learn(40, callback=watch)
    assert watch.rates[1] > 0.9
    for _ in range(4):
        model.save(tmp_path / "model")
        model.save_replay_buffer(tmp_path / "buffer")
        model = cls.load(tmp_path / "model", env=RandomEnv(), device="cpu")
        model.load_replay_buffer(tmp_path / "buffer")
        model.learn(40, reset_num_timesteps=False, callback=watch)
    assert watch.copies == [30, 60, 90, 120, 150, 180]
    # In all later parts more than half of all the steps have been made
    assert watch.rates[40:] == [pytest.approx(0.05)] * 160


@pytest.mark.parametrize("cls", [DoubleDQN, CChainDQN])
@pytest.mark.parametrize(
    "make_env, policy, arguments",
    [
        (RandomEnv, "MlpPolicy", dict(train_freq=(1, "episode"), gradient_steps=2)),
        (
            RandomEnv,
            "MlpPolicy",
            dict(optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False)),
        ),
        (lambda: BitFlippingEnv(n_bits=4), "MultiInputPolicy", dict(replay_buffer_class=HerReplayBuffer)),
    ],
    ids=["episodes", "memory", "HER"],
)
def test_other_arguments_of_dqn_go_on_after_loading(tmp_path, cls, make_env, policy, arguments):
    model = cls(policy, make_env(), **{**BASE_SETTINGS, **arguments}).learn(60)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = cls.load(tmp_path / "model", env=make_env(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer")
    n_updates = loaded._n_updates
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded.learn(40, reset_num_timesteps=False)
    assert loaded._n_updates > n_updates == model._n_updates > 0


@pytest.mark.parametrize("cls", [DoubleDQN, CChainDQN])
def test_a_lost_replay_buffer_is_warned_of(tmp_path, cls):
    model = cls("MlpPolicy", RandomEnv(), **BASE_SETTINGS).learn(50)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")

    def warned(reset_num_timesteps=False, load_buffer=False, times=1, **changed):
        loaded = cls.load(tmp_path / "model", env=RandomEnv(), device="cpu", **changed)
        if load_buffer:
            loaded.load_replay_buffer(tmp_path / "buffer")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            for _ in range(times):
                loaded.learn(10, reset_num_timesteps=reset_num_timesteps)
        return [str(warning.message) for warning in caught]

    (message,) = warned(times=2)
    assert "at step 50, after `learning_starts=20`, with 0 transitions in the replay buffer" in message
    assert warned(load_buffer=True) == []
    assert warned(reset_num_timesteps=True) == []  # random steps first, as at the beginning
    assert warned(learning_starts=100) == []


def test_a_short_training_that_goes_on_has_lost_nothing(recwarn):
    model = CChainDQN("MlpPolicy", RandomEnv(), **{**BASE_SETTINGS, "learning_starts": 0, "batch_size": 32})
    for _ in range(3):
        model.learn(5, reset_num_timesteps=False)
    assert len(recwarn) == 0


@pytest.mark.parametrize("cls", [DoubleDQN, CChainDQN])
def test_a_compiled_policy_trains_and_loads_as_one_that_is_not(tmp_path, cls):
    plain = cls("MlpPolicy", RandomEnv(), **BASE_SETTINGS).learn(50)
    compiled = cls("MlpPolicy", RandomEnv(), **BASE_SETTINGS)
    compiled.policy = th.compile(compiled.policy, backend="eager")
    compiled.learn(50)
    compiled.save(tmp_path / "model")
    compiled.save_replay_buffer(tmp_path / "buffer")
    loaded = cls.load(tmp_path / "model", env=RandomEnv(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer")
    for model in (compiled, loaded):
        for p, q in zip(plain.policy.parameters(), model.policy.parameters(), strict=True):
            assert th.equal(p, q)
    go_on(plain)
    for p, q in zip(plain.policy.parameters(), go_on(loaded).policy.parameters(), strict=True):
        assert th.equal(p, q)


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
