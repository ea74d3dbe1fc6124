"""C-CHAIN for a stock model, for instance one that the stock ``rl_zoo3`` command trains."""

from collections.abc import Callable
from typing import Any

from stable_baselines3 import PPO
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_cchain.algorithms.churn_state import keep_churn_state
from sb3_cchain.algorithms.churn_targets import ChurnArguments, churn_kind
from sb3_cchain.algorithms.finite_check import FiniteCheck
from sb3_cchain.algorithms.on_policy import PolicyChurnOptions
from sb3_cchain.algorithms.reduced_churn import reduced_churn
from sb3_cchain.callbacks.training_hooks import TrainingHooks
from sb3_cchain.churn import ChurnReducer, ChurnReducers
from sb3_cchain.networks.algorithm_kinds import is_trpo
from sb3_cchain.networks.lean_distributions import make_lean
from sb3_cchain.tasks.callback_tree import refuse_event, require_every_rollout, require_single
from sb3_cchain.tasks.signal import TaskSwitch, step_task
from sb3_cchain.tensorboard.overview import add_overview
from sb3_cchain.validation import check_bool


class CChainCallback(FiniteCheck):
    """
    Reduces churn in a stock model of SB3 or sb3-contrib as the algorithm of this package with its name does, such as
    :class:`~sb3_cchain.algorithms.CChainPPO`; DQN stays DQN, where ``CChainDQN`` is Double DQN by default. For instance from
    the YAML file of the stock ``rl_zoo3``::

        callback:
          - sb3_cchain.CChainCallback:
              target_churn_ratio: 1.0e+4

    It is for PPO, A2C, TRPO, MaskablePPO, RecurrentPPO, DQN, QRDQN, SAC, TQC, CrossQ, TD3 and DDPG.

    SB3 calls callbacks right before each ``train()``; the callback then makes the next ``train()`` reduce churn. The
    history of λ and the reference batch are kept with the model and saved with it. Training with a CChainCallback goes on
    with them, whether the model was loaded or ``learn()`` was called again. The stock ``load`` loads such a model, too.

    Rewards and observations that are NaN or infinite raise a ``ValueError`` before they are trained on.

    :param churn_coef: As for :class:`~sb3_cchain.algorithms.ChurnAlgorithm`
    :param target_churn_ratio: As for ``ChurnAlgorithm``
    :param churn_warmup: As for ``ChurnAlgorithm``
    :param churn_window: As for ``ChurnAlgorithm``
    :param churn_coef_min: As for ``ChurnAlgorithm``
    :param reset_churn_coef: As for ``ChurnAlgorithm``
    :param churn_base_loss: As for ``CChainPPO``; ``"last"`` is for PPO alone
    :param churn_component: As for ``CChainPPO``; another one than ``"full"`` is for PPO alone
    :param churn_reference: As for ``CChainPPO``; another one than ``"independent"`` is for PPO and TRPO
    :param churn_batch_size: As for ``CChainPPO``; another one than 1 is for PPO and TRPO
    :param lean: Whether the model gets lean action distributions, which it keeps: see :func:`~sb3_cchain.networks.make_lean`
    :param churn_target: As for ``ChurnAlgorithm``
    :raises ValueError: Naming the argument that is out of its range; when training starts, for one that the model's algorithm
        does not have, for a second CChainCallback in the same ``learn()``, and for one that another callback holds
    :raises TypeError: When ``reset_churn_coef`` is not a boolean; when training starts, for a model of another algorithm, or
        one that reduces churn itself
    """

    churn_reducers: ChurnReducers

    def __init__(
        self,
        churn_coef: float | str | dict[str, float | str] = "auto",
        target_churn_ratio: float | str | dict[str, float | str] = "auto",
        churn_warmup: int | None = None,
        churn_window: int | None = None,
        churn_coef_min: float = 0.0,
        reset_churn_coef: bool = False,
        churn_base_loss: str = "actor",
        churn_component: str = "full",
        churn_reference: str = "independent",
        churn_batch_size: float = 1.0,
        lean: bool = True,
        churn_target: str = "auto",
    ):
        super().__init__()
        self._arguments = ChurnArguments(
            churn_target, churn_coef, target_churn_ratio, churn_warmup, churn_window, churn_coef_min
        )
        self._arguments.check()  # raise on bad values now
        check_bool("reset_churn_coef", reset_churn_coef)
        check_bool("lean", lean)
        self._options = PolicyChurnOptions(churn_base_loss, churn_component, churn_reference, churn_batch_size)
        self.lean = lean
        self.reset_churn_coef = reset_churn_coef
        self._task_switch = TaskSwitch()
        # On the model from the end of a rollout to train()
        self._hooks = TrainingHooks()

    @property
    def churn_reducer(self) -> ChurnReducer:
        """The only churn reducer, or the first of several."""
        return self.churn_reducers.first

    def _init_callback(self) -> None:
        model: Any = self.model
        name = type(model).__name__
        if hasattr(model, "churn_reducers"):
            raise TypeError(f"{name} reduces churn by itself; give CChainCallback to a stock model")
        self._check_options(name, self._arguments.target_names(churn_kind(type(model)), name))
        refuse_event(self, self.parent)  # a `callback_on_new_best` is initialised, and hears of nothing else
        add_overview(model)
        if self.lean and isinstance(model, OnPolicyAlgorithm):
            make_lean(model)
        self.churn_reducers = self._arguments.make_reducers(model)
        past, n_updates = vars(model).get("churn_state"), model._n_updates
        self._state = keep_churn_state(model, self.churn_reducers, self._task_switch, past, n_updates)
        self._state.n_updates = n_updates

    def _check_options(self, algorithm: str, targets: tuple[str, ...]) -> None:
        default = PolicyChurnOptions()
        has_ppos_references = isinstance(self.model, PPO) or is_trpo(self.model)
        holds_ppos_policy = isinstance(self.model, PPO) and targets == ("policy",)
        is_last = self._options.churn_base_loss == "last"
        for argument, is_known in (
            ("churn_base_loss", holds_ppos_policy if is_last else isinstance(self.model, OnPolicyAlgorithm)),
            ("churn_component", holds_ppos_policy),
            ("churn_reference", has_ppos_references),
            ("churn_batch_size", has_ppos_references),
        ):
            given, only = getattr(self._options, argument), getattr(default, argument)
            if given != only and not is_known:
                raise ValueError(f"`{argument}` must be {only!r} for {algorithm} that holds still {targets}, got {given!r}")

    def _on_training_start(self) -> None:
        self._hooks.begin(self.model)
        require_every_rollout(self)
        require_single(self)  # two would add the churn loss twice

    def _on_step(self) -> bool:
        super()._on_step()
        if self.reset_churn_coef and self._task_switch.happened(step_task(self.model, self.locals["infos"])):
            for reducer in self.churn_reducers.values():
                reducer.coefficient.reset()
        return True

    def _on_rollout_end(self) -> None:
        super()._on_rollout_end()
        self._hooks.remove()  # off-policy, train() does not follow on each rollout
        if self.churn_reducers.active():
            # Innermost, so that L is computed with what other callbacks set for train()
            self._hooks.around_call(self.model, "train", self._train, innermost=True)

    def _train(self, train: Callable[[], None]) -> None:
        self._hooks.remove()  # first, so that nothing is left when train() fails, too
        self._state.weights = None
        with reduced_churn(self.model, self.churn_reducers, self._options):
            train()
        self._state.n_updates = self.model._n_updates

    def _on_training_end(self) -> None:
        self._hooks.remove()
        self._state.keep_weights()
        super()._on_training_end()
