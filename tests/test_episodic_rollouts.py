"""Rollouts, advantages and value targets as in the paper's PPO."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from sb3_contrib import MaskablePPO, RecurrentPPO
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_cchain import ContinualMetrics, TaskSignal
from sb3_cchain.callbacks import EpisodicRollouts
from sb3_cchain.callbacks.episodic_rollouts import discounted_returns
from sb3_cchain.envs import RewardScale
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


class Masked(CountEnv):
    def action_masks(self):
        return np.ones(2, bool)


def test_the_last_value_is_that_of_the_last_observation():
    """With sb3-contrib, too, whose callbacks are not told that value."""
    targets = []
    for algorithm, env in ((PPO, CountEnv()), (MaskablePPO, Masked())):
        spy = Spy()
        model = algorithm("MlpPolicy", env, n_steps=10, batch_size=5, normalize_advantage=False, device="cpu", seed=0)
        model.policy.load_state_dict({name: th.full_like(value, 0.1) for name, value in model.policy.state_dict().items()})
        model.learn(10, [EpisodicRollouts(), spy])
        targets.append(spy.rollouts[0][2])
    assert np.array_equal(*targets) and targets[0][9, 0] != pytest.approx(1, abs=0.1)


def test_there_is_no_value_after_an_episode_that_has_ended():
    spy = Spy()
    model = PPO("MlpPolicy", CountEnv(length=5), n_steps=10, batch_size=5, normalize_advantage=False, gamma=1.0, device="cpu")
    model.learn(10, [EpisodicRollouts(), spy])
    assert spy.rollouts[0][2][:, 0].tolist() == [5, 4, 3, 2, 1] * 2


def test_recurrent_policies_are_refused():
    with pytest.raises(TypeError, match="EpisodicRollouts does not know recurrent networks, got RecurrentPPO"):
        RecurrentPPO("MlpLstmPolicy", CountEnv(), normalize_advantage=False).learn(8, EpisodicRollouts())


def test_returns_of_dropped_episodes_do_not_go_on():
    """Episodes of 7 steps, of which each rollout drops the last 3; nobody else counts them."""
    model = PPO("MlpPolicy", CountEnv(), n_steps=10, batch_size=5, normalize_advantage=False, device="cpu", seed=0)
    model.set_env(DummyVecEnv([CountEnv]))
    model.learn(40, [TaskSignal(), ContinualMetrics(), EpisodicRollouts()])
    assert [row["mean_return"] for row in model.continual_returns] == [7.0] * 4


def test_the_score_counts_the_episode_that_the_rollout_cuts():
    """Episodes of 7 steps with reward 1: 7, and 3 more steps in a rollout of 10; 7 and 7 in one of 14."""
    for n_steps, expected in ((10, (7 + 3) / 2), (14, 7.0)):
        model = PPO("MlpPolicy", CountEnv(), n_steps=n_steps, batch_size=2, normalize_advantage=False, device="cpu", seed=0)
        model.learn(2 * n_steps, callback=EpisodicRollouts(), log_interval=100)
        assert model.logger.name_to_value["continual/mean_return_with_cut"] == expected


def test_the_score_is_of_rewards_before_any_scaling():
    env = RewardScale(gym.make("Continual/CartPole-v1", n_tasks=2, steps_per_task=1000), scale=0.05)
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=32, normalize_advantage=False, device="cpu", seed=0)
    model.learn(64, callback=EpisodicRollouts(), log_interval=100)
    n_episodes = model.rollout_buffer.episode_starts.sum()
    assert model.logger.name_to_value["continual/mean_return_with_cut"] == 64 / n_episodes


def test_refuses_what_it_cannot_serve():
    with pytest.raises(TypeError, match="on-policy algorithms, got DQN"):
        DQN("MlpPolicy", CountEnv(), device="cpu").learn(10, callback=EpisodicRollouts())
    with pytest.raises(ValueError, match="set `normalize_advantage=False`, got True"):
        PPO("MlpPolicy", CountEnv(), device="cpu").learn(10, callback=EpisodicRollouts())
