"""
C-CHAIN Double DQN as one would write it down without this package: the update written out, and a copy of the network at every
update, as in the code released with the paper. The yardstick of the tests (same parameters) and of the speed figures.
"""

import copy
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import DQN
from torch.nn import functional as F


class DeepCopyDQN(DQN):
    """
    Double DQN with the mean squared TD error.

    :param args: Arguments of DQN
    :param target_churn_ratio: β
    :param churn_warmup: Updates with λ = 50
    :param churn_window: Updates that the running means go over
    :param kwargs: Keyword arguments of DQN
    """

    def __init__(
        self,
        *args: Any,
        target_churn_ratio: float = 0.01,
        churn_warmup: int = 10_000,
        churn_window: int = 50_000,
        **kwargs: Any,
    ):
        self.target_churn_ratio = target_churn_ratio
        self.churn_warmup = churn_warmup
        self.churn_window = churn_window
        self.td_losses: list[float] = []
        self.churn_losses: list[float] = []
        self.old_q_net: Any = None
        self.reference: Any = None
        super().__init__(*args, **kwargs)

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """
        Double DQN's updates with churn reduction.

        :param gradient_steps: Number of updates
        :param batch_size: Size of the minibatches and of the reference batches
        """
        assert self.replay_buffer is not None
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        for _ in range(gradient_steps):
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            with th.no_grad():
                greedy_actions = self.q_net(batch.next_observations).argmax(dim=1)
                next_values = self.q_net_target(batch.next_observations)[th.arange(batch_size), greedy_actions]
                targets = batch.rewards.flatten() + self.gamma * (1 - batch.dones.flatten()) * next_values
            values = self.q_net(batch.observations)[th.arange(batch_size), batch.actions.long().flatten()]
            td_loss = F.mse_loss(values, targets)
            loss = td_loss

            if self.old_q_net is not None:
                with th.no_grad():
                    old = self.old_q_net(self.reference)
                churn_loss = (self.q_net(self.reference) - old).pow(2).mean()
                loss = loss + self._churn_coef() * churn_loss
                self.td_losses.append(td_loss.item())
                self.churn_losses.append(churn_loss.item())
            self.reference = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env).observations
            self.old_q_net = copy.deepcopy(self.q_net)

            self.policy.optimizer.zero_grad()
            loss.backward()
            th.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
            self.policy.optimizer.step()
        self._n_updates += gradient_steps

    def _churn_coef(self) -> float:
        if len(self.td_losses) < self.churn_warmup:
            return 50.0
        mean_td_loss = np.mean(self.td_losses[-self.churn_window :])
        return float(self.target_churn_ratio * mean_td_loss / (np.mean(self.churn_losses[-self.churn_window :]) + 1e-8))
