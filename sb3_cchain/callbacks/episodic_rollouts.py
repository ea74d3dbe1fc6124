"""Rollouts, advantages and value targets as in the paper's PPO."""

import numpy as np

from sb3_cchain.callbacks.rollout_normalized_advantage import RolloutNormalizedAdvantage


class EpisodicRollouts(RolloutNormalizedAdvantage):
    """
    Makes SB3's on-policy algorithms learn from rollouts like the PPO of the paper's Gym Control experiments (TRAC's code
    base):

    - each rollout begins with a new episode; the episode that was under way is dropped;
    - advantages are normalised once over the whole rollout, while SB3's PPO normalises them for each minibatch. Use it with
      ``normalize_advantage=False``;
    - the value function is fitted to the discounted return-to-go, while SB3 fits it to the TD(λ) return. The value of the
      last observation stands for the rest of an episode that was cut.
    """

    def _on_rollout_start(self) -> None:
        self.model._last_obs = self.training_env.reset()  # type: ignore[assignment]
        self.model._last_episode_starts = np.ones(self.training_env.num_envs, dtype=bool)

    def _on_rollout_end(self) -> None:
        super()._on_rollout_end()
        buffer = self.model.rollout_buffer
        buffer.returns = discounted_returns(
            buffer.rewards,
            buffer.episode_starts,
            last_values=self.locals["values"].cpu().numpy().flatten(),
            last_dones=self.locals["dones"],
            gamma=self.model.gamma,
        )


def discounted_returns(
    rewards: np.ndarray, episode_starts: np.ndarray, last_values: np.ndarray, last_dones: np.ndarray, gamma: float
) -> np.ndarray:
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
