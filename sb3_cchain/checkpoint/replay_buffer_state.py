"""Replay buffers in checkpoints."""

import io
import pickle
from collections.abc import Mapping
from typing import Any

from stable_baselines3.common.buffers import ReplayBuffer

from sb3_cchain.checkpoint.chunks import ChunkStore
from sb3_cchain.checkpoint.state_pickle import StatePickler, StateUnpickler

# Smaller arrays are not worth a file
SMALLEST = 2**16


def save_replay_buffer(buffer: ReplayBuffer, store: ChunkStore, known: Mapping[str, object]) -> dict[str, Any]:
    """
    :param buffer: A replay buffer
    :param store: Takes its arrays
    :param known: Objects that are not part of its state, such as the environment that HER asks for rewards, by names
    :return: Its state, which refers to the store
    """
    arrays: list[list[str]] = []

    def keep(array: pickle.PickleBuffer) -> bool:
        data = array.raw()
        if data.nbytes < SMALLEST:
            return True  # with the rest
        arrays.append(store.write(data))
        return False

    file = io.BytesIO()
    names = {id(value): name for name, value in known.items()}
    StatePickler(file, names, buffer_callback=keep).dump(vars(buffer))
    return {"attributes": file.getvalue(), "arrays": arrays}


def restore_replay_buffer(
    buffer: ReplayBuffer, state: Mapping[str, Any], store: ChunkStore, known: Mapping[str, object]
) -> None:
    """
    :param buffer: A replay buffer, as it was made
    :param state: What :func:`save_replay_buffer` returned
    :param store: The store that it refers to
    :param known: As given to :func:`save_replay_buffer`
    :raises ValueError: When the store is damaged
    """
    arrays = [store.read(names) for names in state["arrays"]]
    vars(buffer).update(StateUnpickler(io.BytesIO(state["attributes"]), known, buffers=arrays).load())
