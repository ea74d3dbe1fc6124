"""C-CHAIN for a stock ``PPO``: the form in which the stock ``rl_zoo3`` command reaches it."""

from functools import partial

from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cchain.algorithms.on_policy import check_choices, make_policy_reducer, reduced_churn
from sb3_cchain.churn import make_coefficient
from sb3_cchain.tasks.sync import TaskSwitch
from sb3_cchain.tensorboard.overview import add_overview

# Methods of the model, from the end of a rollout to train()
REPLACED = ("train", "_excluded_save_params")


class CChainCallback(BaseCallback):
    """
    Trains a stock :class:`~stable_baselines3.PPO` as :class:`~sb3_cchain.CChainPPO` trains, for instance from the YAML file
    of the stock ``rl_zoo3``::

        callback:
          - sb3_cchain.CChainCallback:
              target_churn_ratio: 1.0e+4

    PPO calls its callbacks right before each ``train()``, whose next call is then made with churn reduction. Unlike with
    ``CChainPPO``, the saved model does not hold the history of λ: training resumed from it warms up again.

    :param churn_coef: As for ``CChainPPO``
    :param target_churn_ratio: As for ``CChainPPO``
    :param churn_warmup: As for ``CChainPPO``
    :param churn_window: As for ``CChainPPO``
    :param churn_coef_min: As for ``CChainPPO``
    :param reset_churn_coef: As for ``CChainPPO``
    :param churn_base_loss: As for ``CChainPPO``
    :param churn_component: As for ``CChainPPO``
    :raises ValueError: Naming the argument that is out of its range
    """

    model: PPO

    def __init__(
        self,
        churn_coef: float | str = "auto",
        target_churn_ratio: float | str = "auto",
        churn_warmup: int = 10,
        churn_window: int = 50,
        churn_coef_min: float = 0.0,
        reset_churn_coef: bool = False,
        churn_base_loss: str = "actor",
        churn_component: str = "full",
    ):
        super().__init__()
        self._make_coefficient = partial(
            make_coefficient,
            churn_coef,
            target_churn_ratio,
            warmup=churn_warmup,
            window=churn_window,
            minimum=churn_coef_min,
        )
        self._make_coefficient(default_target_ratio=1.0)  # bad values shall fail now
        check_choices(churn_base_loss, churn_component)
        self.churn_base_loss = churn_base_loss
        self.churn_component = churn_component
        self.reset_churn_coef = reset_churn_coef
        self._task_switch = TaskSwitch()
        self._reduced_model: PPO | None = None

    def _init_callback(self) -> None:
        if not isinstance(self.model, PPO):
            raise TypeError(f"CChainCallback trains PPO, got {type(self.model).__name__}")
        if hasattr(self.model, "churn_reducer"):
            raise TypeError(f"{type(self.model).__name__} reduces churn by itself; give CChainCallback to a stock PPO")
        add_overview(self.model)
        # Another learn() of the same model goes on with the same λ
        if self._reduced_model is not self.model:
            self._reduced_model = self.model
            self.churn_reducer = make_policy_reducer(self.model, self._make_coefficient)

    def _on_step(self) -> bool:
        if self.reset_churn_coef and self._task_switch.happened(self.locals["infos"]):
            self.churn_reducer.coefficient.reset()
        return True

    def _on_rollout_end(self) -> None:
        if self.churn_reducer.coefficient.is_zero:
            return
        train, not_saved = self.model.train, [*self.model._excluded_save_params(), *REPLACED]

        def train_once() -> None:
            self._on_training_end()  # first, so that it is gone when train() fails, too
            with reduced_churn(self.model, self.churn_reducer, self.churn_base_loss, self.churn_component):
                train()

        self.model.train = train_once  # type: ignore[method-assign]
        # A model that is saved at this point must not take it along: loaded, it would train the model that it came from
        self.model._excluded_save_params = lambda: not_saved  # type: ignore[method-assign]

    def _on_training_end(self) -> None:
        for name in REPLACED:
            vars(self.model).pop(name, None)
