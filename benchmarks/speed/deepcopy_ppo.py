"""
C-CHAIN PPO as one would write it down without this package: PPO's update written out, and a copy of the network at every
minibatch, as in the code released with the paper. The yardstick of the tests (same parameters) and of the speed figures.
"""

import copy
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from torch.nn import functional as F


class DeepCopyPPO(PPO):
    """
    :param args: Arguments of PPO
    :param target_churn_ratio: β
    :param churn_warmup: Iterations with λ = 1
    :param churn_window: Iterations that the running means go over
    :param churn_reference: Where reference batches are taken from: ``"independent"`` or ``"next"``
    :param churn_batch_size: Size of a reference batch in minibatches, at most 2
    :param kwargs: Keyword arguments of PPO
    """

    def __init__(
        self,
        *args: Any,
        target_churn_ratio: float = 1e4,
        churn_warmup: int = 10,
        churn_window: int = 50,
        churn_reference: str = "independent",
        churn_batch_size: float = 1.0,
        **kwargs: Any,
    ):
        self.target_churn_ratio = target_churn_ratio
        self.churn_warmup = churn_warmup
        self.churn_window = churn_window
        self.churn_reference = churn_reference
        self.churn_batch_size = churn_batch_size
        self.actor_losses: list[float] = []
        self.churn_losses: list[float] = []
        self.old_policy: Any = None
        self.reference: Any = None
        super().__init__(*args, **kwargs)

    def train(self) -> None:
        """PPO's update with churn reduction, without early stopping."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        clip_range = self.clip_range(self._current_progress_remaining)  # type: ignore[operator]
        discrete = isinstance(self.action_space, spaces.Discrete)

        churn_coef: Any = 1.0
        if len(self.actor_losses) >= self.churn_warmup:
            mean_actor_loss = np.mean(self.actor_losses[-self.churn_window :])
            mean_churn_loss = np.mean(self.churn_losses[-self.churn_window :])
            churn_coef = self.target_churn_ratio * mean_actor_loss / (mean_churn_loss + 1e-8)

        actor_losses, churn_losses = [], []
        for _ in range(self.n_epochs):
            minibatches = list(self.rollout_buffer.get(self.batch_size))
            for i, batch in enumerate(minibatches):
                actions = batch.actions.long().flatten() if discrete else batch.actions
                values, log_prob, entropy = self.policy.evaluate_actions(batch.observations, actions)
                advantages = batch.advantages
                if self.normalize_advantage and len(advantages) > 1:
                    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
                ratio = th.exp(log_prob - batch.old_log_prob)
                clipped_ratio = th.clamp(ratio, 1 - clip_range, 1 + clip_range)
                actor_loss = -th.min(advantages * ratio, advantages * clipped_ratio).mean()
                actor_loss = actor_loss - self.ent_coef * entropy.mean()  # type: ignore[union-attr]
                values = values.flatten()
                if self.clip_range_vf is not None:
                    clip_range_vf = self.clip_range_vf(self._current_progress_remaining)  # type: ignore[operator]
                    values = batch.old_values + th.clamp(values - batch.old_values, -clip_range_vf, clip_range_vf)
                loss = actor_loss + self.vf_coef * F.mse_loss(batch.returns, values)
                actor_losses.append(actor_loss.item())

                if self.old_policy is not None:
                    with th.no_grad():
                        old = self.old_policy.get_distribution(self.reference).distribution
                    new: Any = self.policy.get_distribution(self.reference).distribution
                    if discrete:
                        churn_loss = -(old.probs * th.log(new.probs + 1e-8)).sum(dim=1).mean()
                    else:
                        churn_loss = (new.mean - old.mean).pow(2).mean()
                    loss = loss + churn_coef * churn_loss
                    churn_losses.append(churn_loss.item())

                # The next minibatch, or the one half an epoch away: neither shares a sample with this one
                first = i + (1 if self.churn_reference == "next" else (len(minibatches) + 1) // 2)
                following = [minibatches[(first + j) % len(minibatches)].observations for j in range(2)]
                self.reference = th.cat(following)[: round(self.churn_batch_size * self.batch_size)]
                # The network alone, without its optimiser and its last action distribution
                kept: dict[int, Any] = {id(part): part for part in (self.policy.optimizer, self.policy.action_dist)}
                self.old_policy = copy.deepcopy(self.policy, memo=kept)

                self.policy.optimizer.zero_grad()
                loss.backward()
                th.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
                self.policy.optimizer.step()
            self._n_updates += 1

        self.actor_losses.append(abs(float(np.mean(actor_losses))))
        self.churn_losses.append(abs(float(np.mean(churn_losses))))
