"""Rollouts, advantages and value targets as in the paper's PPO."""

from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.utils import obs_as_tensor

from sb3_cchain.callbacks.rollout_normalized_advantage import RolloutNormalizedAdvantage
from sb3_cchain.networks.algorithm_kinds import is_recurrent
from sb3_cchain.tasks.reset import reset_training_env


class EpisodicRollouts(RolloutNormalizedAdvantage):
    """
    Makes SB3's on-policy algorithms learn from rollouts like the PPO of the paper's Gym Control experiments (TRAC's code
    base):

    - each rollout begins with a new episode; the episode that was under way is dropped;
    - advantages are normalised once over the whole rollout, while SB3's PPO normalises them for each minibatch. Use it with
      ``normalize_advantage=False``;
    - the value function is fitted to the discounted return-to-go, while SB3 fits it to the TD(λ) return. The value of the
      last observation stands for the rest of an episode that was cut.

    Logs ``continual/mean_return_with_cut``: the mean return of all episodes of the rollout, with the episode that the end of
    the rollout cuts at its return so far. The released code scores Gym Control in this way. Returns are the environment's own,
    before any scaling, where it tells them (a :class:`~sb3_cchain.ContinualEnv` does), else sums of the rewards learned from.
    """

    def _init_callback(self) -> None:
        super()._init_callback()
        if is_recurrent(self.model):
            raise TypeError(f"EpisodicRollouts does not know recurrent networks, got {type(self.model).__name__}")

    def _on_rollout_start(self) -> None:
        reset_training_env(self.model)
        self._returns: list[float] = []  # of the episodes that have ended
        self._returns_so_far = [0.0] * self.training_env.num_envs

    def _on_step(self) -> bool:
        infos, rewards, dones = self.locals["infos"], self.locals["rewards"].tolist(), self.locals["dones"].tolist()
        for index, (info, reward, done) in enumerate(zip(infos, rewards, dones, strict=True)):
            self._returns_so_far[index] += info.get("task_reward", reward)
            if done:
                self._returns.append(self._returns_so_far[index])
                self._returns_so_far[index] = 0.0
        return True

    def _on_rollout_end(self) -> None:
        super()._on_rollout_end()
        cut = [so_far for so_far, done in zip(self._returns_so_far, self.locals["dones"], strict=True) if not done]
        self.logger.record("continual/mean_return_with_cut", float(np.mean([*self._returns, *cut])))
        buffer = self.model.rollout_buffer
        assert self.model._last_obs is not None
        with th.no_grad():  # sb3-contrib does not tell callbacks the last value
            last_values = self.model.policy.predict_values(obs_as_tensor(self.model._last_obs, self.model.device))
        buffer.returns = discounted_returns(
            buffer.rewards,
            buffer.episode_starts,
            last_values=last_values.cpu().numpy().flatten(),
            last_dones=self.locals["dones"],
            gamma=self.model.gamma,
        )


def discounted_returns(
    rewards: NDArray[Any], episode_starts: NDArray[Any], last_values: NDArray[Any], last_dones: NDArray[np.bool_], gamma: float
) -> NDArray[Any]:
    """
    :param rewards: ``(n_steps, n_envs)``
    :param episode_starts: Whether a step is the first of its episode, ``(n_steps, n_envs)``
    :param last_values: Value of the observation after the last step, ``(n_envs,)``
    :param last_dones: Whether the last step ended its episode, ``(n_envs,)``
    :param gamma: Discount factor
    :return: Discounted sum of the rewards from each step to the end of its episode, ``(n_steps, n_envs)``
    """
    returns = np.zeros_like(rewards)
    # Of what comes after each step: γ, or 0 where an episode ends. All at once, which takes half the time
    discounts = [*(gamma * (1.0 - episode_starts[1:])), gamma * (1.0 - last_dones)]
    later = last_values
    for step in reversed(range(len(rewards))):
        returns[step] = later = rewards[step] + discounts[step] * later
    return returns
