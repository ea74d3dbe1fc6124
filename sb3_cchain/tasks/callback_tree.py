"""The callbacks that a callback contains."""

from collections.abc import Iterator

from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback, EventCallback


def iterate_callbacks(callback: BaseCallback | None) -> Iterator[BaseCallback]:
    """
    :param callback: A callback
    :return: It and all that it contains
    """
    if callback is None:
        return
    yield callback
    children: list[BaseCallback | None] = []
    if isinstance(callback, CallbackList):
        children += callback.callbacks
    if isinstance(callback, EventCallback):
        children += [callback.callback]
    if isinstance(callback, EvalCallback):
        children += [callback.callback_on_new_best]
    for child in children:
        yield from iterate_callbacks(child)
