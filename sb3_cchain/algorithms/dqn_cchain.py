"""Double DQN with churn reduction."""

from typing import Any, TypeVar

from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_cchain.algorithms.churn_algorithm import ChurnAlgorithm
from sb3_cchain.algorithms.double_dqn import DoubleDQN
from sb3_cchain.algorithms.off_policy import make_q_reducer, reduced_q_churn
from sb3_cchain.churn import ChurnReducer

SelfCChainDQN = TypeVar("SelfCChainDQN", bound="CChainDQN")


class CChainDQN(ChurnAlgorithm, DoubleDQN):
    """
    (Double) Deep Q-Network with Continual Churn Approximated Reduction (C-CHAIN).

    Paper: https://arxiv.org/abs/2506.00592 (Tang et al., ICML 2025)

    It is :class:`~sb3_cchain.DoubleDQN`, which is SB3's :class:`~stable_baselines3.DQN` with all of its arguments, plus
    λ·L_churn in the loss of each update, where L_churn is the change that the update before made to the Q-network: the mean
    squared change of all action values on an independent sample of the replay buffer.

    Deviation from the code released with the paper: the reference batch is drawn, and the old outputs are computed, before
    the update instead of by a copy of the network after it.

    :param args: Arguments of DoubleDQN
    :param churn_coef: λ, the weight of the churn loss: a number, ``"auto"`` to keep the churn loss at
        ``target_churn_ratio`` times the TD loss, or ``"auto_50"`` to use 50 (as the released code) instead of 1 during the
        warm-up. With 0 it is DoubleDQN, to the bit.
    :param target_churn_ratio: β, the size of λ·L_churn relative to the TD loss. ``"auto"`` is the paper's 0.01.
    :param churn_warmup: Calls of ``train()`` until λ adapts: gradient updates, where ``gradient_steps=1``
    :param churn_window: Calls of ``train()`` that the running means of both losses go over
    :param churn_coef_min: Least value of λ once it adapts
    :param reset_churn_coef: Whether λ starts over (warm-up included) when ``info["task_id"]`` changes
    :param kwargs: Keyword arguments of DoubleDQN
    :raises ValueError: Naming the churn argument that is out of its range
    """

    def __init__(
        self,
        *args: Any,
        churn_coef: float | str = "auto_50",
        churn_warmup: int = 10_000,
        churn_window: int = 50_000,
        **kwargs: Any,
    ):
        super().__init__(*args, churn_coef=churn_coef, churn_warmup=churn_warmup, churn_window=churn_window, **kwargs)

    def _make_churn_reducer(self) -> ChurnReducer:
        return make_q_reducer(self, self._make_churn_coefficient)

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """
        Update the Q-network, as DoubleDQN does, with churn reduction.

        :param gradient_steps: Number of updates
        :param batch_size: Size of the minibatches and of the reference batches
        """
        if self.churn_reducer.coefficient.is_zero:
            super().train(gradient_steps, batch_size)
        else:
            with reduced_q_churn(self, self.churn_reducer, batch_size):
                super().train(gradient_steps, batch_size)

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
