"""Exploration that begins again at each task: by the exploration rate, the standard deviation or the entropy bonus."""

from collections.abc import Callable
from typing import Any

import torch as th
from stable_baselines3 import DQN
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_cchain.callbacks.training_hooks import TrainingHooks
from sb3_cchain.methods.churn_reducers import forget_references
from sb3_cchain.networks.algorithm_kinds import is_trpo
from sb3_cchain.networks.compiled import uncompiled
from sb3_cchain.replaced import replaced
from sb3_cchain.tasks.boundary import TaskBoundary
from sb3_cchain.validation import check_number


class ExplorationRateRestart(TaskBoundary):
    """
    Raises the exploration rate ε of DQN at each task switch, from where it goes down linearly again.

    The first task has the schedule of the model, ``exploration_initial_eps`` and so on. Later tasks have this one, and stay at
    its end. The step of the last switch is kept as ``model.exploration_restart``.

    :param initial_eps: ε at the beginning of each later task
    :param final_eps: ε from ``n_steps`` after the switch on; None for the model's ``exploration_final_eps``
    :param n_steps: Environment steps from the one to the other
    :raises ValueError: Naming the argument that is out of its range
    :raises TypeError: When training starts, for an algorithm that is not DQN
    """

    model: DQN

    def __init__(self, initial_eps: float = 1.0, final_eps: float | None = None, n_steps: int = 10_000):
        super().__init__()
        check_number("initial_eps", initial_eps, 0, 1)
        if final_eps is not None:
            check_number("final_eps", final_eps, 0, 1)
        check_number("n_steps", n_steps, 1, integer=True)
        self.initial_eps = initial_eps
        self.final_eps = final_eps
        self.n_steps = n_steps
        self._hooks = TrainingHooks()

    def _init_callback(self) -> None:
        # QR-DQN of sb3-contrib has it, too
        if not hasattr(self.model, "exploration_schedule"):
            raise TypeError(f"ExplorationRateRestart is for DQN, got {type(self.model).__name__}")

    def _on_training_start(self) -> None:
        super()._on_training_start()
        if self.num_timesteps == 0 or not hasattr(self.model, "exploration_restart"):
            self.model.exploration_restart = None  # type: ignore[attr-defined]
        self._hooks.begin(self.model)
        # Where DQN sets it by its own schedule
        self._hooks.after_call(self.model, "_on_step", self._set_rate)

    def _on_task_switch(self) -> None:
        self.model.exploration_restart = self.num_timesteps  # type: ignore[attr-defined]
        self.model.exploration_rate = self.initial_eps

    def _set_rate(self, _: Any) -> None:
        begin = self.model.exploration_restart  # type: ignore[attr-defined]
        if begin is not None:
            final = self.model.exploration_final_eps if self.final_eps is None else self.final_eps
            self.model.exploration_rate = _between(self.initial_eps, final, (self.num_timesteps - begin) / self.n_steps)

    def _on_training_end(self) -> None:
        self._hooks.remove()


class LogStdRestart(TaskBoundary):
    """
    Sets ``log_std`` of a Gaussian policy back at each task switch, the logarithm of the standard deviation of its actions.

    The means stay. C-CHAIN, where the model has it, forgets its reference batch, so that it does not undo this.

    :param log_std: The value; None for the policy's ``log_std_init``
    :raises ValueError: When it is not a number
    :raises TypeError: When training starts, for a policy whose standard deviation is not a parameter (PPO and A2C with ``Box``
        actions have such a one)
    """

    changes_network = True  # between rollouts

    model: OnPolicyAlgorithm

    def __init__(self, log_std: float | None = None):
        super().__init__()
        if log_std is not None:
            check_number("log_std", log_std)
        self.log_std = log_std

    def _init_callback(self) -> None:
        if not isinstance(getattr(self.model.policy, "log_std", None), th.nn.Parameter):
            name, space = type(self.model).__name__, self.model.action_space
            raise TypeError(f"LogStdRestart is for PPO and A2C with Box actions, got {name} with {space}")

    def _on_task_switch(self) -> None:
        policy: Any = uncompiled(self.model.policy)
        with th.no_grad():
            policy.log_std.fill_(policy.log_std_init if self.log_std is None else self.log_std)
        if self.model.use_sde:
            policy.reset_noise(self.model.n_envs)
        forget_references(self)


class EntropyBonusRestart(TaskBoundary):
    """
    Raises ``ent_coef`` of PPO or A2C at each task switch, from where it goes down linearly to the model's own.

    The first task has the model's own, which the model has in rollouts, too: it is raised for ``train()`` only. The step of
    the last switch is kept as ``model.ent_coef_restart``.

    :param ent_coef: The coefficient at the beginning of each later task, above the model's own
    :param n_steps: Environment steps until it is the model's own again
    :raises ValueError: Naming the argument that is out of its range. When training starts, for an ``ent_coef`` that is not
        above the model's own
    :raises TypeError: When training starts, for an algorithm that is not on-policy
    """

    model: OnPolicyAlgorithm

    def __init__(self, ent_coef: float = 0.01, n_steps: int = 10_000):
        super().__init__()
        check_number("ent_coef", ent_coef, 0)
        check_number("n_steps", n_steps, 1, integer=True)
        self.ent_coef = ent_coef
        self.n_steps = n_steps
        self._hooks = TrainingHooks()

    def _init_callback(self) -> None:
        # TRPO has the argument of its base class and does not use it
        if not isinstance(self.model, OnPolicyAlgorithm) or is_trpo(self.model):
            raise TypeError(f"EntropyBonusRestart is for PPO and A2C, got {type(self.model).__name__}")
        if self.ent_coef <= self.model.ent_coef:
            raise ValueError(
                f"EntropyBonusRestart raises `ent_coef`: give one above the model's own, {self.model.ent_coef}; "
                f"got {self.ent_coef}"
            )

    def _on_training_start(self) -> None:
        super()._on_training_start()
        model: Any = self.model
        self._hooks.begin(model)
        self._hooks.around_call(model, "train", self._train)
        if self.num_timesteps == 0 or not hasattr(model, "ent_coef_restart"):
            model.ent_coef_restart = None

    def _on_task_switch(self) -> None:
        self.model.ent_coef_restart = self.num_timesteps  # type: ignore[attr-defined]

    def _on_rollout_start(self) -> None:
        super()._on_rollout_start()
        self._rollout_start = self.num_timesteps

    def _train(self, train: Callable[[], None]) -> None:
        model: Any = self.model
        if model.ent_coef_restart is None:
            train()
            return
        share = (self._rollout_start - model.ent_coef_restart) / self.n_steps
        with replaced(model, "ent_coef", _between(self.ent_coef, model.ent_coef, share)):
            train()

    def _on_training_end(self) -> None:
        self._hooks.remove()


def _between(initial: float, final: float, share: float) -> float:
    return initial + (final - initial) * min(share, 1.0)
