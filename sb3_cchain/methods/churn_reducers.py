"""C-CHAIN beside other methods."""

from stable_baselines3.common.callbacks import BaseCallback

from sb3_cchain.churn import ChurnReducer
from sb3_cchain.tasks.sync import iterate_callbacks


def churn_reducers(callback: BaseCallback) -> list[ChurnReducer]:
    """
    :param callback: A callback, during ``learn()``
    :return: What reduces churn in that training: of the model (``CChainPPO``, ``CChainDQN``), or of another callback
        (``CChainCallback``). A method that changes the network between two updates makes it forget its reference batch: the
        change is no churn, which is an update's, and shall not be undone.
    """
    holders = [callback.model, *iterate_callbacks(callback.locals.get("callback"))]
    return [holder.churn_reducer for holder in holders if hasattr(holder, "churn_reducer")]
