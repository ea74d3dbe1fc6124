"""Rollouts, advantages and value targets as in the paper's PPO."""

import numpy as np
import pytest
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_cchain.callbacks import EpisodicRollouts
from sb3_cchain.callbacks.episodic_rollouts import discounted_returns
from tests.envs import CountEnv


def test_discounted_returns_by_hand():
    returns = discounted_returns(
        rewards=np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]]),
        episode_starts=np.array([[1.0, 1.0], [0.0, 0.0], [1.0, 0.0]]),
        last_values=np.array([8.0, 8.0]),
        last_dones=np.array([False, True]),
        gamma=0.5,
    )
    # The first environment begins an episode at the third step, which is cut; the second ends its only one there
    assert returns.tolist() == [[1 + 0.5 * 2, 1 + 0.5 * (2 + 0.5 * 3)], [2.0, 2 + 0.5 * 3], [3 + 0.5 * 8, 3.0]]


class Spy(BaseCallback):
    def __init__(self):
        super().__init__()
        self.rollouts = []

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        buffer = self.model.rollout_buffer
        self.rollouts.append((buffer.episode_starts.copy(), buffer.advantages.copy(), buffer.returns.copy()))


def test_rollouts(n_envs=2):
    spy = Spy()
    env = make_vec_env(CountEnv, n_envs=n_envs)  # episodes of 7 steps
    model = PPO("MlpPolicy", env, n_steps=10, batch_size=4, gamma=1.0, normalize_advantage=False, device="cpu", seed=0)
    model.learn(2 * 10 * n_envs, callback=[EpisodicRollouts(), spy])
    for episode_starts, advantages, returns in spy.rollouts:
        assert np.flatnonzero(episode_starts[:, 0]).tolist() == [0, 7]  # the second rollout begins with an episode
        assert np.allclose([advantages.mean(), advantages.std()], [0, 1], atol=1e-5)
        assert returns[:7, 0].tolist() == [7, 6, 5, 4, 3, 2, 1]
        assert np.allclose(np.diff(returns[7:, 0]), -1)  # and then the value of the last observation


def test_refuses_what_it_cannot_serve():
    with pytest.raises(TypeError, match="on-policy algorithms, got DQN"):
        DQN("MlpPolicy", CountEnv(), device="cpu").learn(10, callback=EpisodicRollouts())
    with pytest.raises(ValueError, match="set `normalize_advantage=False`, got True"):
        PPO("MlpPolicy", CountEnv(), device="cpu").learn(10, callback=EpisodicRollouts())
