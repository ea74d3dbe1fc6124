"""The state of simulations whose code is not Python: MuJoCo's, in Gymnasium and dm_control."""

import sys
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_cchain.checkpoint.object_state import register_state

# The greatest parts of a model: textures, meshes and the like, which simulations do not change. They are compared
# by their checksum
SHAPES = ("tex_data", "mesh_", "skin_", "flex_", "bvh_", "oct_", "names", "paths", "text_", "plugin_attr")


def register_simulators() -> None:
    """
    Teach :mod:`~sb3_cchain.checkpoint.object_state` the objects of simulators, as far as these are imported in this process.
    """
    mujoco = sys.modules.get("mujoco")
    if mujoco is not None:
        register_state(mujoco.MjModel, _model_state, _restore_model)
        register_state(mujoco.MjData, _data_state, _restore_data)
    engine = sys.modules.get("dm_control.mujoco.engine")
    if engine is not None:
        register_state(engine.Physics, _physics_state, _restore_physics)


def is_inexact(env: gym.Env) -> bool:
    """
    :param env: An environment without wrappers
    :return: Whether its simulator has no exact state. That of Atari saves the random numbers of sticky actions, but not all of
        the picture: after a restart, sprites may be missing in the first frame. Nor does a reset always begin alike
    """
    atari = sys.modules.get("ale_py")
    return atari is not None and isinstance(vars(env).get("ale"), atari.ALEInterface)


# Ids of data that the next reset empties before they are used
_emptied: set[int] = set()


@contextmanager
def emptied(envs: Iterable[gym.Env]) -> Iterator[None]:
    """
    Leave out MuJoCo's data of environments within the context. To save them takes most of a second in the largest models.

    :param envs: Environments that are reset before the next step. A reset leaves nothing of the data
    """
    _emptied.update(id(data) for env in envs if (data := _find_data(env.unwrapped)) is not None)
    try:
        yield
    finally:
        _emptied.clear()


def _find_data(env: gym.Env) -> Any:
    attributes = vars(env)
    physics = getattr(attributes.get("_env"), "physics", None)
    return attributes.get("data") if physics is None else physics.data.ptr


def _model_state(model: Any) -> dict[str, Any]:
    arrays = _arrays(model)
    shapes = {name: zlib.crc32(arrays.pop(name).tobytes()) for name in list(arrays) if name.startswith(SHAPES)}
    options = {part: _values(getattr(model, part)) for part in ("opt", "stat")}
    content = {name: zlib.compress(array.tobytes(), 1) for name, array in arrays.items()}
    return {"arrays": content, "options": options, "shapes": shapes}


def _restore_model(model: Any, state: dict[str, Any]) -> None:
    arrays = _arrays(model)
    for name, checksum in state["shapes"].items():
        if name not in arrays or zlib.crc32(arrays[name].tobytes()) != checksum:
            raise ValueError(f"The MuJoCo model differs from the saved one in `{name}`: make the same environment")
    for name, content in state["arrays"].items():
        saved = np.frombuffer(zlib.decompress(content), dtype=arrays[name].dtype)
        if saved.size != arrays[name].size:
            raise ValueError(f"The MuJoCo model differs from the saved one in the size of `{name}`: make the same environment")
        # Arrays that nothing changes may not be writeable
        live = getattr(model, name)
        if not np.array_equal(live.reshape(-1).view(np.uint8), saved.view(np.uint8)):
            live[...] = saved.reshape(live.shape)
    for part, values in state["options"].items():
        for name, value in values.items():
            live = getattr(getattr(model, part), name)
            if isinstance(live, np.ndarray):
                live[...] = value
            else:
                setattr(getattr(model, part), name, value.item())


def _arrays(model: Any) -> dict[str, NDArray[Any]]:
    found = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    arrays = {name: value for name, value in found.items() if isinstance(value, np.ndarray) and value.size}
    return {name: np.ascontiguousarray(value) for name, value in arrays.items()}


def _values(part: Any) -> dict[str, Any]:
    found = {name: getattr(part, name) for name in dir(part) if not name.startswith("_")}
    return {name: np.array(value) for name, value in found.items() if isinstance(value, int | float | np.ndarray)}


def _data_state(data: Any) -> dict[str, Any] | None:
    if id(data) in _emptied:
        return None
    # MuJoCo writes everything: positions and velocities, what follows from them, contacts and forces
    content, size = data.__getstate__(), _size(data.model)
    if content[1:].startswith(_begin(size)):
        # The model comes first, and is up to a hundred times as large
        return {"head": content[:1], "tail": zlib.compress(memoryview(content)[1 + size :], 1)}
    return {"head": content, "tail": None}


def _restore_data(data: Any, state: dict[str, Any] | None) -> None:
    if state is None:
        return
    mujoco = sys.modules["mujoco"]
    content = state["head"]
    if state["tail"] is not None:
        content = b"".join([content, data.model.__getstate__(), zlib.decompress(state["tail"])])
    saved = mujoco.MjData.__new__(mujoco.MjData)
    saved.__setstate__(content)
    mujoco.mj_copyData(data, data.model, saved)


def _size(model: Any) -> int:
    """Bytes of a model as MuJoCo writes it: a flag, the size twice, and the model."""
    return 1 + 8 + 8 + sys.modules["mujoco"].mj_sizeModel(model)


def _begin(size: int) -> bytes:
    return b"\x01" + 2 * (size - 17).to_bytes(8, "little")


def _physics_state(physics: Any) -> dict[str, Any]:
    return {"model": _model_state(physics.model.ptr), "data": _data_state(physics.data.ptr)}


def _restore_physics(physics: Any, state: dict[str, Any]) -> None:
    _restore_model(physics.model.ptr, state["model"])
    _restore_data(physics.data.ptr, state["data"])
