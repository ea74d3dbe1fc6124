"""Many instances of continual ProcGen as one vectorised environment."""

import warnings
from collections.abc import Sequence
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_cchain.envs.procgen import N_ACTIONS, NEW_EPISODE, ContinualProcgen, ProcgenGame
from sb3_cchain.validation import check_number


class ContinualProcgenVecEnv(VecEnv):
    """
    Many instances of :class:`~sb3_cchain.envs.ContinualProcgen` as one vectorised environment of Stable-Baselines3. Procgen
    steps them all in one call, in threads of its own.

    They share one clock: the step at which they have together made a task's number of steps truncates all their episodes.
    :class:`~sb3_cchain.TaskSync` works with it as with others; ``set_task`` acts from the next ``reset()`` on.

    Episodes are not recorded: wrap it in ``VecMonitor`` for that, as ``Monitor`` is for single environments. Frames
    (``render_mode="rgb_array"``) are the observations.

    :param game: See :class:`~sb3_cchain.envs.ContinualProcgen`
    :param n_envs: Number of instances
    :param num_threads: Procgen's threads; 0 steps the instances in the thread that calls
    :param render_mode: ``"rgb_array"`` or ``None``
    :param kwargs: Further arguments of :class:`~sb3_cchain.envs.ContinualProcgen`
    :raises ValueError: Naming the argument that is out of its range
    :raises ImportError: When procgen is not installed
    """

    def __init__(self, game: str, n_envs: int, *, num_threads: int = 4, render_mode: str | None = None, **kwargs: Any):
        check_number("num_threads", num_threads, 0, integer=True)
        # The tasks and their clock; no game is played in it
        self._sequence = ContinualProcgen(game, n_envs=n_envs, render_mode=render_mode, **kwargs)
        super().__init__(int(n_envs), self._sequence.observation_space, self._sequence.action_space)
        self._num_threads = int(num_threads)
        self._games: Any = None
        self._rng: np.random.Generator | None = None
        self._observations = np.zeros((self.num_envs, *self.observation_space.shape), dtype=np.uint8)  # type: ignore[misc]
        self._returns = np.zeros(self.num_envs)

    def reset(self) -> NDArray[np.uint8]:
        """
        Begin an episode of the task that is due in all instances.

        After ``seed()``, the first instance's seed determines all that follows.

        :return: Observations ``(n_envs, 64, 64, 3)``
        """
        seed = self._seeds[0]
        if seed is not None or self._rng is None:
            self._rng, _ = seeding.np_random(seed)
        self._reset_seeds()
        self._reset_options()
        switched = self._sequence.clock.begin()
        if seed is not None or self._games is None or switched:
            self._launch()
        else:
            self._games.act(np.full(self.num_envs, NEW_EPISODE))  # pyright: ignore[reportArgumentType]
            self._observations = self._games.observe()[1]["rgb"]
        self._begin_episodes(range(self.num_envs))
        return self._observations.copy()

    def _launch(self) -> None:
        self.close()
        assert self._rng is not None
        self._games = self._make_games(int(self._rng.integers(2**31)))
        self._observations = self._games.observe()[1]["rgb"]

    def _make_games(self, rand_seed: int) -> Any:
        task = self._sequence.task
        assert isinstance(task, ProcgenGame)
        return task.launch(self.num_envs, rand_seed, num_threads=self._num_threads)

    def _begin_episodes(self, indices: Sequence[int] | NDArray[np.int64]) -> None:
        for index in indices:
            self.reset_infos[index] = {"task_id": self._sequence.task_id}
            self._returns[index] = 0.0

    def step_async(self, actions: NDArray[np.int64]) -> None:
        """
        Begin a step of all instances.

        :param actions: From 0 to 14, ``(n_envs,)``
        :raises ValueError: For any other actions
        :raises gymnasium.error.ResetNeeded: Before the first ``reset()``
        """
        if self._games is None:
            raise gym.error.ResetNeeded("Call reset() before step()")
        actions = np.asarray(actions)
        if actions.shape != (self.num_envs,) or actions.min() < 0 or actions.max() >= N_ACTIONS:
            raise ValueError(f"Actions must be {self.num_envs} integers between 0 and {N_ACTIONS - 1}, got {actions!r}")
        self._games.act(actions)  # pyright: ignore[reportArgumentType]

    def step_wait(self) -> VecEnvStepReturn:
        """
        End the step.

        :return: Observations ``(n_envs, 64, 64, 3)``, rewards, ends of episodes, infos
        """
        assert self._games is not None
        rewards, all_observations, terminated = self._games.observe()
        observations = all_observations["rgb"]
        self._returns += rewards
        task_id = self._sequence.task_id
        switch = self._sequence.clock.advance()
        dones = np.logical_or(terminated, switch)
        infos: list[dict[str, Any]] = [
            {
                "task_id": task_id,
                "task_reward": reward,
                "episode_return": episode_return,
                "TimeLimit.truncated": switch and not end,
            }
            for reward, episode_return, end in zip(rewards.tolist(), self._returns.tolist(), terminated.tolist(), strict=True)
        ]
        ended = np.flatnonzero(dones)
        for index in ended:
            # As in ProcgenGame: at an episode's own end what procgen gives is of the next
            last = self._observations if terminated[index] else observations
            infos[index]["terminal_observation"] = last[index]
        self._observations = observations
        if switch:
            self._sequence.clock.begin()
            self._launch()
        self._begin_episodes(ended)
        # A copy, as the next step may give them as terminal observations
        return self._observations.copy(), rewards, dones, infos

    def state_dict(self) -> dict[str, Any]:
        """
        :return: The state of all instances, from which they go on in another process
        """
        return deepcopy(
            {
                "clock": vars(self._sequence.clock),
                "games": None if self._games is None else self._games.get_state(),
                "observations": self._observations,
                "returns": self._returns,
                "rng": self._rng,
                "reset_infos": self.reset_infos,
                "seeds": self._seeds,
                "options": self._options,
                "action_random": self.action_space._np_random,
                "observation_random": self.observation_space._np_random,
            }
        )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        Go on from a state.

        :param state: What ``state_dict()`` returned, of as many instances of the same games
        """
        state = deepcopy(state)
        vars(self._sequence.clock).update(state["clock"])
        # Only in a game of the right levels
        self.close()
        if state["games"] is not None:
            self._games = self._make_games(0)
            self._games.set_state(state["games"])
        self._observations, self._returns, self._rng = state["observations"], state["returns"], state["rng"]
        self.reset_infos, self._seeds, self._options = state["reset_infos"], state["seeds"], state["options"]
        self.action_space._np_random, self.observation_space._np_random = state["action_random"], state["observation_random"]

    def close(self) -> None:
        """End all games. A ``reset()`` begins others."""
        if self._games is not None:
            self._games.close()
        self._games = None

    def get_images(self) -> Sequence[NDArray[Any] | None]:
        """
        :return: The observations, without a render mode ``None`` for each
        """
        if self.render_mode != "rgb_array":
            warnings.warn(f"Images need render_mode='rgb_array', the render mode is {self.render_mode!r}")
            return [None] * self.num_envs
        return list(self._observations)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        :param attr_name: An attribute of :class:`~sb3_cchain.envs.ContinualProcgen`
        :param indices: Of the instances; all have the same
        :return: Its value, once for each
        """
        value = getattr(self._sequence, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        :param attr_name: Any
        :param value: Any
        :param indices: Any
        :raises NotImplementedError: Always, as the instances have no attributes of their own
        """
        raise NotImplementedError(f"The attribute `{attr_name}` cannot be set: procgen runs the instances as one")

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """
        :param method_name: ``"set_clock"`` or ``"set_task"``, see :class:`~sb3_cchain.ContinualEnv`
        :param method_args: Its arguments
        :param indices: Of the instances; it is called once for all
        :param method_kwargs: Its keyword arguments
        :return: What it returns, once for each
        :raises AttributeError: For any other method
        """
        if method_name not in ("set_clock", "set_task"):
            raise AttributeError(
                f"The method must be 'set_clock' or 'set_task', as procgen runs the instances as one, got {method_name!r}"
            )
        value = getattr(self._sequence, method_name)(*method_args, **method_kwargs)
        return [value for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """
        :param wrapper_class: Any
        :param indices: Of the instances
        :return: ``False`` for each
        """
        return [False for _ in self._get_indices(indices)]
