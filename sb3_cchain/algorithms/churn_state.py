"""Keeps the state of churn reduction with the model, so that it is saved and training goes on with the same λ."""

import zlib
from typing import Any
from weakref import ref

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_cchain.churn import ChurnReducers
from sb3_cchain.networks.model_optimizers import model_optimizers
from sb3_cchain.tasks.signal import TaskSwitch


class ChurnState:
    """
    Stands as ``churn_state`` among a model's attributes, which SB3 pickles into the saved file. There, and in a copy of the
    model, it becomes a dict of tensors and numbers. A stock algorithm loads it as one more attribute and ignores it, also
    where this package is not installed.

    :param model: The model
    :param reducers: Its churn reducers, by the name of the target
    :param task_switch: What notices that the task has changed
    """

    def __init__(self, model: BaseAlgorithm, reducers: ChurnReducers, task_switch: TaskSwitch):
        # Weak, so that `del model` frees it at once. It is not saved, and a copy of the model gets a state of its own
        self._model = ref(model)
        self.reducers = reducers
        self.task_switch = task_switch
        # `model._n_updates` after the last training with churn reduction; None for models that always train with it
        self.n_updates: int | None = None
        # Checksum of the weights that the last update left; None during training, whose weights are those at any moment
        self.weights: int | None = None

    def keep_weights(self) -> None:
        """To be called when training ends: other weights later on are no churn."""
        self.weights = self._checksum()

    def forget_if_changed(self) -> None:
        """To be called when training begins: forget the reference batches where the weights are others than it left."""
        if self.weights not in (None, self._checksum()):
            for reducer in self.reducers.values():
                reducer.forget_reference()

    def _checksum(self) -> int | None:
        has_reference = any(reducer.reference is not None for reducer in self.reducers.values())
        return weights_checksum(self.model) if has_reference else None

    @property
    def model(self) -> BaseAlgorithm:
        """The model, which must be there still."""
        model = self._model()
        assert model is not None
        return model

    def as_dict(self) -> dict[str, Any]:
        """
        :return: The state at this moment
        """
        return {
            "reducers": {
                name: _map_tensors(lambda tensor: tensor.detach().cpu().clone(), reducer.state_dict())
                for name, reducer in self.reducers.items()
            },
            "task_id": self.task_switch.task_id,
            "n_updates": self.model._n_updates if self.n_updates is None else self.n_updates,
            "weights": self._checksum() if self.weights is None else self.weights,
        }

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (list(self.as_dict().items()),)


def keep_churn_state(
    model: BaseAlgorithm, reducers: ChurnReducers, task_switch: TaskSwitch, past: Any = None, n_updates: int = 0
) -> ChurnState:
    """
    Let the reducers go on from a past state, and save their state with the model from now on.

    A reducer starts over when the past state has none for its target. λ starts over when the past one was of another kind or
    had another window. The reference batch is forgotten when the model was trained without churn reduction in the meantime, or
    got other weights, because what changed on it is not the churn of one update.

    :param model: A model
    :param reducers: Its churn reducers, which are new, by the name of the target
    :param task_switch: What notices that the task has changed
    :param past: The past state: a :class:`ChurnState`, or the dict of it in a saved file; None to start over
    :param n_updates: ``_n_updates`` of the model with the past state, as it is now or was when it was saved
    :return: The state, which is now ``model.churn_state``
    """
    if isinstance(past, ChurnState):
        past = past.as_dict()
    if past is not None:
        task_switch.task_id = past["task_id"]
        for name in reducers.keys() & past["reducers"].keys():
            reducer = reducers[name]
            saved, fresh = past["reducers"][name], reducer.state_dict()
            same_kind = _shapes(saved) == _shapes(fresh)
            reducer.load_state_dict(saved if same_kind else {**fresh, "_extra_state": saved["_extra_state"]})
            reducer.move_reference(model.device)
            if past["n_updates"] != n_updates:
                reducer.forget_reference()
    state = model.churn_state = ChurnState(model, reducers, task_switch)  # type: ignore[attr-defined]
    state.weights = None if past is None else past.get("weights")
    state.forget_if_changed()
    return state


def weights_checksum(model: BaseAlgorithm) -> int:
    """
    :param model: A model
    :return: A checksum of all that its optimisers train
    """
    checksum = 0
    for optimizer in model_optimizers(model).values():
        for group in optimizer.param_groups:
            for parameter in group["params"]:
                weights = parameter.detach().cpu().contiguous().reshape(-1).view(th.uint8)
                checksum = zlib.crc32(weights.numpy(), checksum)
    return checksum


def _map_tensors(function: Any, state: Any) -> Any:
    if isinstance(state, dict):
        return {key: _map_tensors(function, value) for key, value in state.items()}
    return function(state) if th.is_tensor(state) else state


def _shapes(state: dict[str, Any]) -> dict[str, th.Size]:
    return {key: value.shape for key, value in state.items() if th.is_tensor(value)}
