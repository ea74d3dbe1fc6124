"""C-CHAIN for a stock ``PPO``, for instance one that the stock ``rl_zoo3`` command trains."""

from contextlib import ExitStack
from functools import partial

from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import EventCallback

from sb3_cchain.algorithms.churn_state import keep_churn_state
from sb3_cchain.algorithms.finite_check import FiniteCheck
from sb3_cchain.algorithms.on_policy import PolicyChurnOptions, make_policy_reducer, reduced_churn
from sb3_cchain.churn import make_coefficient
from sb3_cchain.networks.lean_distributions import make_lean
from sb3_cchain.replaced import replaced
from sb3_cchain.tasks.callback_tree import require_single
from sb3_cchain.tasks.signal import TaskSwitch, step_task
from sb3_cchain.tensorboard.overview import add_overview
from sb3_cchain.validation import check_bool


class CChainCallback(FiniteCheck):
    """
    Trains a stock :class:`~stable_baselines3.PPO` as :class:`~sb3_cchain.CChainPPO` trains, for instance from the YAML file
    of the stock ``rl_zoo3``::

        callback:
          - sb3_cchain.CChainCallback:
              target_churn_ratio: 1.0e+4

    PPO calls its callbacks right before each ``train()``; the callback then makes the next ``train()`` reduce churn. The
    history of λ and the reference batch are kept with the model and saved with it. Training with a CChainCallback goes on
    with them, whether the model was loaded or ``learn()`` was called again. The stock ``PPO.load`` loads such a model, too.

    Rewards and observations that are NaN or infinite raise a ``ValueError`` before they are trained on.

    :param churn_coef: As for ``CChainPPO``
    :param target_churn_ratio: As for ``CChainPPO``
    :param churn_warmup: As for ``CChainPPO``
    :param churn_window: As for ``CChainPPO``
    :param churn_coef_min: As for ``CChainPPO``
    :param reset_churn_coef: As for ``CChainPPO``
    :param churn_base_loss: As for ``CChainPPO``
    :param churn_component: As for ``CChainPPO``
    :param churn_reference: As for ``CChainPPO``
    :param churn_batch_size: As for ``CChainPPO``
    :param lean: Whether the model gets lean action distributions, which it keeps: see :func:`~sb3_cchain.make_lean`
    :raises ValueError: Naming the argument that is out of its range; when training starts, for a second CChainCallback in the
        same ``learn()``, and for one that another callback holds
    :raises TypeError: When ``reset_churn_coef`` is not a boolean; when training starts, for a model that is not a stock PPO
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
        churn_reference: str = "independent",
        churn_batch_size: float = 1.0,
        lean: bool = True,
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
        self._make_coefficient(default_target_ratio=1.0)  # raise on bad values now
        check_bool("reset_churn_coef", reset_churn_coef)
        check_bool("lean", lean)
        self._options = PolicyChurnOptions(churn_base_loss, churn_component, churn_reference, churn_batch_size)
        self.lean = lean
        self.reset_churn_coef = reset_churn_coef
        self._task_switch = TaskSwitch()
        # The methods of the model that are replaced from the end of a rollout to train()
        self._replaced = ExitStack()

    def _init_callback(self) -> None:
        if not isinstance(self.model, PPO):
            raise TypeError(f"CChainCallback trains PPO, got {type(self.model).__name__}")
        if hasattr(self.model, "churn_reducer"):
            raise TypeError(f"{type(self.model).__name__} reduces churn by itself; give CChainCallback to a stock PPO")
        self._check_parent()
        add_overview(self.model)
        if self.lean:
            make_lean(self.model)
        self.churn_reducer = make_policy_reducer(self.model, self._make_coefficient)
        past, n_updates = vars(self.model).get("churn_state"), self.model._n_updates
        self._state = keep_churn_state(self.model, self.churn_reducer, self._task_switch, past, n_updates)
        self._state.n_updates = n_updates

    def _check_parent(self) -> None:
        if isinstance(self.parent, EventCallback):
            raise ValueError(
                f"CChainCallback must be called at every rollout, but {type(self.parent).__name__} holds it: "
                "give it to `learn()` beside the other callbacks"
            )

    def _on_training_start(self) -> None:
        self._replaced.close()  # what training that was interrupted left, maybe on another model
        self._check_parent()  # again: SB3 initialises the callbacks in a list before it tells them their parent
        require_single(self)  # two would add the churn loss twice
        # Tells this call of learn() from others
        self._start_time = self.model.start_time

    def _on_step(self) -> bool:
        super()._on_step()
        if self.reset_churn_coef and self._task_switch.happened(step_task(self.model, self.locals["infos"])):
            self.churn_reducer.coefficient.reset()
        return True

    def _on_rollout_end(self) -> None:
        super()._on_rollout_end()
        if self.churn_reducer.coefficient.is_zero:
            return
        train, not_saved = self.model.train, [*self.model._excluded_save_params(), "train", "_excluded_save_params"]

        def train_once() -> None:
            self._replaced.close()  # first, so that this method is gone when train() fails, too
            if self.model.start_time != self._start_time:
                # Left from a learn() that was interrupted between the end of a rollout and train()
                train()
                return
            with reduced_churn(self.model, self.churn_reducer, self._options):
                train()
            self._state.n_updates = self.model._n_updates

        self._replaced.enter_context(replaced(self.model, "train", train_once))
        # A model that is saved at this point must not contain it: after loading, it would train the model that was saved
        self._replaced.enter_context(replaced(self.model, "_excluded_save_params", lambda: not_saved))

    def _on_training_end(self) -> None:
        self._replaced.close()
        super()._on_training_end()
