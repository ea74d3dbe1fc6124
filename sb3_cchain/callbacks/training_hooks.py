"""What callbacks attach to a model, for one ``learn()``."""

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_cchain.callbacks.replaced_methods import Wrapper, wrapped


class TrainingHooks:
    """
    Hooks that act in one ``learn()`` and in no other.

    SB3 does not tell callbacks when ``learn()`` ends by an exception, such as Ctrl-C or an error of the environment, so what
    they attached to the model stays there. Hooks of this class do nothing in any later ``learn()`` of the model, and remove
    themselves in it. Call :meth:`begin` when training starts and :meth:`remove` when it ends.
    """

    def __init__(self) -> None:
        self._model: BaseAlgorithm | None = None
        self._start_time = 0.0
        self._attached = ExitStack()

    def begin(self, model: BaseAlgorithm) -> None:
        """
        Remove all hooks that interrupted training left, maybe on another model.

        :param model: A model whose ``learn()`` has begun, which the hooks will serve
        """
        self.remove()
        self._model, self._start_time = model, model.start_time

    def remove(self) -> None:
        """Remove all hooks."""
        self._attached.close()

    def state_dict(self) -> dict[str, Any]:
        """
        :return: Nothing: training that is resumed in another process attaches hooks of its own
        """
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: What :meth:`state_dict` returned
        """

    def before_step(self, optimizer: th.optim.Optimizer, function: Callable[[th.optim.Optimizer], None]) -> None:
        """
        :param optimizer: An optimiser of the model
        :param function: Called with the optimiser before each of its steps
        """
        self._add(optimizer.register_step_pre_hook, function)

    def after_step(self, optimizer: th.optim.Optimizer, function: Callable[[th.optim.Optimizer], None]) -> None:
        """
        :param optimizer: An optimiser of the model
        :param function: Called with the optimiser after each of its steps
        """
        self._add(optimizer.register_step_post_hook, function)

    def after_call(self, owner: object, method: str, function: Callable[[Any], None]) -> None:
        """
        :param owner: The model, or an object that it uses, such as its environment
        :param method: Name of one of its methods
        :param function: Called with the result of the method, each time that it has returned
        """

        def call_both(call: Callable[[], Any]) -> Any:
            result = call()
            function(result)
            return result

        self.around_call(owner, method, call_both)

    def around_call(self, owner: object, method: str, function: Wrapper, innermost: bool = False) -> None:
        """
        :param owner: The model, or an object that it uses
        :param method: Name of one of its methods
        :param function: Called in its place, with a function that calls the method; returns what the method is to return
        :param innermost: Whether it calls the method itself, and not what else stands in its place already
        """

        def call_around(call: Callable[[], Any]) -> Any:
            if self._is_over():
                self.remove()
                return call()
            return function(call)

        self._attached.enter_context(wrapped(owner, method, call_around, innermost))

    def _is_over(self) -> bool:
        # SB3 sets the start time at the beginning of each `learn()`
        return self._model is None or self._model.start_time != self._start_time

    def _add(
        self,
        register: Callable[[Callable[..., None]], th.utils.hooks.RemovableHandle],
        function: Callable[[th.optim.Optimizer], None],
    ) -> None:
        def hook(optimizer: th.optim.Optimizer, *_: Any) -> None:
            if self._is_over():
                _remove_last(handle)
            else:
                function(optimizer)

        handle = register(hook)
        self._attached.callback(handle.remove)


def _remove_last(handle: th.utils.hooks.RemovableHandle) -> None:
    """
    Remove a hook while the optimiser runs its hooks. This is allowed for the last of them only, because torch iterates over
    the dictionary of hooks itself. Therefore each step removes one hook of interrupted training.
    """
    hooks = handle.hooks_dict_ref()
    if hooks is not None and next(reversed(hooks)) == handle.id:
        handle.remove()
