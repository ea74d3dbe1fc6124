"""Continual MinAtar and its wrappers."""

import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
import seaborn
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.utils.env_checker import check_env
from minatar import Environment
from stable_baselines3 import DQN
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_cchain import TaskSync
from sb3_cchain.envs import ChannelPadding, ContinualMinAtar, NoRewardLimit, PixelFrames, SeededStickyAction
from tests.envs import CountEnv, RandomEnv

N_CHANNELS = {"Asterix": 4, "Breakout": 4, "Freeway": 7, "Seaquest": 10, "SpaceInvaders": 6}
GAMES = list(N_CHANNELS)
MODULES = {**{game: game.lower() for game in GAMES}, "SpaceInvaders": "space_invaders"}


class Reference:
    """MinAtar driven directly, its observations padded by hand."""

    def __init__(self, game, **kwargs):
        self.game = Environment(MODULES[game], **kwargs)

    def observe(self):
        state = self.game.state()
        return np.concatenate([state, np.zeros((10, 10, 10 - state.shape[2]), dtype=bool)], axis=2)

    def reset(self, seed=None):
        self.game.seed(seed)
        self.game.reset()
        return self.observe()

    def step(self, action):
        reward, done = self.game.act(action)
        return self.observe(), reward, done


def play(env, actions, seed):
    """Observation, reward and end of each step."""
    trace = [env.reset(seed=seed)[0]]
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        trace.append((observation, reward, terminated, truncated))
        if terminated or truncated:
            trace.append(env.reset()[0])
    return trace


def equal(one, other):
    return all(np.array_equal(a, b) for x, y in zip(one, other, strict=True) for a, b in zip(x, y, strict=True))


def random_actions(n_steps, seed=0):
    return np.random.default_rng(seed).integers(6, size=n_steps).tolist()


# --- The environment ------------------------------------------------------------------------------------------------------


def test_defaults_are_the_papers():
    env = gym.make("Continual/MinAtar-v0").unwrapped
    assert env.games == ["SpaceInvaders", "Asterix", "Seaquest"]
    assert [task.spec.id for task in env.tasks] == [f"MinAtar/{game}-v0" for game in env.games]
    assert env.steps_per_task == [1_500_000] * 3
    assert env.observation_space == spaces.Box(0, 1, (10, 10, 10), bool)
    assert env.action_space == spaces.Discrete(6)
    assert all(task.unwrapped.game.sticky_action_prob == 0.1 and task.unwrapped.game.env.ramping for task in env.tasks)
    env = gym.make("Continual/MinAtar-v0", sticky_action_prob=0.25, difficulty_ramping=False).unwrapped
    assert all(task.unwrapped.game.sticky_action_prob == 0.25 and not task.unwrapped.game.env.ramping for task in env.tasks)


@pytest.mark.parametrize("settings", [{}, {"sticky_action_prob": 0.5, "difficulty_ramping": False}])
def test_games_are_minatars_own_and_switch_in_time(settings):
    games = [*GAMES, "Breakout"]
    lengths = [300, 50, 200, 350, 250, 60]
    env = ContinualMinAtar(games, steps_per_task=lengths, **settings)
    rng, _ = seeding.np_random(7)
    observation, _ = env.reset(seed=7)
    for task_id, (game, length) in enumerate(zip(games, lengths, strict=True)):
        # Each game is seeded once, the first with the seed itself
        reference = Reference(game, **settings)
        expected, done, episode_return = reference.reset(7 if task_id == 0 else int(rng.integers(2**31))), False, 0
        for step, action in enumerate(random_actions(length, seed=task_id), start=1):
            assert np.array_equal(observation, expected)
            assert observation.dtype == bool and not observation[..., N_CHANNELS[game] :].any()
            observation, reward, terminated, truncated, info = env.step(action)
            expected, expected_reward, done = reference.step(action)
            episode_return += expected_reward
            assert type(reward) is float and (reward, terminated) == (expected_reward, done)
            assert truncated == (step == length and task_id < 5)
            assert info == {"task_id": task_id, "task_reward": reward, "episode_return": episode_return}
            if terminated or truncated:
                observation, _ = env.reset()
                expected, episode_return = reference.reset(), 0


def test_other_numbers_of_channels():
    assert ContinualMinAtar(["Asterix", "SpaceInvaders"], n_channels=6).observation_space.shape == (10, 10, 6)
    assert ContinualMinAtar(["Seaquest"], n_channels=np.int64(12)).reset(seed=0)[0].shape == (10, 10, 12)


@pytest.mark.parametrize(
    "kwargs, error, message",
    [
        (
            {"games": ["Pong"]},
            ValueError,
            "Unknown game 'Pong' in `games`.* Asterix, Breakout, Freeway, Seaquest, SpaceInvaders",
        ),
        ({"games": ["Asterix", "space_invaders"]}, ValueError, "Unknown game 'space_invaders' in `games`"),
        ({"games": [3]}, ValueError, "Unknown game 3 in `games`"),
        ({"games": "Asterix"}, TypeError, "`games` must be a list of games, got the string 'Asterix'"),
        ({"games": 5}, TypeError, "`games` must be a list of games, got 5"),
        ({"games": []}, ValueError, "must name at least one task, got an empty list"),
        ({"steps_per_task": [10, 10]}, ValueError, r"`steps_per_task` must be one number or one per task \(3\)"),
        ({"n_channels": 9}, ValueError, "`n_channels` must be at least 10, the channels of .*MinAtar/Seaquest-v0.*, got 9"),
        ({"n_channels": 10.0}, ValueError, "`n_channels` must be an integer .* got 10.0"),
        ({"n_channels": "10"}, ValueError, "`n_channels` must be an integer .* got '10'"),
        ({"sticky_action_prob": 1.1}, ValueError, "`sticky_action_prob` must be a number between 0 and 1, got 1.1"),
        ({"sticky_action_prob": -0.1}, ValueError, "`sticky_action_prob` must be .* got -0.1"),
        ({"sticky_action_prob": None}, ValueError, "`sticky_action_prob` must be .* got None"),
        ({"first_task": 3}, ValueError, "`first_task` must be an integer between 0 and 2, got 3"),
    ],
)
def test_bad_arguments(kwargs, error, message):
    with pytest.raises(error, match=message):
        gym.make("Continual/MinAtar-v0", **kwargs)


def test_missing_package_says_what_mends_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "minatar", None)
    monkeypatch.setitem(sys.modules, "minatar.gym", None)
    with pytest.raises(ImportError, match=r'MinAtar is not installed: pip install "sb3-cchain\[minatar\]"'):
        gym.make("Continual/MinAtar-v0")


@pytest.mark.parametrize("registered", [False, True])
def test_no_warnings(monkeypatch, registered):
    ContinualMinAtar()
    for env_id in [] if registered else [env_id for env_id in gym.registry if env_id.startswith("MinAtar/")]:
        monkeypatch.delitem(gym.registry, env_id)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gym.make("Continual/MinAtar-v0", games=GAMES, steps_per_task=2, render_mode="rgb_array")
        for _ in GAMES:
            env.reset(seed=0)
            for _ in range(2):
                env.step(env.action_space.sample())
                env.render()
        env.close()


# --- Seeding --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("game", GAMES)
def test_a_seeded_reset_determines_all_that_follows(game):
    arguments = dict(games=[game], sticky_action_prob=0.9)
    used = ContinualMinAtar(**arguments)
    for seed in range(9):
        play(used, random_actions(500, seed=10 + seed), seed=None)
        for _ in range(20):
            used.step(1 + seed % 3)  # so that the last action is not "no operation"
        actions = random_actions(300, seed)
        assert equal(play(used, actions, seed), play(ContinualMinAtar(**arguments), actions, seed))
    assert not equal(play(used, actions, 0), play(used, actions, 1))


def test_the_last_action_survives_a_reset_without_a_seed():
    env = SeededStickyAction(gym.make(gym.spec("MinAtar/Asterix-v0"), sticky_action_prob=0.0))
    env.reset(seed=0)
    env.step(3)
    env.reset()
    assert env.unwrapped.game.last_action == 3
    env.reset(seed=0)
    assert env.unwrapped.game.last_action == 0


# --- Channels -------------------------------------------------------------------------------------------------------------


def boolean_env(n_channels=2):
    return RandomEnv(spaces.Box(0, 1, (3, 4, n_channels), bool))


def test_padding():
    plain, padded = boolean_env(), ChannelPadding(boolean_env(), 5)
    assert padded.observation_space == spaces.Box(0, 1, (3, 4, 5), bool)
    kept = []
    for own, observation in [
        (plain.reset(seed=1)[0], padded.reset(seed=1)[0]),
        *((plain.step(0)[0], padded.step(0)[0]) for _ in range(3)),
    ]:
        assert observation in padded.observation_space and own.any()
        kept.append((own, observation))
    # After all steps: the arrays are not one that is used again
    for own, observation in kept:
        assert np.array_equal(observation[..., :2], own) and not observation[..., 2:].any()


def test_padding_to_the_same_number_changes_nothing():
    plain, padded = boolean_env(), ChannelPadding(boolean_env(), 2)
    assert padded.observation_space == plain.observation_space
    assert np.array_equal(plain.reset(seed=1)[0], padded.reset(seed=1)[0])


def test_padding_refuses_what_it_cannot_pad():
    with pytest.raises(ValueError, match="`n_channels` must be at least 2, the channels of <RandomEnv instance>, got 1"):
        ChannelPadding(boolean_env(), 1)
    for space in (spaces.Box(0, 1, (3, 4, 2), np.float32), spaces.Box(0, 1, (4,), bool), spaces.Discrete(3)):
        with pytest.raises(TypeError, match="needs boolean Box observations"):
            ChannelPadding(RandomEnv(space), 5)


# --- Episodes without reward ----------------------------------------------------------------------------------------------


class Rewards(gym.Env):
    """Rewards from a list, which ends the episode."""

    observation_space = action_space = spaces.Discrete(1)

    def __init__(self, rewards):
        self.rewards = rewards

    def reset(self, *, seed=None, options=None):
        self.left = list(self.rewards)
        return 0, {}

    def step(self, action):
        return 0, self.left.pop(0), not self.left, False, {}


@pytest.mark.parametrize(
    "rewards, truncated",
    [
        ([0, 0, 0, 0, 0], [False, False, True, True, True]),
        ([1, 0, 0, 0, 0], [False, False, False, True, True]),
        ([-1, 0, 0, 1, 0], [False] * 5),
        ([0, 0, 1, 0, 0], [False] * 5),
        ([0, 0, 0, 1, 0], [False, False, True, False, False]),
        ([0, 0], [False] * 2),
    ],
)
def test_no_reward_limit(rewards, truncated):
    env = NoRewardLimit(Rewards(rewards), 3)
    for _ in range(2):  # counted from 0 in each episode
        env.reset()
        assert [env.step(0)[3] for _ in rewards] == truncated


def test_no_reward_limit_needs_a_number():
    with pytest.raises(ValueError, match="`n_steps` must be an integer greater than or equal to 1, got 0"):
        NoRewardLimit(CountEnv(), 0)


def test_seaquest_alone_is_cut_after_1000_steps_without_reward():
    env = ContinualMinAtar(["Seaquest"], sticky_action_prob=0.0)
    for _ in range(2):
        env.reset(seed=0)
        ends = [env.step(0)[2:4] for _ in range(1000)]  # waits at the surface
        assert ends == [(False, False)] * 999 + [(False, True)]
    env = ContinualMinAtar(["Freeway"], sticky_action_prob=0.0)
    env.reset(seed=0)
    ends = [env.step(0)[2:4] for _ in range(2501)]  # waits at the roadside until the game's own end
    assert ends == [(False, False)] * 2500 + [(True, False)]


# --- Frames ---------------------------------------------------------------------------------------------------------------


def test_frames():
    env = ContinualMinAtar(["Breakout"], render_mode="rgb_array")
    env.reset(seed=0)
    observation, *_ = env.step(0)
    frame = env.render()
    assert frame.shape == (160, 160, 3) and frame.dtype == np.uint8
    # The palette has a colour per channel of the game, the padding has none; the highest channel is on top
    palette = np.round(255 * np.array([(0, 0, 0), *seaborn.color_palette("cubehelix", 4)]))
    for row in range(10):
        for column in range(10):
            channels = np.flatnonzero(observation[row, column])
            colour = palette[channels.max() + 1 if channels.size else 0]
            cell = frame[16 * row : 16 * row + 16, 16 * column : 16 * column + 16]
            assert (cell == colour).all()
    assert len(np.unique(frame.reshape(-1, 3), axis=0)) == 4  # nothing, paddle, ball, bricks, which hide the trail
    assert env.metadata == {"render_modes": ["human", "rgb_array"], "render_fps": 20}


def test_scale_of_frames():
    env = gym.make(gym.spec("MinAtar/Asterix-v0"), disable_env_checker=True, render_mode="rgb_array")
    env = PixelFrames(env, scale=3)
    env.reset()
    assert env.render().shape == (30, 30, 3)
    with pytest.raises(ValueError, match="`scale` must be an integer greater than or equal to 1, got 0"):
        PixelFrames(env, scale=0)


# --- With Stable-Baselines3 -----------------------------------------------------------------------------------------------


def test_checkers():
    check_env(gym.make("Continual/MinAtar-v0", steps_per_task=20).unwrapped, skip_render_check=True)
    for game in GAMES:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            sb3_check_env(ContinualMinAtar([game], render_mode="rgb_array"))
        # The checker takes all arrays of three dimensions for the images of its CNN policy, and has nothing else to say
        assert all("image" in str(warning.message) for warning in caught)


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_dqn_learns_over_a_switch(vec_env_cls):
    arguments = dict(games=["Breakout", "SpaceInvaders"], steps_per_task=60, n_channels=8)
    env = make_vec_env(ContinualMinAtar, n_envs=2, seed=0, vec_env_cls=vec_env_cls, env_kwargs=arguments)
    model = DQN("MlpPolicy", env, buffer_size=200, learning_starts=20, batch_size=8, device="cpu", seed=0)
    model.learn(120, callback=TaskSync())
    env.close()
    observations = model.replay_buffer.observations
    assert observations.dtype == bool and model.replay_buffer.pos == 60
    # 30 steps of two environments each; Breakout has 4 channels and SpaceInvaders 6
    assert not observations[:30, ..., 4:].any() and not observations[30:60, ..., 6:].any()
    assert observations[:30, ..., 3].any(axis=(-2, -1)).all()  # Breakout's bricks
    aliens = observations[30:60, ..., 1]
    assert (aliens.sum(axis=(-2, -1)) > 1).all()  # where Breakout has one ball
