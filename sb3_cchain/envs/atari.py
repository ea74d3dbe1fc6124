"""Continual Atari: a chain of games, or of modes and difficulties of a game."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import AtariPreprocessing, FrameStackObservation
from numpy.typing import NDArray

from sb3_cchain.envs.continual_env import ContinualEnv
from sb3_cchain.validation import check_list, check_number

# See ContinualAtari
CORA_GAMES = ("SpaceInvaders", "Krull", "BeamRider", "Hero", "StarGunner", "MsPacman")


class AtariTask(NamedTuple):
    """
    A task of :class:`ContinualAtari`.

    :param game: As in the ids of the Arcade Learning Environment: ``"SpaceInvaders"``
    :param mode: Mode of the game; None for its default
    :param difficulty: Difficulty of the game; None for its default
    """

    game: str
    mode: int | None = None
    difficulty: int | None = None


class ContinualAtari(ContinualEnv[NDArray[np.uint8], np.int64]):
    """
    A chain of Atari games, or of modes and difficulties of a game (Farebrother et al., 2018, https://arxiv.org/abs/1810.00123).
    The default sequence is that of CORA (Powers et al., CoLLAs 2022, https://arxiv.org/abs/2110.10067), whose
    authors go through these games five times (``cycles=5``), 50 million frames each time.

    As Machado et al. (2018, https://arxiv.org/abs/1709.06009) recommend: actions are repeated with a probability of 0.25, an
    episode does not end with a life, and all 18 actions of the joystick can be taken, in all games. An action lasts for 4
    frames. Observations are the last 4 pictures, 84 × 84 grey pixels: ``CnnPolicy`` takes them as they are. Rewards are the
    game's; to learn from clipped ones, wrap the environment in ``stable_baselines3.common.atari_wrappers.ClipRewardEnv``.

    Training cannot be resumed exactly in the middle of an episode: the emulator does not save all of its state.

    :param tasks: Games by name, or mappings of the fields of :class:`~sb3_cchain.envs.AtariTask`:
        ``{"game": "Freeway", "mode": 1, "difficulty": 0}``. Read back as the attribute ``atari_tasks``
    :param steps_per_task: Environment steps (of 4 frames) per task, one number for all or one per task
    :param repeat_action_probability: Probability that a frame repeats the action before
    :param kwargs: ``n_envs``, ``first_task``, ``cycles``, ``render_mode``: see :class:`~sb3_cchain.ContinualEnv`
    :raises TypeError: When ``tasks`` is a string or not a list
    :raises ValueError: Naming the argument that is out of its range
    :raises ImportError: When the Arcade Learning Environment or OpenCV is not installed
    """

    def __init__(
        self,
        tasks: Sequence[str | Mapping[str, Any]] = CORA_GAMES,
        *,
        steps_per_task: int | Sequence[int] = 12_500_000,
        repeat_action_probability: float = 0.25,
        **kwargs: Any,
    ):
        self.atari_tasks = [_read_task(position, task) for position, task in enumerate(check_list("tasks", tasks, "games"))]
        check_number("repeat_action_probability", repeat_action_probability, 0, 1)
        settings = {"repeat_action_probability": repeat_action_probability}
        makers = [partial(_make_task, task, **settings) for task in self.atari_tasks]
        super().__init__(makers, steps_per_task, **kwargs)

    @property
    def task_sequence(self) -> list[tuple[str, int | None, int | None]]:
        """The game of each task, its mode and its difficulty."""
        return [(task.game, task.mode, task.difficulty) for task in self.atari_tasks] * self.cycles


def _read_task(position: int, task: Any) -> AtariTask:
    if isinstance(task, str):
        return AtariTask(task)
    if not isinstance(task, Mapping) or "game" not in task or not set(task) <= set(AtariTask._fields):
        raise ValueError(
            f"`tasks[{position}]` must be the name of a game, or a mapping of `game`, `mode` and `difficulty`, got {task!r}"
        )
    for name in ("mode", "difficulty"):
        if task.get(name) is not None:
            check_number(f"tasks[{position}][{name!r}]", task[name], 0, integer=True)
    return AtariTask(**task)


def _make_task(task: AtariTask, **kwargs: Any) -> gym.Env:
    try:
        import ale_py
        import cv2  # noqa: F401
    except ImportError as error:
        raise ImportError(
            f'The Arcade Learning Environment or OpenCV is not installed ({error}): pip install "sb3-cchain[atari]"'
        ) from error
    gym.register_envs(ale_py)  # importing it has registered its environments
    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)  # without its banner
    given = {name: value for name, value in task._asdict().items() if name != "game" and value is not None}
    try:
        # AtariPreprocessing skips frames. The checker around the continual environment suffices
        env = gym.make(f"ALE/{task.game}-v5", frameskip=1, full_action_space=True, disable_env_checker=True, **given, **kwargs)
    except gym.error.UnregisteredEnv as error:
        raise ValueError(f"Unknown game {task.game!r} in `tasks`: {error}") from error
    except RuntimeError as error:
        emulator = gym.make(f"ALE/{task.game}-v5").unwrapped.ale  # type: ignore[attr-defined]
        raise ValueError(
            f"`tasks` has a mode or a difficulty that {task.game} does not have, {given}. It has the modes "
            f"{emulator.getAvailableModes()} and the difficulties {emulator.getAvailableDifficulties()}"
        ) from error
    return FrameStackObservation(AtariPreprocessing(env), 4)
