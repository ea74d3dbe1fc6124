"""Small environments for the tests."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class RandomEnv(gym.Env):
    """Random observations and rewards, episodes of ten steps, any spaces."""

    def __init__(self, observation_space=None, action_space=None):
        self.observation_space = observation_space or spaces.Box(-1, 1, (4,), np.float32)
        self.action_space = action_space or spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.n_steps = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self.n_steps += 1
        return self.observation_space.sample(), float(self.np_random.normal()), False, self.n_steps >= 10, {}


class CountEnv(gym.Env):
    """Observes its own name; reward 1 per step; episodes of ``length`` steps."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    observation_space = spaces.Box(-1e6, 1e6, (1,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, name=0, length=7, reward=1.0, render_mode=None):
        self.name, self.length, self.task_reward, self.render_mode = name, length, reward, render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n_steps = 0
        # Differs with the seed, so that seeding can be told
        return np.array([self.name + self.np_random.random() / 10], dtype=np.float32), {}

    def step(self, action):
        self.n_steps += 1
        observation = np.array([self.name + self.np_random.random() / 10], dtype=np.float32)
        return observation, self.task_reward, self.n_steps >= self.length, False, {}

    def render(self):
        return np.full((2, 2, 3), self.name, dtype=np.uint8)
