"""Continual MinAtar: a chain of MinAtar games."""

from collections.abc import Sequence
from functools import partial
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.core import ActType, ObsType, RenderFrame
from gymnasium.utils import RecordConstructorArgs
from gymnasium.wrappers import TransformReward
from numpy.typing import NDArray

from sb3_cchain.envs.continual_env import ContinualEnv
from sb3_cchain.validation import check_bool, check_list, check_number

GAMES = ("Asterix", "Breakout", "Freeway", "Seaquest", "SpaceInvaders")


class ChannelPadding(gym.ObservationWrapper, RecordConstructorArgs):
    """
    Appends channels that are ``False`` to each observation, so that games of different channels agree in their spaces.

    :param env: Environment with boolean ``Box`` observations of the shape ``(height, width, channels)``
    :param n_channels: Channels after padding
    :raises TypeError: When the observations are not such a ``Box``
    :raises ValueError: When the observations have more channels than that
    """

    def __init__(self, env: gym.Env, n_channels: int):
        RecordConstructorArgs.__init__(self, n_channels=n_channels)
        gym.ObservationWrapper.__init__(self, env)
        space = env.observation_space
        if not isinstance(space, spaces.Box) or space.dtype != np.bool_ or len(space.shape) != 3:
            raise TypeError(f"Channel padding needs boolean Box observations (height, width, channels), got {space}")
        check_number("n_channels", n_channels, 1, integer=True)
        *size, self._n_own = space.shape
        if n_channels < self._n_own:
            raise ValueError(
                f"`n_channels` must be at least {self._n_own}, the channels of {env.unwrapped}, got {n_channels!r}"
            )
        self._shape = (*size, int(n_channels))
        self.observation_space = spaces.Box(0, 1, self._shape, space.dtype)

    def observation(self, observation: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """
        :param observation: Of the wrapped environment
        :return: The padded observation, a new array
        """
        # Several times faster than np.pad, which would take as long as a step of most games
        padded = np.zeros(self._shape, dtype=np.bool_)
        padded[..., : self._n_own] = observation
        return padded


class NoRewardLimit(gym.Wrapper[ObsType, ActType, ObsType, ActType], RecordConstructorArgs):
    """
    Truncates an episode after a number of steps in a row without reward.

    :param env: The environment
    :param n_steps: The number of steps
    :raises ValueError: When ``n_steps`` is not a positive integer
    """

    def __init__(self, env: gym.Env[ObsType, ActType], n_steps: int):
        RecordConstructorArgs.__init__(self, n_steps=n_steps)
        gym.Wrapper.__init__(self, env)
        check_number("n_steps", n_steps, 1, integer=True)
        self.n_steps = int(n_steps)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[ObsType, dict[str, Any]]:
        """
        :param seed: Passed on
        :param options: Passed on
        :return: Observation and info
        """
        self._unrewarded_steps = 0
        return self.env.reset(seed=seed, options=options)

    def step(self, action: ActType) -> tuple[ObsType, SupportsFloat, bool, bool, dict[str, Any]]:
        """
        :param action: The action
        :return: Observation, reward, terminated, truncated, info
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._unrewarded_steps = 0 if reward else self._unrewarded_steps + 1
        truncated = truncated or self._unrewarded_steps >= self.n_steps
        return observation, reward, terminated, truncated, info


class SeededStickyAction(gym.Wrapper[ObsType, ActType, ObsType, ActType], RecordConstructorArgs):
    """
    Makes ``reset(seed=...)`` of a MinAtar game determine all that follows.

    With sticky actions MinAtar now and then repeats the last action, even if that action belongs to the episode before. A
    seeded reset forgets the last action (the first action may then be replaced by "no operation"); a reset without a seed
    keeps it, as MinAtar does. Besides its random numbers, which the seed determines, a game carries nothing else over a reset.

    :param env: A MinAtar environment
    """

    def __init__(self, env: gym.Env[ObsType, ActType]):
        RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[ObsType, dict[str, Any]]:
        """
        :param seed: From 0 to 2³² - 1
        :param options: Passed on
        :return: Observation and info
        """
        if seed is not None:
            self.unwrapped.game.last_action = 0  # type: ignore[attr-defined]
        return self.env.reset(seed=seed, options=options)


class PixelFrames(gym.Wrapper[ObsType, ActType, ObsType, ActType], RecordConstructorArgs):
    """
    Makes the ``rgb_array`` frames of a MinAtar game suitable for a video recorder: integers from 0 to 255 instead of floats
    from 0 to 1, and enlarged from 10 × 10 pixels.

    :param env: A MinAtar environment
    :param scale: Pixels per cell and direction. With 16 the frame is one that video encoders need not resize.
    :raises ValueError: When ``scale`` is not a positive integer
    """

    def __init__(self, env: gym.Env[ObsType, ActType], scale: int = 16):
        RecordConstructorArgs.__init__(self, scale=scale)
        gym.Wrapper.__init__(self, env)
        check_number("scale", scale, 1, integer=True)
        self.scale = scale
        # MinAtar's own display shows a frame for 50 ms. Its mode "array" is the observation, which is no frame.
        self.metadata = {**env.metadata, "render_modes": ["human", "rgb_array"], "render_fps": 20}

    def render(self) -> RenderFrame | list[RenderFrame] | None:
        """
        :return: In the mode ``rgb_array`` the frame ``(10 * scale, 10 * scale, 3)``, ``uint8``
        """
        frame = self.env.render()
        if self.render_mode != "rgb_array":
            return frame
        return np.rint(255 * np.asarray(frame)).astype(np.uint8).repeat(self.scale, axis=0).repeat(self.scale, axis=1)


class ContinualMinAtar(ContinualEnv[NDArray[np.bool_], np.int64]):
    """
    Continual MinAtar (Section 5 of the C-CHAIN paper and its appendix on continual MinAtar): a task is a game.

    All games have the same six actions, and observations of 10 × 10 cells padded to the same number of boolean channels.
    An episode of Seaquest is truncated after 1000 steps in a row without reward: at the surface it would never end. The
    released code does so only after the first 1000 steps, which leaves a submarine that surfaces for good later.

    :param games: The games in order, from Asterix, Breakout, Freeway, Seaquest and SpaceInvaders; a game may come again
    :param steps_per_task: Environment steps per task, one number for all or one per task
    :param n_channels: Channels of the observations after padding; the games have 4, 4, 7, 10 and 6
    :param sticky_action_prob: Probability that a step repeats the action before instead of taking the one given
    :param difficulty_ramping: Whether Asterix, Seaquest and SpaceInvaders get harder during an episode
    :param kwargs: ``n_envs``, ``first_task``, ``cycles``, ``render_mode``: see :class:`~sb3_cchain.ContinualEnv`
    :raises TypeError: When ``games`` is a string or not a list, or ``difficulty_ramping`` is not a boolean
    :raises ValueError: Naming the argument that is out of its range
    :raises ImportError: When MinAtar is not installed
    """

    def __init__(
        self,
        games: Sequence[str] = ("SpaceInvaders", "Asterix", "Seaquest"),
        *,
        steps_per_task: int | Sequence[int] = 1_500_000,
        n_channels: int = 10,
        sticky_action_prob: float = 0.1,
        difficulty_ramping: bool = True,
        **kwargs: Any,
    ):
        self.games = _check_games(games)
        check_number("sticky_action_prob", sticky_action_prob, 0, 1)
        check_bool("difficulty_ramping", difficulty_ramping)
        settings = {"sticky_action_prob": sticky_action_prob, "difficulty_ramping": difficulty_ramping}
        tasks = [partial(_make_game, game, n_channels, **settings) for game in self.games]
        super().__init__(tasks, steps_per_task, **kwargs)

    @property
    def task_sequence(self) -> list[str]:
        """The game of each task."""
        return self.games * self.cycles


def _check_games(games: Sequence[str]) -> list[str]:
    games = check_list("games", games, of="games")
    for game in games:
        if game not in GAMES:
            raise ValueError(f"Unknown game {game!r} in `games`; it must be one of {', '.join(GAMES)}")
    return games


def _make_game(game: str, n_channels: int, **kwargs: Any) -> gym.Env:
    try:
        import minatar.gym
    except ImportError as error:
        raise ImportError('MinAtar is not installed: pip install "sb3-cchain[minatar]"') from error
    env_id = f"MinAtar/{game}-v0"
    if env_id not in gym.registry:
        minatar.gym.register_envs()
    # By its specification, because Gymnasium warns that the id is out of date: "-v1" has only the actions that matter in the
    # game. Gymnasium's checker would warn of the frames that PixelFrames replaces.
    env = gym.make(gym.spec(env_id), disable_env_checker=True, **kwargs)
    # SpaceInvaders' rewards are NumPy's integers, which Stable-Baselines3's checker refuses
    env = TransformReward(PixelFrames(SeededStickyAction(env)), float)
    if game == "Seaquest":
        env = NoRewardLimit(env, 1000)
    return ChannelPadding(env, n_channels)
