"""Finds what reduces churn in a training, so that methods that change the network can reset it."""

from stable_baselines3.common.callbacks import BaseCallback

from sb3_cchain.churn import ChurnReducer
from sb3_cchain.tasks.callback_tree import iterate_callbacks


def churn_reducers(callback: BaseCallback) -> list[ChurnReducer]:
    """
    :param callback: A callback, during ``learn()``
    :return: The churn reducers of that training: of the model (``CChainPPO`` and others), or of another callback
        (``CChainCallback``)
    """
    holders = [callback.model, *iterate_callbacks(callback.locals.get("callback"))]
    return [reducer for holder in holders for reducer in getattr(holder, "churn_reducers", {}).values()]


def forget_references(callback: BaseCallback) -> None:
    """
    Let churn reduction forget its reference batch, after a method has changed the network between two updates. Only changes
    by updates are churn; otherwise C-CHAIN would undo the change.

    :param callback: A callback, during ``learn()``
    """
    for reducer in churn_reducers(callback):
        reducer.forget_reference()
