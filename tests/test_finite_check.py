"""NaN and infinite values from an environment are named before the network is trained on them."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_cchain import CChainCallback, CChainDQN, CChainPPO
from tests.envs import RandomEnv

BOX = spaces.Box(-1, 1, (4,), np.float32)
DICT = spaces.Dict({"image": spaces.Box(0, 255, (36, 36, 3), np.uint8), "a": spaces.Box(-1, 1, (2,), np.float64)})
PPO_SETTINGS = dict(n_steps=16, batch_size=8, n_epochs=1, seed=0, device="cpu")
DQN_SETTINGS = dict(learning_starts=5, buffer_size=50, batch_size=8, train_freq=1, seed=0, device="cpu")
LEARNERS = {
    "CChainPPO": lambda *args: (CChainPPO(*args, **PPO_SETTINGS), None),
    "CChainDQN": lambda *args: (CChainDQN(*args, **DQN_SETTINGS), None),
    "CChainCallback": lambda *args: (PPO(*args, **PPO_SETTINGS), CChainCallback()),
}


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


def learn(learner, env, policy="MlpPolicy"):
    model, callback = LEARNERS[learner](policy, env)
    updates = []
    model.policy.optimizer.register_step_pre_hook(lambda *_: updates.append(model.num_timesteps))
    try:
        return model.learn(64, callback)
    finally:
        assert all(parameter.isfinite().all() for parameter in model.policy.parameters())
        # No update after the bad value
        assert not updates or model.num_timesteps >= max(updates)


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("fault", ["reward", "observation"])
def test_names_environment_step_and_what(learner, fault, value):
    env = vectorise(FaultyEnv(), FaultyEnv(fault, 13, value))
    with pytest.raises(ValueError, match=f"Environment 1 gave a NaN or infinite {fault} at step 26 .* it holds {value}"):
        learn(learner, env)


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize(
    "at, step",
    [(0, 0), (10, 10)],  # of the first reset; of an episode's last step, which the environment resets after
)
def test_observations_around_a_reset(learner, at, step):
    with pytest.raises(ValueError, match=f"Environment 0 gave a NaN or infinite observation at step {step} "):
        learn(learner, vectorise(FaultyEnv("observation", at)))


@pytest.mark.parametrize("learner", LEARNERS)
def test_observations_of_a_dict(learner):
    with pytest.raises(ValueError, match="observation 'a' at step 7 "):
        learn(learner, vectorise(FaultyEnv("observation", 7, observation_space=DICT)), "MultiInputPolicy")


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("fault", ["reward", "observation"])
def test_normalised(learner, fault):
    """VecNormalize clips an infinite value, but its statistics show it at the same step."""
    with np.errstate(invalid="ignore"), pytest.raises(ValueError, match=f"infinite {fault} at step 7 "):
        learn(learner, VecNormalize(vectorise(FaultyEnv(fault, 7, np.inf))))


@pytest.mark.parametrize("learner", LEARNERS)
def test_names_the_id(learner):
    env = vectorise(FaultyEnv("reward", 3))
    env.envs[0].spec = type("Spec", (), {"id": "Faulty-v0"})
    with pytest.raises(ValueError, match=r"Environment 0 \(Faulty-v0\) gave"):
        learn(learner, env)


@pytest.mark.parametrize("learner", LEARNERS)
@pytest.mark.parametrize("reward", [1e12, -1e12])
def test_large_values_are_allowed(learner, reward):
    model = learn(learner, vectorise(FaultyEnv("reward", 7, reward)))
    assert model.num_timesteps == 64
    assert all(th.isfinite(parameter).all() for parameter in model.policy.parameters())
