"""Frames for a video of several tasks."""

from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.core import ActType, ObsType
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont, ImageOps

from sb3_cchain.envs.reset import reset_env
from sb3_cchain.tasks.signal import TASK_KEY

# Of the height of a frame. Smaller letters than of 10 pixels cannot be read
_LETTERS, _LEAST_LETTERS = 1 / 16, 10


class TaskCaption(gym.Wrapper[ObsType, ActType, ObsType, ActType], RecordConstructorArgs):
    """
    Writes the task in the upper left corner of each frame, for a video of an agent across a switch. A video has one size:
    where frames of a later task have another size than the first frame, they are scaled to fit into it, with black margins.

    :param env: Environment with ``render_mode="rgb_array"``
    :param key: The entry of ``info`` that says the task. Frames are as they were where it is missing
    :raises ValueError: When the environment has another ``render_mode``
    """

    def __init__(self, env: gym.Env[ObsType, ActType], key: str = TASK_KEY):
        RecordConstructorArgs.__init__(self, key=key)
        gym.Wrapper.__init__(self, env)
        if env.render_mode != "rgb_array":
            raise ValueError(f'TaskCaption needs an environment with `render_mode="rgb_array"`, got {env.render_mode!r}')
        self.key = key
        self._task: Any = None
        self._size: tuple[int, int] | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[ObsType, dict[str, Any]]:
        """
        :param seed: Passed on
        :param options: Passed on
        :return: Observation and info
        """
        observation, info = reset_env(self.env, seed, options)
        self._task = info.get(self.key)
        return observation, info

    def step(self, action: ActType) -> tuple[ObsType, SupportsFloat, bool, bool, dict[str, Any]]:
        """
        :param action: The action
        :return: Observation, reward, terminated, truncated, info
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._task = info.get(self.key)
        return observation, reward, terminated, truncated, info

    def render(self) -> NDArray[np.uint8]:
        """
        :return: The frame with the task on it, ``(height, width, 3)``, ``uint8``
        """
        frame = np.asarray(self.env.render())
        height, width, _ = frame.shape
        self._size = self._size or (width, height)
        if (width, height) != self._size:
            frame = np.asarray(ImageOps.pad(Image.fromarray(frame), self._size))
        return frame if self._task is None else with_caption(frame, f"task {self._task}")


def with_caption(frame: NDArray[np.uint8], text: str) -> NDArray[np.uint8]:
    """
    :param frame: A frame, ``(height, width, 3)``
    :param text: What to write, white on black, in its upper left corner
    :return: A copy of the frame with the text
    """
    image = Image.fromarray(frame)
    draw = ImageDraw.Draw(image)
    size = max(round(image.height * _LETTERS), _LEAST_LETTERS)
    font, place = ImageFont.load_default(size), (size // 2, size // 2)
    left, top, right, bottom = draw.textbbox(place, text, font=font)
    draw.rectangle((0, 0, right + left, bottom + top // 2), fill="black")
    draw.text(place, text, fill="white", font=font)
    return np.array(image)
