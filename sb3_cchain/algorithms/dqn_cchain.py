"""Double DQN with churn reduction."""

from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.type_aliases import MaybeCallback, ReplayBufferSamples

from sb3_cchain.algorithms.churn_algorithm import ChurnAlgorithm
from sb3_cchain.algorithms.double_dqn import DoubleDQN
from sb3_cchain.algorithms.off_policy import QValues, finite_td_loss, joint_pass, log_q_churn, make_q_reducer
from sb3_cchain.algorithms.replay_observations import sample_observations
from sb3_cchain.churn import ChurnReducer
from sb3_cchain.churn.reducer import Observations
from sb3_cchain.networks.policy_outputs import as_it_acts, has_training_mode

SelfCChainDQN = TypeVar("SelfCChainDQN", bound="CChainDQN")


class CChainDQN(ChurnAlgorithm, DoubleDQN):
    """
    (Double) Deep Q-Network with Continual Churn Approximated Reduction (C-CHAIN).

    Paper: https://arxiv.org/abs/2506.00592 (Tang et al., ICML 2025)

    It is :class:`~sb3_cchain.DoubleDQN`, which is SB3's :class:`~stable_baselines3.DQN` with all of its arguments, plus
    λ·L_churn in the loss of each update. L_churn is the change that the previous update made to the Q-network: the mean
    squared change of all action values on an independent sample of the replay buffer.

    Deviation from the code released with the paper: the reference batch is drawn, and the old outputs are computed, before
    the update instead of by a copy of the network after it.

    The defaults do not depend on the scale of rewards: λ adapts from the first updates on. The paper's values for MinAtar,
    ``"auto_50"``, a warm-up of 10 000 and a window of 50 000 updates, are in the YAML file of the package. On other tasks a λ
    of 50 can be so strong that nothing is learned.

    :param args: Arguments of DoubleDQN
    :param churn_coef: λ, the weight of the churn loss: a number, ``"auto"`` to keep the churn loss at
        ``target_churn_ratio`` times the TD loss, or ``"auto_50"`` to use 50 (as the released code) instead of 1 during the
        warm-up. With 0 it is DoubleDQN, to the bit.
    :param target_churn_ratio: β, the size of λ·L_churn relative to the TD loss. ``"auto"`` is the paper's 0.01.
    :param churn_warmup: Gradient updates until λ adapts; with 0 it adapts after the first churn loss
    :param churn_window: Gradient updates that the running means of both losses cover
    :param churn_coef_min: Least value of λ once it adapts
    :param reset_churn_coef: Whether λ starts over (warm-up included) when ``info["task_id"]`` changes
    :param kwargs: Keyword arguments of DoubleDQN
    :raises ValueError: Naming the churn argument that is out of its range
    """

    def __init__(
        self,
        *args: Any,
        churn_coef: float | str = "auto",
        churn_warmup: int = 0,
        churn_window: int = 1000,
        **kwargs: Any,
    ):
        super().__init__(*args, churn_coef=churn_coef, churn_warmup=churn_warmup, churn_window=churn_window, **kwargs)

    def _make_churn_reducer(self) -> ChurnReducer:
        return make_q_reducer(self, self._make_churn_coefficient)

    def _loss(self, replay_data: ReplayBufferSamples, batch_size: int) -> tuple[th.Tensor, float]:
        """
        :param replay_data: A minibatch
        :param batch_size: Size of the reference batch
        :return: The TD loss plus λ·L_churn, and the value of the TD loss, which is logged
        """
        reducer = self.churn_reducer
        if reducer.coefficient.is_zero:
            return super()._loss(replay_data, batch_size)

        # Independent of the minibatch. It waits for the next update, which measures on it what this update changes
        assert self.replay_buffer is not None
        reference = sample_observations(self.replay_buffer, batch_size, self._vec_normalize_env)
        values = self._all_q_values(replay_data, reference)

        td_loss = self._td_loss(replay_data, values.current, values.next)
        td_loss_value = finite_td_loss(td_loss, replay_data)
        loss = td_loss
        if values.previous_reference is not None:  # the first update has no previous one
            coef = reducer.coefficient.value
            loss = td_loss + reducer.loss(values.previous_reference)
            assert reducer.old_outputs is not None
            log_q_churn(
                self.logger, coef, reducer.losses[-1], td_loss_value, reducer.old_outputs, values.previous_reference.detach()
            )
            reducer.end_iteration(td_loss_value)
        reducer.remember(reference, values.reference)
        return loss, td_loss_value

    def _all_q_values(self, replay_data: ReplayBufferSamples, reference: Observations) -> QValues:
        previous = self.churn_reducer.reference
        if not has_training_mode(self.q_net):
            return joint_pass(self.q_net, replay_data, reference, previous, self.double_q)
        # Reference batches go through the network as it acts in the environment: they do not move the running statistics
        # of BatchNorm, and the noise of dropout is no churn
        current, next_values = self._q_values(replay_data)
        with as_it_acts(self.policy):
            previous_values = None if previous is None else self.q_net(previous)
            with th.no_grad():
                return QValues(current, next_values, self.q_net(reference), previous_values)

    def learn(
        self: SelfCChainDQN,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "CChainDQN",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfCChainDQN:
        """
        As DQN's. In a continual environment the callbacks that follow its tasks are added.

        :param total_timesteps: Environment steps to train for
        :param callback: Callback(s) called at every step
        :param log_interval: Episodes between two logs
        :param tb_log_name: Name of the run in TensorBoard
        :param reset_num_timesteps: Whether to count environment steps from 0
        :param progress_bar: Whether to show a progress bar
        :return: The trained model
        """
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
