"""Continual ProcGen: a chain of levels of one game."""

import gc
import sys
from collections.abc import Sequence
from copy import deepcopy
from functools import partial
from importlib import import_module
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_cchain.envs.continual_env import ContinualEnv
from sb3_cchain.validation import check_number

# Pixels of a frame per pixel of an observation and direction
FRAME_SCALE = 8
# Of the environment ids. Here, so that procgen need not be installed to know them
GAME_NAMES = (
    "BigFish",
    "BossFight",
    "CaveFlyer",
    "Chaser",
    "Climber",
    "CoinRun",
    "Dodgeball",
    "FruitBot",
    "Heist",
    "Jumper",
    "Leaper",
    "Maze",
    "Miner",
    "Ninja",
    "Plunder",
    "Starpilot",
)
# Procgen's own names
GAMES = tuple(name.lower() for name in GAME_NAMES)
# The games of each mode. Procgen ends the process where a game does not have the mode. Its "exploration" is left out: it is
# the hard mode on one certain level, which leaves no choice of levels.
DISTRIBUTION_MODES: dict[str, tuple[str, ...]] = {
    "easy": GAMES,
    "hard": GAMES,
    "extreme": ("chaser", "dodgeball", "leaper", "starpilot"),
    "memory": ("caveflyer", "dodgeball", "heist", "jumper", "maze", "miner"),
}
N_ACTIONS = 15
# For procgen an action too: a step without movement, after which it begins a new episode
NEW_EPISODE = -1
MAX_LEVEL = 2**31 - 1


class ProcgenGame(gym.Env[NDArray[np.uint8], np.int64]):
    """
    One game of procgen.

    Procgen begins the next episode by itself, within the step that ends one, and never shows how that episode ended. The
    observation at an episode's end is therefore the one before its last step, the last one there is. What procgen gives
    is the next episode's first, perhaps of another level. The agent uses the value of neither, because the episode is over.

    The ``reset()`` that follows returns the first observation of the episode that has already begun. A reset in the middle of
    an episode makes procgen begin another one, after a step without movement that is not seen.

    Procgen has time limits of its own (1000 steps unless a game sets another) and does not say that one was reached: every end
    is ``terminated``, as in procgen's own interface.

    A reset with a seed determines which levels come next. Nothing else is left to chance: the same actions in the same level
    make the same episode. With ``num_levels=1``, all episodes begin alike and the seed has no effect. (There is one
    exception: after a reset without a seed Dodgeball's player faces where it last went in the episode before.)

    Frames (``render_mode="rgb_array"``) are the observations, enlarged. Procgen draws finer ones, but at every step, which is
    tens of times slower, and Stable-Baselines3 asks every environment that it makes for frames.

    :param game: The game, by procgen's name for it
    :param start_level: The first of its levels
    :param num_levels: From how many levels, beginning with ``start_level``, the level of each episode is drawn; 0 means all
    :param distribution_mode: ``"easy"`` or ``"hard"``; some games have ``"extreme"`` or ``"memory"``
    :param render_mode: ``"rgb_array"`` or ``None``
    :raises ValueError: Naming the argument that is out of its range
    :raises ImportError: When procgen is not installed
    """

    # The frames per second are those of procgen's own display
    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 15}  # noqa: RUF012

    def __init__(
        self,
        game: str,
        *,
        start_level: int = 0,
        num_levels: int = 0,
        distribution_mode: str = "hard",
        render_mode: str | None = None,
    ):
        _check_game(game, distribution_mode)
        check_number("num_levels", num_levels, 0, MAX_LEVEL, integer=True)
        check_number("start_level", start_level, 0, MAX_LEVEL - num_levels, integer=True)
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"`render_mode` must be None or 'rgb_array', got {render_mode!r}")
        _import_procgen()
        self.observation_space = spaces.Box(0, 255, (64, 64, 3), np.uint8)
        self.action_space = spaces.Discrete(N_ACTIONS)
        self.render_mode = render_mode
        self._settings = {
            "env_name": game,
            "start_level": int(start_level),
            "num_levels": int(num_levels),
            "distribution_mode": distribution_mode,
        }
        # Begun at the first reset, so that tasks far ahead cost nothing
        self._game: Any = None
        # The first observation of an episode that procgen has begun and reset() has not
        self._next_observation: NDArray[np.uint8] | None = None
        # The last observation that was returned
        self._observation: NDArray[np.uint8] | None = None

    def launch(self, n_games: int, rand_seed: int, **kwargs: Any) -> Any:
        """
        :param n_games: How many games are to run side by side
        :param rand_seed: From 0 to 2³¹ - 1
        :param kwargs: Further arguments of ``ProcgenGym3Env``
        :return: Procgen itself (``ProcgenGym3Env``), with this game's settings; to be closed by the caller
        """
        # cffi looks up the functions of procgen under a lock that one thread cannot take twice. If the garbage collector ran
        # then and closed a game that nobody had closed, this would wait for ever. So it does not run while a game is made, and
        # the function that closes the game is looked up now.
        enabled = gc.isenabled()
        gc.disable()
        try:
            game = _import_procgen()(num=n_games, rand_seed=rand_seed, **self._settings, **kwargs)
            _ = game._c_lib.libenv_close
        finally:
            if enabled:
                gc.enable()
        return game

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """
        Begin an episode. After the end of one, it is the episode that procgen has begun already.

        :param seed: Determines the levels of this and all later episodes. Procgen is launched
            again, because it takes a seed only then.
        :param options: Not used
        :return: Observation and info
        """
        super().reset(seed=seed)
        if seed is not None or self._game is None:
            self.close()
            # Procgen's seeds have 31 bits, Gymnasium's any number
            rand_seed = int(self.np_random.integers(2**31))
            self._game = self.launch(1, rand_seed, num_threads=0)
            self._next_observation = self._game.observe()[1]["rgb"][0]
        elif self._next_observation is None:
            self._game.act(np.array([NEW_EPISODE]))  # pyright: ignore[reportArgumentType]
            self._next_observation = self._game.observe()[1]["rgb"][0]
        observation = self._observation = self._next_observation
        self._next_observation = None
        return observation, {}  # pyright: ignore[reportReturnType]

    def step(self, action: np.int64) -> tuple[NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        """
        One step, which procgen makes of one frame.

        :param action: From 0 to 14
        :return: Observation, reward, terminated, truncated (never), info
        :raises ValueError: For any other action
        :raises gymnasium.error.ResetNeeded: Before the first ``reset()`` and after the end of an episode
        """
        if self._game is None or self._observation is None or self._next_observation is not None:
            raise gym.error.ResetNeeded("Call reset() before step()")
        if not 0 <= action < N_ACTIONS:
            raise ValueError(f"An action must be an integer between 0 and {N_ACTIONS - 1}, got {action!r}")
        self._game.act(np.array([action]))  # pyright: ignore[reportArgumentType]
        rewards, observations, ended = self._game.observe()
        observation, terminated = observations["rgb"][0], bool(ended[0])
        if terminated:
            self._next_observation = observation
            observation = self._observation.copy()
        self._observation = observation
        return observation, float(rewards[0]), terminated, False, {}

    def state_dict(self) -> dict[str, Any]:
        """
        :return: The state of the game, from which it goes on in another process
        """
        return {
            "game": None if self._game is None else self._game.get_state(),
            "observation": _copy(self._observation),
            "next_observation": _copy(self._next_observation),
            "np_random": deepcopy(self._np_random),
            "np_random_seed": self._np_random_seed,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        Go on from a state.

        :param state: What ``state_dict()`` of the same game returned
        """
        if state["game"] is None:
            self.close()
        else:
            if self._game is None:
                self._game = self.launch(1, 0, num_threads=0)
            self._game.set_state(state["game"])
        self._observation, self._next_observation = _copy(state["observation"]), _copy(state["next_observation"])
        self._np_random, self._np_random_seed = deepcopy(state["np_random"]), state["np_random_seed"]

    def render(self) -> NDArray[np.uint8] | None:
        """
        :return: The last observation, enlarged to ``(512, 512, 3)``; ``None`` without a render mode or before a reset
        """
        if self.render_mode is None or self._observation is None:
            return None
        return self._observation.repeat(FRAME_SCALE, axis=0).repeat(FRAME_SCALE, axis=1)

    def close(self) -> None:
        """End the game. A ``reset()`` begins another."""
        if self._game is not None:
            self._game.close()
        self._game = self._next_observation = None


class ContinualProcgen(ContinualEnv[NDArray[np.uint8], np.int64]):
    """
    Continual ProcGen (Section 5 of the C-CHAIN paper, after TRAC): a task is another level of the same game.

    Task ``i`` is the level ``first_level + i``; with more levels per task, each task has as many new ones.

    :param game: The game, by procgen's name for it: bigfish, bossfight, caveflyer, chaser, climber, coinrun, dodgeball,
        fruitbot, heist, jumper, leaper, maze, miner, ninja, plunder or starpilot
    :param n_tasks: Length of the sequence
    :param steps_per_task: Environment steps per task, one number for all or one per task
    :param first_level: The first level of the first task; read back, with all others, as the attribute ``levels``
    :param num_levels: Levels per task, from which the level of each episode is drawn
    :param distribution_mode: See :class:`~sb3_cchain.envs.ProcgenGame`
    :param kwargs: ``n_envs``, ``first_task``, ``cycles``, ``render_mode``: see :class:`~sb3_cchain.ContinualEnv`. A render
        mode is ``"rgb_array"``; ``gymnasium.make`` takes ``"human"`` too
    :raises ValueError: Naming the argument that is out of its range
    :raises ImportError: When procgen is not installed
    """

    metadata: dict[str, Any] = ProcgenGame.metadata

    def __init__(
        self,
        game: str,
        *,
        n_tasks: int = 5,
        steps_per_task: int | Sequence[int] = 2_000_000,
        first_level: int = 20,
        num_levels: int = 1,
        distribution_mode: str = "hard",
        **kwargs: Any,
    ):
        _check_game(game, distribution_mode)
        check_number("n_tasks", n_tasks, 1, integer=True)
        check_number("num_levels", num_levels, 1, MAX_LEVEL // n_tasks, integer=True)
        check_number("first_level", first_level, 0, MAX_LEVEL - n_tasks * num_levels, integer=True)
        self.game = game
        starts = [int(first_level + task * num_levels) for task in range(n_tasks)]
        self.levels = [range(start, start + int(num_levels)) for start in starts]
        make_task = partial(ProcgenGame, game, num_levels=num_levels, distribution_mode=distribution_mode)
        tasks = [partial(make_task, start_level=start) for start in starts]
        super().__init__(tasks, steps_per_task, **kwargs)

    @property
    def task_sequence(self) -> list[tuple[str, int, int]]:
        """The game of each task, its first level and its number of levels."""
        return [(self.game, levels.start, len(levels)) for levels in self.levels] * self.cycles


def _copy(observation: NDArray[np.uint8] | None) -> NDArray[np.uint8] | None:
    return None if observation is None else observation.copy()


def _check_game(game: str, distribution_mode: str) -> None:
    if game not in GAMES:
        raise ValueError(f"`game` must be one of {', '.join(GAMES)}, got {game!r}")
    if distribution_mode == "exploration":
        raise ValueError(
            "`distribution_mode` must not be 'exploration', which is the mode 'hard' on one certain level: "
            "give that level's number with the mode 'hard'"
        )
    modes = [mode for mode, games in DISTRIBUTION_MODES.items() if game in games]
    if distribution_mode not in modes:
        raise ValueError(f"`distribution_mode` must be one of {', '.join(modes)} for {game}, got {distribution_mode!r}")


def _import_procgen() -> Any:
    try:
        return import_module("procgen").ProcgenGym3Env
    except ImportError as error:
        advice = 'procgen is not installed: pip install "sb3-cchain[procgen]"'
        if sys.version_info >= (3, 13):
            advice += ". There is no wheel of it for Python 3.13 or later: use Python 3.10, 3.11 or 3.12"
        raise ImportError(advice) from error
