"""The callbacks that are given to ``learn()``, however they are nested."""

from collections.abc import Iterator

from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback, EvalCallback, EventCallback
from stable_baselines3.common.type_aliases import MaybeCallback


def as_list(callback: MaybeCallback) -> list[BaseCallback]:
    """
    :param callback: What ``learn()`` was given: a callback, a list of them, a function or None
    :return: A list of callbacks
    """
    if callback is None:
        return []
    if isinstance(callback, list):
        return callback
    return [callback if isinstance(callback, BaseCallback) else ConvertCallback(callback)]


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


def require_single(callback: BaseCallback) -> None:
    """
    :param callback: A callback of which a training can have one, when training starts
    :raises ValueError: When ``learn()`` was given several callbacks of its class
    """
    kind = type(callback)
    n_callbacks = sum(isinstance(given, kind) for given in iterate_callbacks(callback.locals.get("callback")))
    if n_callbacks > 1:
        raise ValueError(f"`learn()` was given {n_callbacks} callbacks {kind.__name__}: give it one")


def require_every_rollout(callback: BaseCallback) -> None:
    """
    :param callback: A callback that acts between rollouts, when training starts
    :raises ValueError: When another one holds it that calls it at its events alone, and never between rollouts
    """
    for given in iterate_callbacks(callback.locals.get("callback")):
        if given is not callback and callback in iterate_callbacks(given):
            refuse_event(callback, given)


def refuse_event(callback: BaseCallback, holder: BaseCallback | None) -> None:
    """
    :param callback: A callback that acts between rollouts
    :param holder: One that holds it
    :raises ValueError: When the holder calls it at its events alone, and never between rollouts
    """
    if isinstance(holder, EventCallback):
        raise ValueError(
            f"{type(callback).__name__} must be called at every rollout, but {type(holder).__name__} holds it: "
            "give it to `learn()` beside the other callbacks"
        )


def require_unchanged_network(callback: BaseCallback) -> None:
    """
    :param callback: A callback that looks at the network between rollouts, when training starts
    :raises ValueError: When ``learn()`` was given a callback before it that changes the network then
    """
    given_to_learn = list(iterate_callbacks(callback.locals.get("callback")))
    before = given_to_learn[: given_to_learn.index(callback)] if callback in given_to_learn else []
    for given in before:
        if getattr(given, "changes_network", False):
            raise ValueError(
                f"{type(callback).__name__} must come before {type(given).__name__}, which changes the network at the same "
                "time: what it says would be of the changed network. Give it to `learn()` first."
            )


def will_be_restored(callback: BaseCallback) -> bool:
    """
    :param callback: A callback, when training starts
    :return: Whether a :class:`~sb3_cchain.TrainingCheckpoint` will put back its saved state, and that of the environment,
        which is a new one until then
    """
    return any(getattr(given, "is_resuming", False) for given in iterate_callbacks(callback.locals.get("callback")))
