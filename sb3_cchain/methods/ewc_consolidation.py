"""What elastic weight consolidation does at a task switch."""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import DQN, SAC
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_cchain.checkpoint.random_state import unchanged_random_state
from sb3_cchain.methods.ewc import EWC
from sb3_cchain.methods.optimizer_wrapper import nested_wrappers
from sb3_cchain.networks.algorithm_kinds import is_recurrent
from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.networks.evaluation_mode import evaluation_mode
from sb3_cchain.networks.model_optimizers import model_optimizers
from sb3_cchain.tasks.boundary import TaskBoundary
from sb3_cchain.tensorboard.layout import add_charts
from sb3_cchain.validation import check_bool, check_number

add_charts("Related methods", {"EWC: tasks consolidated": "ewc/n_tasks"})


class EWCConsolidation(TaskBoundary):
    r"""
    Tells the optimiser :class:`EWC` at each task switch which parameters mattered in the task that ended.

    The Fisher information of the outputs is estimated from ``n_samples`` observations :math:`s` of that task and one draw
    :math:`y` of the outputs for each,

    .. math:: F_i = \frac{1}{N} \sum_s \left(\frac{\partial \log p(y \mid s)}{\partial \theta_i}\right)^2

    - The action of a policy is a draw of its distribution (of SAC, before squashing), as in Kirkpatrick et al.
    - Values are the means of Gaussians of standard deviation 1, as in Continual World; ``values=False`` leaves them out, which
      is Continual World's default. The draw is the mean ± 1, which gives the same expectation as a Gaussian draw, with less
      noise.

    The observations are equally spaced: over the last rollout of on-policy algorithms, and over the part of the task that
    the replay buffer still holds. Random numbers leave no trace in the training that goes on.

    It costs ``n_samples`` backward passes of one observation per switch. See :class:`Oracle` for when it acts.

    Logged: ``ewc/n_tasks``, the tasks that were consolidated since ``learn()`` was called.

    :param n_samples: Observations per task. Continual World's code takes 2560.
    :param values: Whether the values' outputs count; must be True for DQN, which has no others
    :raises TypeError: When ``values`` is not a boolean; when training starts, when no optimiser is an :class:`EWC`, for
        algorithms other than PPO, A2C, DQN and SAC, and for an environment that is not continual
    :raises ValueError: When ``n_samples`` is not a positive integer; when training starts, for DQN with ``values=False``
    """

    model: OnPolicyAlgorithm | DQN | SAC

    def __init__(self, n_samples: int = 256, values: bool = True):
        super().__init__()
        check_number("n_samples", n_samples, 1, integer=True)
        check_bool("values", values)
        self.n_samples = n_samples
        self.values = values

    def _init_callback(self) -> None:
        name = type(self.model).__name__
        if not isinstance(self.model, (OnPolicyAlgorithm, DQN, SAC)) or is_recurrent(self.model):
            raise TypeError(f"EWCConsolidation is for PPO, A2C, DQN and SAC, got {name}")
        if isinstance(self.model, DQN) and not self.values:
            raise ValueError("`values` must be True for DQN, got False")
        if not self._optimizers():
            raise TypeError(
                "EWCConsolidation needs the optimiser EWC, as policy_kwargs=dict(optimizer_class=EWC), "
                f"got {', '.join(type(each).__name__ for each in model_optimizers(self.model).values())}"
            )
        self._observations: Any = None

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self.n_tasks = 0
        if self.num_timesteps == 0 or not hasattr(self.model, "ewc_task_start"):
            self.model.ewc_task_start = 0  # type: ignore[union-attr]

    def _optimizers(self) -> list[EWC]:
        wrappers = [wrapper for each in model_optimizers(self.model).values() for wrapper in nested_wrappers(each)]
        return [wrapper for wrapper in wrappers if isinstance(wrapper, EWC)]

    def _on_rollout_end(self) -> None:
        if isinstance(self.model, OnPolicyAlgorithm):  # the next rollout overwrites them
            buffer = self.model.rollout_buffer
            self._observations = self._spaced(buffer.observations, buffer.buffer_size)
        self.logger.record("ewc/n_tasks", self.n_tasks)

    def _on_task_switch(self) -> None:
        if not isinstance(self.model, OnPolicyAlgorithm):
            self._observations = self._replayed()
        self.model.ewc_task_start = self.num_timesteps  # type: ignore[union-attr]
        if self._observations is None:
            self.logger.warn("EWCConsolidation has no observation of the task that ended, which is not consolidated")
            return
        with unchanged_random_state():
            self._consolidate(self._observations)
        self.n_tasks += 1

    def _replayed(self) -> Any:
        model: Any = self.model
        buffer = model.replay_buffer
        n_held = min((self.num_timesteps - model.ewc_task_start) // model.n_envs, buffer.size())
        if n_held == 0:
            return None
        return buffer._normalize_obs(self._spaced(buffer.observations, n_held, buffer.pos - n_held), model._vec_normalize_env)

    def _spaced(self, arrays: Any, n_steps: int, first: int = 0) -> Any:
        """Observations at equal distances, ``(n_samples, ...)``, from arrays ``(size, n_envs, ...)``."""
        if isinstance(arrays, dict):
            return {key: self._spaced(array, n_steps, first) for key, array in arrays.items()}
        n_envs = self.model.n_envs
        at = np.linspace(0, n_steps * n_envs - 1, min(self.n_samples, n_steps * n_envs)).astype(int)
        return arrays[(first + at // n_envs) % len(arrays), at % n_envs]

    def _consolidate(self, observations: Any) -> None:
        optimizers = self._optimizers()
        fisher = {p: th.zeros_like(p) for optimizer in optimizers for p in optimizer.parameters()}
        trained = [parameter for parameter in fisher if parameter.requires_grad]
        samples = _one_by_one(observations, self.model.device)
        with evaluation_mode(self.model.policy):
            for observation in samples:
                gradients = th.autograd.grad(self._log_probability(observation), trained, allow_unused=True)
                for parameter, gradient in zip(trained, gradients, strict=True):
                    if gradient is not None:
                        fisher[parameter] += gradient.square()
        for optimizer in optimizers:
            optimizer.consolidate([fisher[parameter] / len(samples) for parameter in optimizer.parameters()])

    def _log_probability(self, observation: Any) -> th.Tensor:
        """Of a draw of the outputs, up to a constant."""
        policy = uncompiled(self.model.policy)
        if isinstance(self.model, DQN):
            return _of_values(policy.q_net(observation))
        if isinstance(self.model, SAC):
            mean, log_std, kwargs = policy.actor.get_action_dist_params(observation)
            action = policy.actor.action_dist.actions_from_params(mean, log_std, **kwargs).detach()
            # With gSDE, `log_std` is of the noise's weights, not of the actions
            log_probability = _of_draw(policy.actor.action_dist.distribution)
            return log_probability + _of_values(th.cat(policy.critic(observation, action))) * self.values
        log_probability = _of_draw(policy.get_distribution(observation))
        return log_probability + _of_values(policy.predict_values(observation)) * self.values


def _one_by_one(observations: Any, device: th.device) -> list[Any]:
    """Batches of one observation."""
    if isinstance(observations, dict):
        split = {key: _one_by_one(array, device) for key, array in observations.items()}
        return [dict(zip(split, values, strict=True)) for values in zip(*split.values(), strict=True)]
    return list(th.as_tensor(observations, device=device).split(1))


def _of_draw(distribution: Any) -> th.Tensor:
    return distribution.log_prob(distribution.sample().detach()).sum()


def _of_values(values: th.Tensor) -> th.Tensor:
    signs = 2 * th.randint_like(values, 2) - 1
    return (signs * values).sum()
