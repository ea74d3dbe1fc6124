"""Double DQN with churn reduction."""

from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_cchain.algorithms.churn_algorithm import ChurnAlgorithm
from sb3_cchain.algorithms.double_dqn import DoubleDQN
from sb3_cchain.algorithms.q_network import QValues, finite_td_loss, joint_pass, log_q_churn
from sb3_cchain.algorithms.reference_batches import REFERENCES
from sb3_cchain.algorithms.replay_observations import kept_minibatches, sample_observations
from sb3_cchain.churn import ChurnReducers
from sb3_cchain.churn.reducer import Observations
from sb3_cchain.networks.evaluation_mode import evaluation_mode, has_training_mode
from sb3_cchain.validation import check_choice


class CChainDQN(ChurnAlgorithm, DoubleDQN):
    """
    (Double) Deep Q-Network with Continual Churn Approximated Reduction (C-CHAIN).

    Paper: https://arxiv.org/abs/2506.00592 (Tang et al., ICML 2025)

    It is :class:`~sb3_cchain.algorithms.DoubleDQN`, which is SB3's :class:`~stable_baselines3.DQN` with all of its arguments,
    plus λ·L_churn in the loss of each update. L_churn is the change that the previous update made to the Q-network: the mean
    squared change of all action values on another sample of the replay buffer than the minibatch of that update.

    Deviation from the code released with the paper: the reference batch is drawn, and the old outputs are computed, before
    the update instead of by a copy of the network after it.

    The defaults do not depend on the scale of rewards: λ adapts from the first updates on. The values of the released code for
    MinAtar, ``"auto_50"``, a warm-up of 10 000 and a window of 50 000 updates, are in the YAML file of the package. On other
    tasks a λ of 50 can be so strong that nothing is learned.

    :param args: Arguments of DoubleDQN
    :param churn_target: What is held still: ``"value"``, and ``"auto"`` is the same, because DQN has no policy of its own
    :param churn_coef: λ, the weight of the churn loss: a number, ``"auto"`` to keep the churn loss at
        ``target_churn_ratio`` times the TD loss, or ``"auto_50"`` to use 50 (as the released code) instead of 1 during the
        warm-up. With 0 it is DoubleDQN, to the bit.
    :param target_churn_ratio: β, the size of λ·L_churn relative to the TD loss. ``"auto"`` is the paper's 0.01.
    :param churn_warmup: Gradient updates until λ adapts; with 0 it adapts after the first churn loss
    :param churn_window: Gradient updates that the running means of both losses cover
    :param churn_coef_min: Least value of λ once it adapts
    :param reset_churn_coef: Whether λ starts over (warm-up included) when the task switches
    :param churn_reference: Where reference batches are taken from, always drawn independently of the minibatch whose update
        they measure: ``"independent"`` for a sample of their own, ``"next"`` for the minibatch that is trained on next, which
        costs less because its outputs are needed anyway. Minibatches are then drawn one update ahead.
    :param kwargs: Keyword arguments of DoubleDQN
    :raises ValueError: Naming the churn argument that is out of its range
    """

    # With `churn_reference="next"`, the minibatch that was drawn for the next update
    _next_minibatch: ReplayBufferSamples | None

    def __init__(
        self,
        *args: Any,
        churn_reference: str = "independent",
        **kwargs: Any,
    ):
        self.churn_reference = churn_reference
        super().__init__(*args, **kwargs)

    def _check_arguments(self) -> None:
        super()._check_arguments()
        check_choice("churn_reference", self.churn_reference, REFERENCES)

    def _make_churn_reducers(self) -> ChurnReducers:
        self._next_minibatch = None  # it waited with the reducer that is replaced
        return super()._make_churn_reducers()

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """
        Update the Q-network, as DoubleDQN does, with churn reduction in the loss.

        :param gradient_steps: Number of gradient updates
        :param batch_size: Minibatch size
        :raises ValueError: When the loss is NaN or infinite. The parameters have not been updated.
        """
        self.churn_state.weights = None
        assert self.replay_buffer is not None
        # Not ChurnAlgorithm's, because `_loss()` has the churn loss in it
        with kept_minibatches(self.replay_buffer):
            DoubleDQN.train(self, gradient_steps, batch_size)

    def _excluded_save_params(self) -> list[str]:
        # It belongs to the replay buffer, which is saved apart
        return [*super()._excluded_save_params(), "_next_minibatch"]

    def _loss(self, replay_data: ReplayBufferSamples, batch_size: int) -> tuple[th.Tensor, float]:
        """
        :param replay_data: The minibatch that was just drawn. With ``churn_reference="next"`` it waits for the next update,
            unless none was waiting for this one
        :param batch_size: Size of the reference batch
        :return: The TD loss plus λ·L_churn, and the value of the TD loss, which is logged
        """
        reducer = self.churn_reducer
        if reducer.coefficient.is_zero:
            return super()._loss(replay_data, batch_size)

        # Independent of the minibatch. It waits for the next update, which measures on it what this update changes
        assert self.replay_buffer is not None
        next_minibatch = None
        if self.churn_reference == "independent":
            reference = sample_observations(self.replay_buffer, batch_size, self._vec_normalize_env)
        else:
            replay_data, next_minibatch = self._in_turn(replay_data, batch_size)
            reference = next_minibatch.observations
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
        self._next_minibatch = next_minibatch
        return loss, td_loss_value

    def _in_turn(self, drawn: ReplayBufferSamples, batch_size: int) -> tuple[ReplayBufferSamples, ReplayBufferSamples]:
        """
        :param drawn: The minibatch that was just drawn
        :param batch_size: Size of a further one
        :return: The minibatch to train on, and the next one
        """
        # Whoever made the reducer forget its reference batch, such as Oracle, may have emptied the replay buffer, too
        if self._next_minibatch is not None and self.churn_reducer.reference is not None:
            return self._next_minibatch, drawn
        self.churn_reducer.forget_reference()  # a saved model's: the minibatch that it belongs to is not saved
        assert self.replay_buffer is not None
        return drawn, self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)

    def _all_q_values(self, replay_data: ReplayBufferSamples, reference: Observations) -> QValues:
        previous = self.churn_reducer.reference
        if not has_training_mode(self.q_net):
            if self.churn_reference == "next" and previous is not None:
                # It is this minibatch, whose values are computed anyway
                values = joint_pass(self.q_net, replay_data, reference, None, self.double_q)
                return values._replace(previous_reference=values.current)
            return joint_pass(self.q_net, replay_data, reference, previous, self.double_q)
        # Reference batches go through the network as it acts in the environment: they do not move the running statistics
        # of BatchNorm, and the noise of dropout is no churn
        current, next_values = self._q_values(replay_data)
        with evaluation_mode(self.q_net):
            previous_values = None if previous is None else self.q_net(previous)
            with th.no_grad():
                return QValues(current, next_values, self.q_net(reference), previous_values)
