"""Logs how much updates change the network's outputs on data that they were not made for."""

from collections import deque
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_cchain.analysis.model_outputs import ModelOutputs, churn, known_kind, model_outputs
from sb3_cchain.analysis.reference_batch import map_batch, sample_batch
from sb3_cchain.callbacks.training_hooks import TrainingHooks
from sb3_cchain.checkpoint.random_state import unchanged_random_state
from sb3_cchain.networks.algorithm_kinds import is_trpo
from sb3_cchain.networks.batch_outputs import Batch
from sb3_cchain.networks.model_optimizers import model_optimizers
from sb3_cchain.tasks.callback_tree import require_every_rollout, require_unchanged_network
from sb3_cchain.tensorboard.overview import add_overview
from sb3_cchain.validation import check_number


class ChurnMonitor(BaseCallback):
    r"""
    Logs churn: how far an update moves the outputs of the network,
    :math:`C_f(x, \theta, \Delta_\theta) = f_{\theta + \Delta_\theta}(x) - f_\theta(x)`, Tang et al. (ICML 2025),
    https://arxiv.org/abs/2506.00592. It works with any algorithm of Stable-Baselines3 and sb3-contrib, with churn
    reduction and without. Training is the same to the bit with and without it.

    Every ``interval`` gradient updates, a window of ``n_updates`` updates is measured on two reference batches:

    - ``fixed``: drawn once, when the first window begins, and kept with the model (``model.churn_monitor_batch``), so that
      training that is resumed goes on with the same one;
    - ``fresh``: drawn when the window begins, from the rollout being trained on or from the replay buffer. It may hold samples
      of the updates' own minibatches. On-policy an update's minibatch is
      ``(size of a minibatch) / (size of a rollout)`` of it: 1 of 25 in the Gym Control settings, 1 of 32 with PPO's defaults,
      all with A2C. Off-policy it is next to nothing.

    Logged of each, as ``churn_monitor/fixed/...`` and ``churn_monitor/fresh/...``, averaged over the windows between two logs:

    - ``policy_churn``: :math:`KL(\pi_{old} \,\|\, \pi_{new})` of categorical policies, several sub-actions being summed; the
      mean squared difference of the action means of continuous ones (of SAC, TQC, CrossQ, TD3 and DDPG of the deterministic
      actions, between -1 and 1). Not for DQN and QRDQN, whose policy is greedy, and not for ARS with discrete actions.
    - ``value_churn``: mean absolute change of the state values (PPO, A2C, TRPO), of all action values (DQN, QRDQN), or of all
      critics' values of the batch's actions (SAC, TQC, CrossQ, TD3, DDPG). Not for ARS.
    - ``greedy_action_changes``: share of the states whose most probable or most valuable action, or any of its sub-actions,
      changed. Not for continuous actions.

    An update begins with the step of the optimiser and ends when the next one begins or ``train()`` is over. With separate
    optimisers of actor and critic, it begins with the critic's step and includes the actor's step that follows. ``train()`` is
    over when the next rollout starts. Put the monitor before callbacks that change the network then (ReDo, Oracle), or their
    change counts too. A window of several updates may span several calls of ``train()``; what happens between them counts.

    TRPO, whose policy no optimiser changes, and ARS are measured once per iteration instead, over the whole of its training,
    and ``interval`` has no effect; ARS on the last observations of its candidates.

    The networks are measured in evaluation mode. Recurrent policies take each observation as the first of an episode; maskable
    ones have the batch's action masks.

    The fixed batch makes a saved model larger by its size, with images by some megabytes; with ``VecNormalize`` it keeps the
    statistics of the moment when it was drawn.

    A window costs a forward pass of each batch at its beginning and at its end: with the defaults 1 to 4 % of the training
    time (PPO in Gym Control and CartPole, DQN in MinAtar and CartPole, on a CPU); with PPO's IMPALA network, whose features
    are computed for policy and value, about 5 % of the operations of ``train()``. The default interval is a prime: one that
    shares a divisor with the number of minibatches of an epoch, or with the ``policy_delay`` of TD3, meets the same few of
    them again and again.

    :param interval: Gradient updates from the beginning of a window to that of the next
    :param n_updates: Gradient updates in a window; 1 as in the paper
    :param batch_size: Observations in each reference batch; on-policy no more than in a rollout. The fixed batch of a model
        that has one stays.
    :raises ValueError: Naming the argument that is out of its range; when training starts, for ARS with ``async_eval``, whose
        observations are not seen
    :raises TypeError: When training starts, for an algorithm that is not known
    """

    def __init__(self, interval: int = 101, n_updates: int = 1, batch_size: int = 256):
        super().__init__()
        check_number("interval", interval, 1, integer=True)
        check_number("n_updates", n_updates, 1, interval, integer=True)
        check_number("batch_size", batch_size, 1, integer=True)
        self.interval = interval
        self.n_updates = n_updates
        self.batch_size = batch_size
        # Windows go on in phase when `learn()` is called again
        self._n_updates_seen = 0
        # The open window: each batch with its outputs at the beginning, by name, and the number of updates until it ends
        self._window: dict[str, tuple[Batch, ModelOutputs]] = {}
        self._n_missing = 0
        # On the model until the next rollout starts or ends
        self._hooks = TrainingHooks()
        self._observations: deque[NDArray[Any]] = deque()

    def _init_callback(self) -> None:
        known_kind(self.model)  # raises for an algorithm that is not known

    def _on_training_start(self) -> None:
        require_every_rollout(self)
        require_unchanged_network(self)
        self._hooks.begin(self.model)
        self._window = {}  # may be left from training that was interrupted
        add_overview(self.model)
        if self.locals.get("async_eval") is not None:
            raise ValueError("ChurnMonitor does not see the observations of ARS with `async_eval`: set it to None")

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self._hooks.remove()
        optimizer = _leading_optimizer(self.model)
        if optimizer is None:
            self._open_window(0)
        else:
            # For train() alone
            self._hooks.before_step(optimizer, self._before_update)

    def _on_rollout_start(self) -> None:
        # train() is over
        self._hooks.remove()
        self._close_window_if_over()
        if not isinstance(self.model, (OnPolicyAlgorithm, OffPolicyAlgorithm)):
            # Algorithms that keep no observations (ARS)
            self._observations = deque(maxlen=self.batch_size)
            self._hooks.after_call(self.training_env, "step_wait", lambda step: self._observations.extend(np.array(step[0])))

    def _on_training_end(self) -> None:
        self._hooks.remove()
        self._close_window_if_over()
        self._window = {}

    def _before_update(self, optimizer: th.optim.Optimizer) -> None:
        self._close_window_if_over()
        if self._n_updates_seen % self.interval == 0:
            self._open_window(self.n_updates)
        self._n_updates_seen += 1
        self._n_missing -= 1

    def _open_window(self, n_updates: int) -> None:
        model: Any = self.model
        with unchanged_random_state():
            # Other numbers than those that training draws next, whose minibatch would be a part of the batch
            np.random.seed(np.random.randint(2**32, dtype=np.uint32))
            fresh = self._sample_batch()
            if not hasattr(model, "churn_monitor_batch"):
                model.churn_monitor_batch = map_batch(lambda tensor: tensor.cpu().numpy(), self._sample_batch())
            fixed = map_batch(lambda array: th.as_tensor(array, device=model.device), model.churn_monitor_batch)
            self._window = {name: (batch, model_outputs(model, batch)) for name, batch in (("fixed", fixed), ("fresh", fresh))}
        self._n_missing = n_updates

    def _sample_batch(self) -> Batch:
        if isinstance(self.model, (OnPolicyAlgorithm, OffPolicyAlgorithm)):
            return sample_batch(self.model, self.batch_size)
        return {"observations": th.as_tensor(np.array(self._observations), device=self.model.device)}

    def _close_window_if_over(self) -> None:
        if not self._window or self._n_missing > 0:
            return
        with unchanged_random_state():
            for batch_name, (batch, old) in self._window.items():
                for name, value in churn(old, model_outputs(self.model, batch)).items():
                    self.logger.record_mean(f"churn_monitor/{batch_name}/{name}", value)
        self._window = {}


def _leading_optimizer(model: BaseAlgorithm) -> th.optim.Optimizer | None:
    """
    :param model: A model
    :return: The optimiser whose steps begin the updates: the critic's, when actor and critic have separate ones. None when the
        optimiser, if any, does not make all of the changes.
    """
    if is_trpo(model):
        return None
    optimizers = model_optimizers(model)
    return optimizers.get("critic", optimizers.get(""))
