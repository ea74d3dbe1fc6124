"""The mixin that wires churn reduction into a Stable-Baselines3 algorithm."""

import warnings
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import MaybeCallback, TensorDict

from sb3_cchain.algorithms.churn_state import keep_churn_state
from sb3_cchain.algorithms.finite_check import FiniteCheck
from sb3_cchain.callbacks.default_callbacks import with_continual_callbacks
from sb3_cchain.churn import ChurnCoefficient, ChurnReducer, make_coefficient
from sb3_cchain.tasks.signal import TaskSwitch, step_task
from sb3_cchain.tensorboard.overview import add_overview
from sb3_cchain.validation import check_bool


class ChurnAlgorithm(BaseAlgorithm):
    """
    Adds the churn arguments, a :class:`~sb3_cchain.churn.ChurnReducer` whose state is saved with the model, a check for NaN
    in what the environment gives, the callbacks for continual environments and the overview in TensorBoard to an SB3
    algorithm. A subclass builds the reducer in ``_make_churn_reducer()`` and uses it in ``train()``.

    :param args: Arguments of the base algorithm
    :param churn_coef: λ, the weight of the churn loss: a number, ``"auto"`` to keep the churn loss at
        ``target_churn_ratio`` times the base loss, or ``"auto_10"`` to use 10 instead of 1 during the warm-up.
        With 0 the algorithm is its base, to the bit.
    :param target_churn_ratio: β, the size of λ·L_churn relative to the base loss. ``"auto"`` is a default for the kind of
        the network's outputs.
    :param churn_warmup: Iterations until λ adapts: calls of ``train()`` with PPO, gradient updates with DQN
    :param churn_window: Iterations that the running means of both losses cover
    :param churn_coef_min: Least value of λ once it adapts
    :param reset_churn_coef: Whether λ starts over (warm-up included) when ``info["task_id"]`` changes, as in the code
        released with the paper. Off by default, because C-CHAIN does not need to be told of a switch.
    :param kwargs: Keyword arguments of the base algorithm
    :raises ValueError: Naming the churn argument that is out of its range
    :raises TypeError: When ``reset_churn_coef`` is not a boolean
    """

    churn_reducer: ChurnReducer

    def __init__(
        self,
        *args: Any,
        churn_coef: float | str = "auto",
        target_churn_ratio: float | str = "auto",
        churn_warmup: int = 10,
        churn_window: int = 50,
        churn_coef_min: float = 0.0,
        reset_churn_coef: bool = False,
        **kwargs: Any,
    ):
        self.churn_coef = churn_coef
        self.target_churn_ratio = target_churn_ratio
        self.churn_warmup = churn_warmup
        self.churn_window = churn_window
        self.churn_coef_min = churn_coef_min
        self.reset_churn_coef = reset_churn_coef
        # Raise on bad values before an environment is made
        check_bool("reset_churn_coef", reset_churn_coef)
        self._make_churn_coefficient(default_target_ratio=1.0)
        self._task_switch = TaskSwitch()
        self._is_first_training = True
        super().__init__(*args, **kwargs)

    def _make_churn_coefficient(self, default_target_ratio: float) -> ChurnCoefficient:
        return make_coefficient(
            self.churn_coef,
            self.target_churn_ratio,
            default_target_ratio,
            warmup=self.churn_warmup,
            window=self.churn_window,
            minimum=self.churn_coef_min,
        )

    def _make_churn_reducer(self) -> ChurnReducer:
        raise NotImplementedError()

    def _setup_model(self) -> None:
        super()._setup_model()  # type: ignore[safe-super]
        self.churn_reducer = self._make_churn_reducer()
        # `load()` puts in the state that was saved, as a dict, and calls `set_parameters()` next, which takes it
        if not isinstance(vars(self).get("churn_state"), dict):
            keep_churn_state(self, self.churn_reducer, self._task_switch)

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        add_overview(self)  # to the logger that was just made
        self._is_first_training = True
        if callback is None:
            callback = []  # SB3's stand-in for no callback would be called at each step
        elif not isinstance(callback, (BaseCallback, list)):
            callback = ConvertCallback(callback)  # a function
        given = callback if isinstance(callback, list) else [callback]
        return super()._init_callback(with_continual_callbacks([*given, FiniteCheck()], self.env), progress_bar)

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        super()._update_learning_rate(optimizers)
        if self._is_first_training and self.lr_schedule(self._current_progress_remaining) == 0 < self.lr_schedule(1.0):
            warnings.warn(
                "The learning rate is 0 from the first update of this `learn()` on, so nothing is learned. SB3's schedules go "
                "to their end within each `learn()`: train for more than one rollout in a call, or use a constant rate."
            )
        self._is_first_training = False

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: Any = None) -> None:
        super()._update_info_buffer(infos, dones)
        if self.reset_churn_coef and self._task_switch.happened(step_task(self, infos)):
            self.churn_reducer.coefficient.reset()

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        if "churn_reducer" in state:
            # A copy, by pickle or deepcopy: `churn_state` became a dict of that moment, and has to follow the copy's training
            keep_churn_state(self, self.churn_reducer, self._task_switch)

    def _excluded_save_params(self) -> list[str]:
        # They are in `churn_state`
        return [*super()._excluded_save_params(), "churn_reducer", "_task_switch"]

    def set_parameters(
        self,
        load_path_or_dict: str | TensorDict,
        exact_match: bool = True,
        device: th.device | str = "auto",
    ) -> None:
        """
        As in SB3. A saved model brings its history of λ and its reference batch. A dict of parameters, or a model of the base
        algorithm, has none: churn reduction starts over. λ also starts over when it is of another kind, or has another
        window, than that of the saved model.

        :param load_path_or_dict: Path of a saved model, or what ``get_parameters()`` returned
        :param exact_match: Whether all parameters must be given
        :param device: Device to load a saved model to
        """
        if isinstance(load_path_or_dict, dict):
            params: Any = load_path_or_dict
            past, n_updates = vars(self).get("churn_state"), self._n_updates
            if not isinstance(past, dict):  # not called by `load()`
                past = None
        else:
            data, params, _ = load_from_zip_file(load_path_or_dict, device=device)
            past, n_updates = (data or {}).get("churn_state"), (data or {}).get("_n_updates", 0)
        super().set_parameters(params, exact_match, device)
        self.churn_reducer = self._make_churn_reducer()
        keep_churn_state(self, self.churn_reducer, self._task_switch, past, n_updates)
