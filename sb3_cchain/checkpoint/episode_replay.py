"""The state of an environment that cannot be saved: how its episode began and which actions followed."""

import sys
from copy import deepcopy
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.core import ActType, ObsType
from gymnasium.envs.registration import EnvSpec

from sb3_cchain.checkpoint.named_code import stock_class
from sb3_cchain.checkpoint.object_state import ObjectStates, object_states, restore_objects
from sb3_cchain.envs.reset import reset_env

# How environments and wrappers were made
CONSTRUCTION = frozenset({"_cached_spec", "_saved_kwargs", "_ezpickle_args", "_ezpickle_kwargs", "mujoco_renderer"})


class EpisodeReplay(gym.Wrapper[ObsType, ActType, ObsType, ActType]):
    """
    Makes an environment resumable whose objects cannot be saved, such as those of Box2D. It records the actions of the present
    episode. When the state is put back, the episode is begun and played again.

    The environment must be deterministic: the same actions after the same reset, with the same random numbers, must give the
    same episode. Box2D's environments are if each episode has a world of its own, which they get here.

    :param env: The environment
    :param begun: Whether the environment may have been reset already. An episode that is under way cannot be saved
    """

    def __init__(self, env: gym.Env[ObsType, ActType], *, begun: bool = False):
        super().__init__(env)
        self.is_recorded = not begun
        # State of the environment before the reset, and the arguments of the reset; None before the first one
        self._before: ObjectStates | None = None
        self._reset_arguments: dict[str, Any] = {}
        self._actions: list[Any] = []
        # Reward, terminated and truncated of each step
        self._outcomes: list[tuple[float, bool, bool]] = []
        self._observation: Any = None

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]
        """That of the environment, as this wrapper changes nothing."""
        return self.env.spec

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[ObsType, dict[str, Any]]:
        """
        :param seed: Passed on
        :param options: Passed on
        :return: Observation and info
        """
        _renew_world(self.unwrapped)
        if seed is None:
            # The generator is made where it is first asked for, of which there would be no record
            _ = self.np_random
        self._before = self._attributes()
        self._reset_arguments = {"seed": seed, "options": deepcopy(options)}
        self._actions, self._outcomes = [], []
        self.is_recorded = True
        observation, info = reset_env(self.env, seed, options)
        self._observation = observation
        return observation, info

    def step(self, action: ActType) -> tuple[ObsType, SupportsFloat, bool, bool, dict[str, Any]]:
        """
        :param action: The action
        :return: Observation, reward, terminated, truncated, info
        """
        self._actions.append(action.copy() if isinstance(action, np.ndarray) else action)
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._outcomes.append((float(reward), bool(terminated), bool(truncated)))
        self._observation = observation
        return observation, reward, terminated, truncated, info

    def state_dict(self) -> dict[str, Any]:
        """
        :return: How the episode began, and its actions
        :raises ValueError: When the episode was under way before it could be recorded
        """
        if not self.is_recorded:
            raise ValueError(f"The episode of {self.env} began before it was recorded: save after the next reset")
        return {
            "before": self._attributes() if self._before is None else self._before,
            "reset": None if self._before is None else self._reset_arguments,
            "actions": list(self._actions),
            "outcomes": list(self._outcomes),
            "observation": deepcopy(self._observation),
            "generator": _generator_state(self.unwrapped),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        Begin the episode again, and play it to where it was.

        :param state: What ``state_dict()`` returned
        :raises ValueError: When the episode is another one this time
        """
        _renew_world(self.unwrapped)
        restore_objects(self._layers(), state["before"], self._known())
        self._before, self._actions, self._outcomes, self._observation, self.is_recorded = None, [], [], None, True
        if state["reset"] is None:
            return
        self.reset(**state["reset"])
        for action in state["actions"]:
            self.step(action)
        is_same = (
            _same(self._outcomes, state["outcomes"])
            and _same(self._observation, state["observation"])
            and _generator_state(self.unwrapped) == state["generator"]
        )
        if not is_same:
            raise ValueError(
                f"{self.env} cannot be resumed exactly: an episode of {len(self._actions)} steps went otherwise when it was "
                "played again. The environment is not deterministic, or it was made with other arguments. Give its class "
                "`state_dict()` and `load_state_dict(state)`, or save training by TrainingCheckpoint(..., exact=False), which "
                "begins new episodes. What was trained so far is in the checkpoint's model.zip, for load()"
            )

    def _attributes(self) -> ObjectStates:
        layers = self._layers()
        return object_states(layers, self._known(), skip=dict.fromkeys(layers, CONSTRUCTION))

    def _layers(self) -> dict[str, gym.Env]:
        layers, env = [self.env], self.env
        while isinstance(env, gym.Wrapper):
            env = env.env
            layers.append(env)
        return {f"{position} {stock_class(type(layer)).__name__}": layer for position, layer in enumerate(layers)}

    def _known(self) -> dict[str, object]:
        return {"replay": self}


def _renew_world(env: gym.Env) -> None:
    """
    Give an environment of Box2D a new world. In one that held other bodies before, the same bodies move otherwise, because
    contacts are solved in another order.
    """
    box2d = sys.modules.get("Box2D")
    world = getattr(env, "world", None)
    if box2d is not None and isinstance(world, box2d.b2World) and hasattr(env, "_destroy"):
        env._destroy()  # pyright: ignore[reportAttributeAccessIssue]
        env.world = box2d.b2World(gravity=world.gravity)  # type: ignore[attr-defined]


def _generator_state(env: gym.Env) -> Any:
    generator = vars(env).get("_np_random")
    return generator.bit_generator.state if isinstance(generator, np.random.Generator) else None


def _same(first: Any, second: Any) -> bool:
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(_same(first[key], second[key]) for key in first)
    if isinstance(first, tuple | list):
        return len(first) == len(second) and all(map(_same, first, second))
    first, second = np.asarray(first), np.asarray(second)
    return first.dtype == second.dtype and first.shape == second.shape and first.tobytes() == second.tobytes()
