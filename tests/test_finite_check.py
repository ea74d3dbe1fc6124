"""NaN and infinite values are named before the network is trained on them."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_cchain import CChainCallback, CChainPPO, FiniteCheck, make_lean
from sb3_cchain.algorithms.finite_check import FEW_VALUES
from tests.churn_models import ACTION_SPACES, BOX, IMAGE, PPO_SETTINGS, each_form
from tests.envs import RandomEnv

DICT = spaces.Dict({"image": IMAGE, "a": spaces.Box(-1, 1, (2,), np.float64)})


class FaultyEnv(RandomEnv):
    """Gives one bad value: the reward, or an element of the observation, after so many steps of its life."""

    def __init__(self, fault=None, at=None, value=np.nan, observation_space=BOX):
        super().__init__(observation_space)
        self.fault, self.at, self.value, self.age = fault, at, value, 0

    def _spoil(self, observation):
        if self.age == self.at and self.fault == "observation":
            bad = observation["a"] if isinstance(observation, dict) else observation
            bad[1] = self.value
        return observation

    def reset(self, **kwargs):
        observation, info = super().reset(**kwargs)
        return self._spoil(observation), info

    def step(self, action):
        self.age += 1
        observation, reward, terminated, truncated, info = super().step(action)
        if self.age == self.at and self.fault == "reward":
            reward = self.value
        return self._spoil(observation), reward, terminated, truncated, info


def vectorise(*envs):
    return DummyVecEnv([lambda env=env: env for env in envs])


def learn(form, env, policy="MlpPolicy"):
    model, callback = form.make(env, policy)
    updates = []
    model.policy.optimizer.register_step_pre_hook(lambda *_: updates.append(model.num_timesteps))
    try:
        return model.learn(64, callback)
    except ValueError:
        assert max(updates, default=-1) < model.num_timesteps  # none after the bad value
        raise
    finally:
        assert all(parameter.isfinite().all() for parameter in model.policy.parameters())


@each_form
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("fault", ["reward", "observation"])
def test_names_environment_step_and_what(form, fault, value):
    env = vectorise(FaultyEnv(), FaultyEnv(fault, 13, value))
    with pytest.raises(ValueError, match=f"Environment 1 gave a NaN or infinite {fault} at step 26 .* it holds {value}"):
        learn(form, env)


@each_form
@pytest.mark.parametrize(
    "at, step",
    [(0, 0), (10, 10)],  # of the first reset; of an episode's last step, which the environment resets after
)
def test_observations_around_a_reset(form, at, step):
    with pytest.raises(ValueError, match=f"Environment 0 gave a NaN or infinite observation at step {step} "):
        learn(form, vectorise(FaultyEnv("observation", at)))


@each_form
def test_observations_of_a_dict(form):
    with pytest.raises(ValueError, match="observation 'a' at step 7 "):
        learn(form, vectorise(FaultyEnv("observation", 7, observation_space=DICT)), "MultiInputPolicy")


@each_form
@pytest.mark.parametrize("fault", ["reward", "observation"])
def test_normalised(form, fault):
    """VecNormalize clips an infinite value, but its statistics show it at the same step."""
    with np.errstate(invalid="ignore"), pytest.raises(ValueError, match=f"infinite {fault} at step 7 "):
        learn(form, VecNormalize(vectorise(FaultyEnv(fault, 7, np.inf))))


@each_form
def test_names_the_id(form):
    env = vectorise(FaultyEnv("reward", 3))
    env.envs[0].spec = type("Spec", (), {"id": "Faulty-v0"})
    with pytest.raises(ValueError, match=r"Environment 0 \(Faulty-v0\) gave"):
        learn(form, env)


@each_form
@pytest.mark.parametrize("reward", [1e12, -1e12])
def test_large_values_are_allowed(form, reward):
    assert learn(form, vectorise(FaultyEnv("reward", 7, reward))).num_timesteps == 64


@pytest.mark.parametrize("n_values", [2, FEW_VALUES, FEW_VALUES + 1])
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_few_and_many_values(dtype, n_values):
    check = FiniteCheck()
    check.model = SimpleNamespace(get_env=lambda: vectorise(FaultyEnv()), policy=None)
    values = np.full((1, n_values), np.finfo(dtype).max)  # whose sum is infinite
    check.locals = {"rewards": np.array([1.0], dtype), "new_obs": values, "dones": np.array([False])}
    assert check._on_step()
    for bad in ([np.nan], [np.inf], [-np.inf], [np.inf, -np.inf]):
        values[0, -len(bad) :] = bad
        with pytest.raises(ValueError, match=rf"NaN or infinite observation .* it holds {bad[0]}"):
            check._on_step()
    values[:] = 0
    check.locals["rewards"][0] = np.nan
    with pytest.raises(ValueError, match=r"NaN or infinite reward .* it holds nan"):
        check._on_step()


class FillsIn(FlattenExtractor):
    def forward(self, observations):
        return super().forward(observations).nan_to_num(0.0)


FILLS_IN = dict(features_extractor_class=FillsIn, net_arch=[8])


@each_form
@pytest.mark.parametrize("at", [0, 10, 13])
def test_nan_that_the_extractor_takes_for_a_missing_value(form, at):
    model, callback = form.make(vectorise(FaultyEnv(), FaultyEnv("observation", at)), policy_kwargs=FILLS_IN)
    assert model.learn(64, callback).num_timesteps == 64
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())


def test_nan_that_would_stay_in_the_statistics():
    env = VecNormalize(vectorise(FaultyEnv("observation", 7)))
    with pytest.raises(ValueError, match=r"observation at step 7 .* it holds nan"):
        CChainPPO("MlpPolicy", env, n_steps=16, batch_size=8, policy_kwargs=FILLS_IN, device="cpu").learn(64)


@each_form
def test_infinite_values_that_the_extractor_takes(form):
    """Nobody says a missing value by them."""
    model, callback = form.make(vectorise(FaultyEnv("observation", 7, np.inf)), policy_kwargs=FILLS_IN)
    with pytest.raises(ValueError, match=r"observation at step 7 .* it holds inf"):
        model.learn(64, callback)


# --- What the policy gives -----------------------------------------------------------------------------------------------


class SpoilOnce(BaseCallback):
    """Puts a value into a parameter after so many rollouts, as an update might."""

    def __init__(self, value, parameter="action_net.weight", n_rollouts=2):
        super().__init__()
        self.value, self.parameter, self.n_left = value, parameter, n_rollouts

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        self.n_left -= 1
        if self.n_left == 0:
            train = self.model.train

            def train_and_spoil():
                train()
                with th.no_grad():
                    dict(self.model.policy.named_parameters())[self.parameter].flatten()[0] = self.value

            self.model.train = train_and_spoil


POLICY_FORMS = {
    "CChainPPO": (lambda env: CChainPPO("MlpPolicy", env, **PPO_SETTINGS), []),
    "CChainCallback": (lambda env: PPO("MlpPolicy", env, **PPO_SETTINGS), [CChainCallback]),
    "lean PPO": (lambda env: make_lean(PPO("MlpPolicy", env, **PPO_SETTINGS)), [FiniteCheck]),
    "lean A2C": (lambda env: make_lean(A2C("MlpPolicy", env, device="cpu", n_steps=32)), [FiniteCheck]),
}
each_policy_form = pytest.mark.parametrize("make, callbacks", POLICY_FORMS.values(), ids=POLICY_FORMS)
each_action_space = pytest.mark.parametrize("action_space", ACTION_SPACES, ids=lambda space: type(space).__name__)


@each_policy_form
@each_action_space
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_names_the_parameter(make, callbacks, action_space, value):
    model = make(RandomEnv(action_space=action_space))
    with pytest.raises(ValueError, match=r"parameter action_net.weight holds NaN or infinite values at step 64 of training"):
        model.learn(32 * 4, [SpoilOnce(value), *(callback() for callback in callbacks)])


@each_policy_form
def test_names_the_parameter_after_the_last_update(make, callbacks):
    model = make(RandomEnv())
    with pytest.raises(ValueError, match=r"parameter action_net.weight holds NaN or infinite values at step 32 of training"):
        model.learn(32, [SpoilOnce(np.nan, n_rollouts=1), *(callback() for callback in callbacks)])


@pytest.mark.filterwarnings("ignore:invalid value")
@each_policy_form
def test_outputs_that_are_too_large(make, callbacks):
    """Of finite parameters."""
    model = make(RandomEnv())
    with th.no_grad():
        model.policy.value_net.weight[:] = 3e38
    with pytest.raises(
        ValueError, match=r"The policy gave NaN or infinite values in the rollout that ended at step 32 of training"
    ):
        model.learn(32, [callback() for callback in callbacks])


@pytest.mark.parametrize("deterministic", [False, True])
@each_action_space
def test_prediction_of_a_policy_with_nan(action_space, deterministic):
    """SB3's kind of error, too."""
    model = make_lean(PPO("MlpPolicy", RandomEnv(action_space=action_space), **PPO_SETTINGS))
    with th.no_grad():
        model.policy.action_net.weight[:] = np.nan
    with pytest.raises(ValueError, match="outputs of the policy network are NaN"):
        model.predict(np.ones(4, np.float32), deterministic=deterministic)


def test_the_last_observation_of_an_episode_alone():
    class Last(FaultyEnv):
        def reset(self, **kwargs):
            return RandomEnv.reset(self, **kwargs)

    model = CChainPPO("MlpPolicy", vectorise(Last("observation", 10)), n_steps=32, batch_size=8, device="cpu")
    with pytest.raises(ValueError, match="infinite observation at step 10 "):
        model.learn(64)
