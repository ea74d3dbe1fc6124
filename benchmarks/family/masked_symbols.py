"""A small continual task with invalid actions."""

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from sb3_contrib.common.wrappers import ActionMasker

from sb3_cchain import ContinualEnv


class MaskedSymbols(gym.Env[np.int64, np.int64]):
    """
    Answer each symbol with its own action, for a reward of 1. Half of the wrong actions are invalid in each step. Like
    sb3-contrib's ``InvalidActionEnvDiscrete``, but a task has its own answers.

    :param answers: The right action of each symbol
    :param episode_steps: Steps of an episode
    """

    def __init__(self, answers: tuple[int, ...], episode_steps: int = 50):
        self.answers = answers
        self.episode_steps = episode_steps
        self.observation_space = spaces.Discrete(len(answers))
        self.action_space = spaces.Discrete(len(answers))

    def _next_symbol(self) -> np.int64:
        n_symbols = len(self.answers)
        self.symbol = np.int64(self.np_random.integers(n_symbols))
        wrong = np.delete(np.arange(n_symbols), self.answers[self.symbol])
        self.mask = np.ones(n_symbols, dtype=bool)
        self.mask[self.np_random.choice(wrong, n_symbols // 2, replace=False)] = False
        return self.symbol

    def action_masks(self) -> np.ndarray:
        """
        :return: Whether each action is valid
        """
        return self.mask

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.int64, dict[str, Any]]:
        """
        :param seed: Seed
        :param options: Not used
        :return: The first symbol, and an empty info
        """
        super().reset(seed=seed)
        self.n_steps = 0
        return self._next_symbol(), {}

    def step(self, action: np.int64) -> tuple[np.int64, float, bool, bool, dict[str, Any]]:
        """
        :param action: The answer
        :return: The next symbol, the reward, False, whether the episode is over, an empty info
        """
        reward = float(action == self.answers[self.symbol])
        self.n_steps += 1
        return self._next_symbol(), reward, False, self.n_steps >= self.episode_steps, {}


def _masks_of_task(env: gym.Env) -> np.ndarray:
    assert isinstance(env, ContinualEnv) and isinstance(env.task, MaskedSymbols)
    return env.task.action_masks()


def continual_masked_symbols(n_tasks: int, steps_per_task: int, n_symbols: int = 30) -> gym.Env:
    """
    :param n_tasks: Length of the sequence
    :param steps_per_task: Environment steps per task
    :param n_symbols: Number of symbols, and of actions
    :return: Tasks with other answers each, and the masks of the present one
    """
    generator = np.random.default_rng(0)
    answers = [tuple(generator.permutation(n_symbols).tolist()) for _ in range(n_tasks)]
    return ActionMasker(ContinualEnv([partial(MaskedSymbols, each) for each in answers], steps_per_task), _masks_of_task)
