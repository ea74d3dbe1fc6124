"""The task on the frames of a video."""

import sys
from functools import partial
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest

from sb3_cchain.envs import ContinualEnv, TaskCaption
from sb3_cchain.envs.task_caption import with_caption


class GreyEnv(gym.Env):
    """Its frames are grey, and its observations do not matter."""

    observation_space = gym.spaces.Box(0, 1, (1,))
    action_space = gym.spaces.Discrete(2)

    def __init__(self, render_mode=None, size=(96, 128)):
        self.render_mode, self.size = render_mode, size

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), 1.0, False, False, {}

    def render(self):
        return np.full((*self.size, 3), 128, np.uint8)


def without_encoder(monkeypatch):
    """In the place of moviepy, of which there are many versions: what is called with the frames."""
    clips = mock.MagicMock()
    for name in ("moviepy", "moviepy.video", "moviepy.video.io"):
        monkeypatch.setitem(sys.modules, name, mock.MagicMock())
    monkeypatch.setitem(sys.modules, "moviepy.video.io.ImageSequenceClip", mock.MagicMock(ImageSequenceClip=clips))
    return clips


def two_tasks():
    return ContinualEnv([GreyEnv, GreyEnv], 3, render_mode="rgb_array")


def test_each_frame_has_its_task():
    env = TaskCaption(two_tasks())
    plain = GreyEnv().render()
    task = [with_caption(plain, f"task {number}") for number in range(2)]
    assert (task[0] != task[1]).any()
    env.reset()
    frames = [env.render()]
    for _ in range(3):
        env.step(0)
        frames.append(env.render())  # the last step of a task is of that task
    assert all(np.array_equal(frame, task[0]) for frame in frames)
    env.reset()
    assert np.array_equal(env.render(), task[1])
    env.step(0)
    assert np.array_equal(env.render(), task[1])


@pytest.mark.parametrize("size", [(96, 128), (160, 160), (400, 600), (20, 20)])
def test_the_caption_is_in_the_corner(size):
    plain = GreyEnv(size=size).render()
    frame = with_caption(plain, "task 12")
    assert frame.shape == plain.shape and frame.dtype == np.uint8 and frame.flags.writeable
    assert (plain == 128).all()  # a copy
    rows, columns = np.nonzero((frame != 128).any(axis=2))
    assert rows.min() == columns.min() == 0
    assert frame.max() > 200 and frame.min() == 0  # white on black, smoothed
    if min(size) > 90:
        assert rows.max() < size[0] / 5 and columns.max() < size[1] * 0.6


def test_all_frames_have_the_size_of_the_first():
    tasks = [partial(GreyEnv, size=size) for size in ((80, 120), (200, 200))]
    env = TaskCaption(ContinualEnv(tasks, 1, render_mode="rgb_array"))
    env.reset()
    assert env.render().shape == (80, 120, 3)
    env.step(0)
    env.reset()
    frame = env.render()
    assert frame.shape == (80, 120, 3)
    # Below the caption: 80 x 80 in the middle, and 20 black columns on either side
    assert (frame[-1, :20] == 0).all() and (frame[-1, 20:100] == 128).all() and (frame[-1, 100:] == 0).all()


def test_without_a_task_the_frame_stays():
    env = TaskCaption(GreyEnv("rgb_array"), key="level")
    env.reset()
    assert np.array_equal(env.render(), GreyEnv().render())


@pytest.mark.parametrize("mode", [None, "human"])
def test_needs_frames(mode):
    with pytest.raises(ValueError, match=f'TaskCaption needs .*render_mode="rgb_array"`, got {mode!r}'):
        TaskCaption(GreyEnv(mode))


def test_a_video_across_a_switch(tmp_path, monkeypatch):
    clips = without_encoder(monkeypatch)
    env = TaskCaption(gym.make("Continual/CartPole-v1", n_tasks=2, steps_per_task=10, render_mode="rgb_array"))
    env = gym.wrappers.RecordVideo(env, str(tmp_path), step_trigger=lambda step: step == 5, video_length=10)
    env.reset(seed=0)
    tasks = []
    for step in range(20):
        *_, terminated, truncated, _ = env.step(step % 2)
        tasks.append(env.unwrapped.task_id)
        if terminated or truncated:
            env.reset()
    env.close()
    ((frames,),) = (call.args for call in clips.call_args_list)
    assert len(frames) == 11

    def is_of(frame, task):
        # Of what is below the caption, nothing is changed
        return np.array_equal(frame, with_caption(frame, f"task {task}"))

    assert [is_of(frame, 0) for frame in frames] == [True] * 5 + [False] * 6
    assert [is_of(frame, 1) for frame in frames] == [False] * 5 + [True] * 6
