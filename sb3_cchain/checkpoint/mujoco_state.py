"""The state of MuJoCo's simulations, of Gymnasium's environments and of dm_control's."""

import sys
import zlib
from typing import Any

import numpy as np

from sb3_cchain.checkpoint.object_state import register_state

# The greatest parts of a model: textures, meshes and the like, which simulations do not change. They are compared
# by their checksum
SHAPES = ("tex_data", "mesh_", "skin_", "flex_", "bvh_", "oct_", "names", "paths", "text_", "plugin_attr")


def register_mujoco() -> None:
    """Teach :mod:`~sb3_cchain.checkpoint.object_state` MuJoCo's objects, if there are any in this process."""
    mujoco = sys.modules.get("mujoco")
    if mujoco is not None and hasattr(mujoco, "MjData"):
        register_state(mujoco.MjModel, _model_state, _restore_model)
        register_state(mujoco.MjData, _data_state, _restore_data)
    engine = sys.modules.get("dm_control.mujoco.engine")
    if engine is not None:
        register_state(engine.Physics, _physics_state, _restore_physics)


def _model_state(model: Any) -> dict[str, Any]:
    arrays = _arrays(model)
    shapes = {name: zlib.crc32(arrays.pop(name)) for name in list(arrays) if name.startswith(SHAPES)}
    options = {
        part: {name: np.array(value) for name, value in _values(getattr(model, part)).items()} for part in ("opt", "stat")
    }
    content = {name: zlib.compress(array.tobytes(), 1) for name, array in arrays.items()}
    return {"arrays": content, "options": options, "shapes": shapes}


def _restore_model(model: Any, state: dict[str, Any]) -> None:
    arrays = _arrays(model)
    for name, checksum in state["shapes"].items():
        if name not in arrays or zlib.crc32(arrays[name]) != checksum:
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


def _arrays(model: Any) -> dict[str, np.ndarray]:
    found = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    arrays = {name: value for name, value in found.items() if isinstance(value, np.ndarray) and value.size}
    return {name: np.ascontiguousarray(value) for name, value in arrays.items()}


def _values(part: Any) -> dict[str, Any]:
    found = {name: getattr(part, name) for name in dir(part) if not name.startswith("_")}
    return {name: value for name, value in found.items() if isinstance(value, int | float | np.ndarray)}


def _data_state(data: Any) -> dict[str, Any]:
    # MuJoCo writes everything: positions and velocities, what follows from them, contacts and forces. It writes the model
    # first, which is hundreds of times as large
    content, model = data.__getstate__(), data.model.__getstate__()
    if content[1 : 1 + len(model)] == model:
        return {"head": content[:1], "tail": zlib.compress(content[1 + len(model) :], 1)}
    return {"head": content, "tail": None}


def _restore_data(data: Any, state: dict[str, Any]) -> None:
    import mujoco

    content = state["head"]
    if state["tail"] is not None:
        content += data.model.__getstate__() + zlib.decompress(state["tail"])
    saved = mujoco.MjData.__new__(mujoco.MjData)
    saved.__setstate__(content)
    mujoco.mj_copyData(data, data.model, saved)


def _physics_state(physics: Any) -> dict[str, Any]:
    return {"model": _model_state(physics.model.ptr), "data": _data_state(physics.data.ptr)}


def _restore_physics(physics: Any, state: dict[str, Any]) -> None:
    _restore_model(physics.model.ptr, state["model"])
    _restore_data(physics.data.ptr, state["data"])
