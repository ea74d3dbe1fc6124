"""The mixin that wires churn reduction into a Stable-Baselines3 algorithm."""

from inspect import Parameter, signature
from typing import TYPE_CHECKING, Any, TypeVar

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import MaybeCallback, TensorDict

from sb3_cchain.algorithms.churn_state import ChurnState, keep_churn_state
from sb3_cchain.algorithms.churn_targets import ChurnArguments, churn_kind
from sb3_cchain.algorithms.finite_check import FiniteCheck
from sb3_cchain.algorithms.full_signature import FullSignature
from sb3_cchain.algorithms.on_policy import PolicyChurnOptions
from sb3_cchain.algorithms.reduced_churn import reduced_churn
from sb3_cchain.algorithms.zero_rate_warning import ZeroRateWarning
from sb3_cchain.callbacks.default_callbacks import with_continual_callbacks
from sb3_cchain.churn import ChurnReducer, ChurnReducers
from sb3_cchain.tasks.callback_tree import as_list
from sb3_cchain.tasks.signal import TaskSwitch, step_task
from sb3_cchain.tensorboard.overview import add_overview
from sb3_cchain.validation import check_bool

SelfChurnAlgorithm = TypeVar("SelfChurnAlgorithm", bound="ChurnAlgorithm")


class ChurnAlgorithm(FullSignature, ZeroRateWarning):
    """
    Makes an algorithm of SB3 or sb3-contrib reduce churn: ``class CChainSAC(ChurnAlgorithm, SAC)``.

    Its own ``train()`` runs unchanged; the gradient of λ·L_churn is added right after each ``zero_grad()``. The state of
    churn reduction is saved with the model. There are also a check for NaN in what the environment gives, the callbacks for
    continual environments, and the overview in TensorBoard.

    :param args: Arguments of the base algorithm
    :param churn_target: What is held still: ``"policy"``, ``"value"`` or ``"both"``. ``"auto"`` is the policy, or the
        values of an algorithm without a policy that could be held still (DQN, QRDQN, TRPO).
    :param churn_coef: λ, the weight of the churn loss: a number, ``"auto"`` to keep the churn loss at
        ``target_churn_ratio`` times the base loss, or ``"auto_10"`` to use 10 instead of 1 during the warm-up.
        With 0 the algorithm is its base, to the bit. One for all, or a dict, ``{"policy": ..., "value": ...}``.
    :param target_churn_ratio: β, the size of λ·L_churn relative to the base loss. ``"auto"`` is a default for the kind of
        the network's outputs. One for all, or a dict, ``{"policy": ..., "value": ...}``.
    :param churn_warmup: Iterations until λ adapts: calls of ``train()`` on-policy, gradient updates off-policy. None is 10 for
        PPO, MaskablePPO and RecurrentPPO; for all others 0, where λ adapts after the first ``train()`` with a churn loss.
    :param churn_window: Iterations that the running means of both losses cover. None is 50 for PPO, MaskablePPO, RecurrentPPO
        and TRPO, and 1000 for all others, A2C included, in which an iteration is one gradient update.
    :param churn_coef_min: Least value of λ once it adapts
    :param reset_churn_coef: Whether λ starts over (warm-up included) when the task switches, as in the code
        released with the paper. Off by default, because C-CHAIN does not need to be told of a switch.
    :param kwargs: Keyword arguments of the base algorithm
    :raises ValueError: Naming the churn argument that is out of its range
    :raises TypeError: When ``reset_churn_coef`` is not a boolean
    """

    churn_reducers: ChurnReducers
    churn_state: ChurnState

    def __init__(
        self,
        *args: Any,
        churn_target: str = "auto",
        churn_coef: float | str | dict[str, float | str] = "auto",
        target_churn_ratio: float | str | dict[str, float | str] = "auto",
        churn_warmup: int | None = None,
        churn_window: int | None = None,
        churn_coef_min: float = 0.0,
        reset_churn_coef: bool = False,
        **kwargs: Any,
    ):
        kind = churn_kind(type(self))
        self.churn_target = churn_target
        self.churn_coef = churn_coef
        self.target_churn_ratio = target_churn_ratio
        self.churn_warmup: int = kind.warmup if churn_warmup is None else churn_warmup
        self.churn_window: int = kind.window if churn_window is None else churn_window
        self.churn_coef_min = churn_coef_min
        self.reset_churn_coef = reset_churn_coef
        # Raise on bad values before an environment is made
        check_bool("reset_churn_coef", reset_churn_coef)
        self._churn_options()
        arguments = self._churn_arguments()
        arguments.check()
        arguments.target_names(kind, type(self).__name__)
        self._task_switch = TaskSwitch()
        super().__init__(*args, **kwargs)

    @property
    def churn_reducer(self) -> ChurnReducer:
        """The only churn reducer, or the first of several."""
        return self.churn_reducers.first

    def _churn_arguments(self) -> ChurnArguments:
        return ChurnArguments(
            self.churn_target,
            self.churn_coef,
            self.target_churn_ratio,
            self.churn_warmup,
            self.churn_window,
            self.churn_coef_min,
        )

    def _churn_options(self) -> PolicyChurnOptions:
        return PolicyChurnOptions()

    def _make_churn_reducers(self) -> ChurnReducers:
        self._churn_options()  # load() does not give them to __init__()
        arguments = self._churn_arguments()
        arguments.check()
        return arguments.make_reducers(self)

    def _setup_model(self) -> None:
        super()._setup_model()  # type: ignore[safe-super]
        self.churn_reducers = self._make_churn_reducers()
        # `load()` has put in the saved state, a dict, which `set_parameters()` takes next
        if not isinstance(vars(self).get("churn_state"), dict):
            keep_churn_state(self, self.churn_reducers, self._task_switch)

    def train(self, *args: Any, **kwargs: Any) -> None:
        """
        As the base algorithm does, with churn reduction.

        :param args: As of the base algorithm
        :param kwargs: As of the base algorithm
        """
        self.churn_state.weights = None
        with reduced_churn(self, self.churn_reducers, self._churn_options()):
            super().train(*args, **kwargs)  # type: ignore[misc]

    if not TYPE_CHECKING:  # type checkers know the arguments of the base algorithm's own

        def learn(self: SelfChurnAlgorithm, total_timesteps: int, *args: Any, **kwargs: Any) -> SelfChurnAlgorithm:
            """
            As the base algorithm's. In a continual environment the callbacks that follow its tasks are added.

            :param total_timesteps: Environment steps to train for
            :param args: As of the base algorithm
            :param kwargs: As of the base algorithm. The run in TensorBoard is by default named after the class, unless the
                base algorithm's own ``learn()`` has another default than SB3's.
            :return: The trained model
            """
            if _takes_sb3s_log_name(type(self), n_given=1 + len(args)):
                kwargs.setdefault("tb_log_name", type(self).__name__)
            try:
                return super().learn(total_timesteps, *args, **kwargs)
            finally:
                self.churn_state.keep_weights()

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        self.churn_state.forget_if_changed()
        add_overview(self)  # to the logger that was just made
        callbacks = with_continual_callbacks([*as_list(callback), FiniteCheck()], self.env)
        return super()._init_callback(callbacks, progress_bar)

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: Any = None) -> None:
        super()._update_info_buffer(infos, dones)
        if self.reset_churn_coef and self._task_switch.happened(step_task(self, infos)):
            for reducer in self.churn_reducers.values():
                reducer.coefficient.reset()

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        if "churn_reducers" in state:
            # A copy, by pickle or deepcopy: `churn_state` became a dict of that moment, and has to follow the copy's training
            keep_churn_state(self, self.churn_reducers, self._task_switch)

    def _excluded_save_params(self) -> list[str]:
        # They are in `churn_state`
        return [*super()._excluded_save_params(), "churn_reducers", "_task_switch"]

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
        self.churn_reducers = self._make_churn_reducers()
        keep_churn_state(self, self.churn_reducers, self._task_switch, past, n_updates)


def _takes_sb3s_log_name(algorithm: type, n_given: int) -> bool:
    """Whether ``tb_log_name`` is not among the first arguments, which are given, and SB3's: the name of its class."""
    bases = algorithm.__mro__[algorithm.__mro__.index(ChurnAlgorithm) + 1 :]
    stock = [
        base.__name__ for base in bases if base.__module__.startswith(("stable_baselines3.", "sb3_contrib.", "sb3_cchain."))
    ]
    for learn in (vars(base)["learn"] for base in bases if "learn" in vars(base)):
        _, *parameters = signature(learn).parameters.values()
        position = next((i for i, parameter in enumerate(parameters) if parameter.name == "tb_log_name"), None)
        if position is not None:
            return n_given <= position and parameters[position].default in stock
        if parameters[-1].kind is not Parameter.VAR_KEYWORD:  # not passed on to the next one
            return False
    return False
