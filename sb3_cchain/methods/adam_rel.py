"""Adam with relative timesteps."""

from collections.abc import Iterable
from typing import Any

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_cchain.networks.model_optimizers import model_optimizers
from sb3_cchain.tasks.callback_tree import require_every_rollout
from sb3_cchain.tensorboard.layout import add_charts

_NO_STEP_COUNT = "AdamRel needs an optimiser with a step count, as Adam has, got {}"

add_charts("Related methods", {"AdamRel: resets": "adam_rel/n_resets"})


class AdamRel(BaseCallback):
    """
    Adam with relative timesteps: Adam's step count t restarts whenever the objective changes, while its moments go on. The
    first update after that is

    θ ← θ − η · m̂ / (√v̂ + ε) with m̂ = m / (1 − β₁), v̂ = v / (1 − β₂)

    where m and v are the running moments, which include the gradient of this update.

    Paper: https://arxiv.org/abs/2412.17113 (Ellis et al., NeurIPS 2024). As in the paper, the objective changes

    - with on-policy algorithms at each rollout: the count is 0 when ``train()`` begins;
    - with DQN (and sb3-contrib's QR-DQN) when the target network was updated, every ``target_update_interval`` environment
      steps: the count is 0 at the first update after that.

    It works with any optimiser that has Adam's step count (Adam, AdamW, Adamax, RAdam, NAdam), also inside wrappers. Because
    it is a callback, SB3's ``eps=1e-5`` for Adam stays.

    Logged: ``adam_rel/n_resets``, how often the count was set to 0.

    It costs next to nothing. Neither the method nor the class has arguments.

    It raises a ``TypeError`` for other algorithms, and for optimisers without a step count.
    """

    def __init__(self) -> None:
        super().__init__()
        self.n_resets = 0

    def _init_callback(self) -> None:
        model = self.model
        if not (isinstance(model, OnPolicyAlgorithm) or hasattr(model, "_n_calls")):  # DQN counts target updates with it
            raise TypeError(f"AdamRel is for on-policy algorithms and DQN, got {type(model).__name__}")
        for optimizer in model_optimizers(model).values():
            # RMSprop counts steps too, but does not use the count
            if not all("betas" in group for group in optimizer.param_groups):
                raise TypeError(_NO_STEP_COUNT.format(type(optimizer).__name__))
        self._n_target_updates = self._count_target_updates()

    def _on_training_start(self) -> None:
        require_every_rollout(self)

    def _count_target_updates(self) -> int:
        model: Any = self.model
        if isinstance(model, OnPolicyAlgorithm):
            return 0
        return model._n_calls // max(model.target_update_interval // model.n_envs, 1)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        previous, self._n_target_updates = self._n_target_updates, self._count_target_updates()
        if isinstance(self.model, OnPolicyAlgorithm) or self._n_target_updates != previous:
            self.n_resets += any([reset_step_count(optimizer) for optimizer in model_optimizers(self.model).values()])
        self.logger.record("adam_rel/n_resets", self.n_resets)


def reset_step_count(optimizer: th.optim.Optimizer, parameters: Iterable[th.Tensor] | None = None) -> bool:
    """
    Set Adam's step count to 0.

    :param optimizer: An optimiser
    :param parameters: Those whose step count it is; None for all
    :return: Whether there was something to set, which is so from its first update on
    :raises TypeError: When it has made an update and does not count updates
    """
    keys = [key for key in optimizer.state if th.is_tensor(key)] if parameters is None else parameters
    states = [optimizer.state[key] for key in keys if key in optimizer.state]
    for state in states:
        if "step" not in state:
            raise TypeError(_NO_STEP_COUNT.format(type(optimizer).__name__))
        if th.is_tensor(state["step"]):
            state["step"].zero_()
        else:
            state["step"] = 0
        if "mu_product" in state:  # NAdam's count of the first moment
            state["mu_product"].fill_(1)
    return bool(states)
