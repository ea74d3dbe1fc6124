"""Shrink-and-perturb."""

import torch as th

from sb3_cchain.callbacks.training_hooks import TrainingHooks
from sb3_cchain.methods.churn_reducers import forget_references
from sb3_cchain.methods.fresh_policy import fresh_policy, require_policy_optimizer
from sb3_cchain.networks.spectral_norm import settle_spectral_norms
from sb3_cchain.tasks.boundary import TaskBoundary
from sb3_cchain.tasks.callback_tree import require_single
from sb3_cchain.tensorboard.layout import add_charts
from sb3_cchain.validation import check_number

add_charts("Related methods", {"Shrink and perturb: steps": "shrink_and_perturb/n_steps"})


class ShrinkAndPerturb(TaskBoundary):
    r"""
    Moves all trained parameters towards a fresh draw :math:`\phi` of their initialisation,

    .. math:: \theta \leftarrow \alpha \theta + (1 - \alpha) \phi

    after every ``interval`` gradient updates, or at each task switch.

    Shrink-and-perturb (Ash & Adams, NeurIPS 2020, https://arxiv.org/abs/1910.08475) is
    :math:`\theta \leftarrow \lambda \theta + p` with noise :math:`p` each time that new data arrive. The convex combination
    with a fresh network, the step after every update and its default are those of Plasticine
    (https://github.com/RLE-Foundation/Plasticine), whose *soft* variant is that of Juliani & Ash (NeurIPS 2024,
    https://arxiv.org/abs/2405.19153), where it goes together with LayerNorm. Plasticine's *hard* variant, every so many
    iterations, is a greater ``interval``.

    Each step constructs a new policy, which with ``interval=1`` may cost more than the update itself. A step with
    :math:`\alpha^n` after every :math:`n` updates shrinks as much at an n-th of the cost.

    The optimiser's moments and the target network are left alone. With C-CHAIN, a step after an update counts as part of that
    update, also in its churn. At a task switch the reference batch is forgotten, so that churn reduction does not undo the
    step.

    Logged: ``shrink_and_perturb/n_steps``, the steps since ``learn()`` was called.

    :param shrink: α
    :param interval: Gradient updates (minibatches) between two steps; None for one step at each task switch instead,
        for which α should be far smaller, such as 0.5
    :raises ValueError: When ``shrink`` is not between 0 and 1, or ``interval`` neither None nor a positive integer
    :raises TypeError: When training starts, for algorithms with several optimisers, and with ``interval=None`` for an
        environment that is not continual
    """

    def __init__(self, shrink: float = 0.999999, interval: int | None = 1):
        super().__init__()
        check_number("shrink", shrink, 0, 1)
        if interval is not None:
            check_number("interval", interval, 1, integer=True)
        self.shrink = shrink
        self.interval = interval
        self.changes_network = interval is None  # between rollouts
        self._n_updates = 0
        self._hooks = TrainingHooks()

    def _init_callback(self) -> None:
        require_policy_optimizer(self)

    def _on_training_start(self) -> None:
        require_single(self)
        self._hooks.begin(self.model)
        self.n_steps = 0
        if self.interval is None:
            super()._on_training_start()
        else:
            if self.num_timesteps == 0:
                self._n_updates = 0
            self._hooks.after_step(self.model.policy.optimizer, self._after_update)

    def _on_training_end(self) -> None:
        self._hooks.remove()

    def _after_update(self, optimizer: th.optim.Optimizer) -> None:
        assert self.interval is not None
        self._n_updates += 1
        if self._n_updates % self.interval == 0:
            self._shrink_and_perturb()

    def _on_rollout_start(self) -> None:
        if self.interval is None:
            super()._on_rollout_start()

    def _on_task_switch(self) -> None:
        self._shrink_and_perturb()
        if getattr(self.model, "use_sde", False):
            # The rollout's exploration noise has been drawn from the standard deviation that is gone
            self.model.policy.reset_noise(self.model.n_envs)  # type: ignore[operator]
        forget_references(self)

    def _shrink_and_perturb(self) -> None:
        fresh = fresh_policy(self.model)
        # What the optimiser trains: of DQN the Q-network without its target
        with th.no_grad():
            for group, fresh_group in zip(self.model.policy.optimizer.param_groups, fresh.optimizer.param_groups, strict=True):
                for parameter, draw in zip(group["params"], fresh_group["params"], strict=True):
                    if parameter.requires_grad:
                        parameter.mul_(self.shrink).add_(draw, alpha=1 - self.shrink)
        settle_spectral_norms(self.model.policy)
        self.n_steps += 1

    def _on_rollout_end(self) -> None:
        self.logger.record("shrink_and_perturb/n_steps", self.n_steps)
