"""Double DQN."""

import warnings
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import torch as th
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, ReplayBufferSamples
from stable_baselines3.dqn.policies import DQNPolicy
from torch.nn import functional as F

from sb3_cchain.algorithms.full_signature import FullSignature
from sb3_cchain.algorithms.q_network import finite_td_loss
from sb3_cchain.algorithms.zero_rate_warning import ZeroRateWarning
from sb3_cchain.checkpoint import TrainingCheckpoint
from sb3_cchain.networks.evaluation_mode import as_it_acts
from sb3_cchain.tasks.callback_tree import iterate_callbacks
from sb3_cchain.validation import check_bool, check_choice

SelfDoubleDQN = TypeVar("SelfDoubleDQN", bound="DoubleDQN")

LOSSES: dict[str, Callable[..., th.Tensor]] = {"huber": F.smooth_l1_loss, "mse": F.mse_loss}


class DoubleDQN(FullSignature, ZeroRateWarning, DQN):
    r"""
    Deep Q-Network with Double Q-learning.

    Paper: https://arxiv.org/abs/1509.06461 (van Hasselt et al., AAAI 2016)

    It is SB3's :class:`~stable_baselines3.DQN`, with all of its arguments. The online network chooses the greedy action in the
    next state, and the target network gives its value:
    :math:`r + \gamma \, Q_{target}(s', \arg\max_a Q(s', a))`.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: The environment to learn from (if registered in Gym, can be str)
    :param args: Further arguments of DQN
    :param double_q: Whether to use Double Q-learning; with ``False`` and ``loss="huber"`` it is SB3's DQN, to the bit
    :param loss: Loss of the TD error: ``"huber"`` as SB3, or ``"mse"`` as the C-CHAIN paper's Double DQN
    :param kwargs: Further keyword arguments of DQN
    :raises ValueError: For a ``loss`` that is neither
    :raises TypeError: When ``double_q`` is not a boolean
    :raises AssertionError: When the actions are not ``Discrete``, as SB3's DQN
    """

    def __init__(
        self,
        policy: str | type[DQNPolicy],
        env: GymEnv | str,
        *args: Any,
        double_q: bool = True,
        loss: str = "huber",
        **kwargs: Any,
    ):
        self.double_q = double_q
        self.loss = loss
        self._check_arguments()  # before an environment is made
        super().__init__(policy, env, *args, **kwargs)

    def _check_arguments(self) -> None:
        check_bool("double_q", self.double_q)
        check_choice("loss", self.loss, tuple(LOSSES))

    def _setup_model(self) -> None:
        self._check_arguments()  # again, because `load()` may have changed them
        super()._setup_model()

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """
        Update the Q-network, as SB3's DQN does, with Double Q-learning and the chosen loss.

        :param gradient_steps: Number of gradient updates
        :param batch_size: Minibatch size
        :raises ValueError: When the loss is NaN or infinite. The parameters have not been updated.
        """
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)

        td_losses = []
        for _ in range(gradient_steps):
            assert self.replay_buffer is not None
            replay_data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            loss, td_loss = self._loss(replay_data, batch_size)
            td_losses.append(td_loss)

            self.policy.optimizer.zero_grad()
            loss.backward()
            th.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
            self.policy.optimizer.step()

        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/loss", np.mean(td_losses))

    def _loss(self, replay_data: ReplayBufferSamples, batch_size: int) -> tuple[th.Tensor, float]:
        """
        :param replay_data: A minibatch
        :param batch_size: The number of transitions that were asked for
        :return: The loss to minimise, and the value of the TD loss, which is logged
        """
        loss = self._td_loss(replay_data, *self._q_values(replay_data))
        return loss, finite_td_loss(loss, replay_data)

    def _q_values(self, replay_data: ReplayBufferSamples) -> tuple[th.Tensor, th.Tensor | None]:
        """
        :param replay_data: A minibatch
        :return: The online network's action values ``(batch_size, n_actions)`` of the observations, and those of the next
            observations, without gradient; None without Double Q-learning, which does not need them
        """
        next_q_values = None
        if self.double_q:
            # As the target network: next observations do not move the running statistics of BatchNorm, and no dropout
            with th.no_grad(), as_it_acts(self.q_net):
                next_q_values = self.q_net(replay_data.next_observations)
        return self.q_net(replay_data.observations), next_q_values

    def _td_loss(self, replay_data: ReplayBufferSamples, q_values: th.Tensor, next_q_values: th.Tensor | None) -> th.Tensor:
        """
        :param replay_data: A minibatch
        :param q_values: As returned by ``_q_values()``
        :param next_q_values: As returned by ``_q_values()``
        :return: The mean loss of the TD errors
        """
        # For n-step replay, the discount factor is gamma**n_steps (when no early termination)
        discounts = replay_data.discounts if replay_data.discounts is not None else self.gamma
        with th.no_grad():
            next_values = self.q_net_target(replay_data.next_observations)
            if next_q_values is None:
                next_values = next_values.max(dim=1, keepdim=True).values
            else:
                next_values = next_values.gather(dim=1, index=next_q_values.argmax(dim=1, keepdim=True))
            targets = replay_data.rewards + (1 - replay_data.dones) * discounts * next_values
        return LOSSES[self.loss](q_values.gather(dim=1, index=replay_data.actions.long()), targets)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        assert self.replay_buffer is not None
        n_transitions = self.replay_buffer.size() * self.n_envs
        is_resumed = any(isinstance(found, TrainingCheckpoint) and found.is_resuming for found in iterate_callbacks(result[1]))
        if is_resumed:  # it will put the replay buffer back
            return result
        if self.num_timesteps > self.learning_starts and n_transitions < min(self.batch_size, self.num_timesteps):
            warnings.warn(
                f"Training goes on at step {self.num_timesteps}, after `learning_starts={self.learning_starts}`, with "
                f"{n_transitions} transitions in the replay buffer: the next updates are made on very few transitions. A "
                "saved model does not hold its replay buffer: call `save_replay_buffer()` and `load_replay_buffer()`, or "
                "raise `learning_starts` to collect new transitions first."
            )
        return result

    def learn(
        self: SelfDoubleDQN,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "DoubleDQN",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfDoubleDQN:
        """
        As DQN's.

        :param total_timesteps: Environment steps to train for
        :param callback: Callback(s) called at every step
        :param log_interval: Episodes between two logs
        :param tb_log_name: Name of the run in TensorBoard
        :param reset_num_timesteps: Whether to count environment steps from 0
        :param progress_bar: Whether to show a progress bar
        :return: The trained model
        """
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
