"""Continual ProcGen, its game and its vectorised environment."""

import gc
import sys
import warnings
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.utils.env_checker import check_env
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecMonitor, VecNormalize

from sb3_cchain import CChainPPO, TaskSync
from sb3_cchain.envs import ContinualProcgen, ContinualProcgenVecEnv, ProcgenGame
from sb3_cchain.envs.procgen import DISTRIBUTION_MODES, GAMES
from sb3_cchain.envs.registration import CONTINUAL_ENVS
from sb3_cchain.tasks.continual import is_continual

# Of the whole module, as there are no wheels for Python 3.13
procgen = pytest.importorskip("procgen")

NAMES = {
    **{"BigFish": "bigfish", "BossFight": "bossfight", "CaveFlyer": "caveflyer", "Chaser": "chaser"},
    **{"Climber": "climber", "CoinRun": "coinrun", "Dodgeball": "dodgeball", "FruitBot": "fruitbot"},
    **{"Heist": "heist", "Jumper": "jumper", "Leaper": "leaper", "Maze": "maze"},
    **{"Miner": "miner", "Ninja": "ninja", "Plunder": "plunder", "Starpilot": "starpilot"},
}
SETTINGS = dict(n_steps=16, batch_size=16, n_epochs=1, device="cpu", seed=0)


class Reference:
    """Procgen driven directly."""

    def __init__(self, game, level=20, num_levels=1, rand_seed=0, num=1, **kwargs):
        self.game = procgen.ProcgenGym3Env(
            num, game, start_level=level, num_levels=num_levels, rand_seed=rand_seed, num_threads=0, **kwargs
        )

    def observe(self):
        return self.game.observe()[1]["rgb"][0]

    def step(self, action):
        self.game.act(np.array([action]))
        (reward,), _, (done,) = self.game.observe()
        return self.observe(), reward, done


def rand_seed(seed):
    """What a game makes of a seed."""
    return int(seeding.np_random(seed)[0].integers(2**31))


def random_actions(n_steps, seed=0, size=()):
    return np.random.default_rng(seed).integers(15, size=(n_steps, *size))


def play(env, actions, seed=None):
    """Observations and the rest of each step, with a reset after each end."""
    observations, rest = [env.reset(seed=seed)[0]], []
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        observations.append(observation)
        rest.append((reward, terminated, truncated))
        if terminated or truncated:
            observations.append(env.reset()[0])
    return np.array(observations), rest


def level(env):
    """Of the present episode."""
    return int(env.unwrapped._game.get_info()[0]["level_seed"])


# --- The game -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("game", GAMES)
@pytest.mark.parametrize("num_levels", [1, 0])
def test_a_game_is_procgens_own(game, num_levels):
    env = ProcgenGame(game, start_level=20, num_levels=num_levels)
    reference = Reference(game, 20, num_levels, rand_seed(3))
    observation, info = env.reset(seed=3)
    expected = reference.observe()
    assert np.array_equal(observation, expected) and info == {}
    for action in random_actions(120):
        before = observation
        observation, reward, terminated, truncated, info = env.step(action)
        expected, expected_reward, done = reference.step(action)
        assert type(reward) is float and (reward, terminated, truncated, info) == (expected_reward, done, False, {})
        # At an end procgen shows the next episode; the observation is the last one of that which ended
        assert np.array_equal(observation, before if done else expected)
        if done:
            # That no episode is left out is seen in the levels and in the steps to come
            observation, _ = env.reset()
            assert np.array_equal(observation, expected)
    assert observation in env.observation_space
    env.close()


def test_arrays_are_not_used_again():
    env = ProcgenGame("starpilot")
    kept = [env.reset(seed=0)[0]]
    copies = [kept[0].copy()]
    for action in random_actions(300):
        observation, _, terminated, *_ = env.step(action)
        for array in [observation, *([env.reset()[0]] if terminated else [])]:
            kept.append(array)
            copies.append(array.copy())
    assert all(np.array_equal(one, other) for one, other in zip(kept, copies, strict=True))
    assert len({array.ctypes.data for array in kept}) == len(kept)


def test_every_reset_begins_the_next_of_procgens_episodes():
    env, reference = ProcgenGame("maze"), Reference("maze", 0, 0, rand_seed(5))
    env.reset(seed=5)
    levels = [level(env)]
    for n_steps in (0, 1, 7, 0, 2):
        for _ in range(n_steps):
            assert not env.step(4)[2]
        observation, _ = env.reset()
        expected, _, done = reference.step(-1)
        levels.append(level(env))
        assert done and np.array_equal(observation, expected)
        assert levels[-1] == reference.game.get_info()[0]["level_seed"]
    assert len(set(levels)) == len(levels)


def test_an_episode_after_a_reset_in_the_middle_is_a_whole_one():
    actions = random_actions(30, seed=1)
    env = ProcgenGame("climber", start_level=20, num_levels=1)
    whole, _ = play(env, actions)
    for n_steps in (1, 10):
        play(env, actions[:n_steps])
        assert np.array_equal(play(env, actions)[0], whole)


@pytest.mark.parametrize("game", GAMES)
def test_one_level_leaves_nothing_to_chance(game):
    actions = random_actions(60, seed=2)
    one, other = (ProcgenGame(game, start_level=21, num_levels=1) for _ in range(2))
    first = play(one, actions, seed=1)
    plays = [play(one, actions, seed=2), play(other, actions, seed=3)]
    if game != "dodgeball":
        plays += [play(one, actions), play(other, actions)]
    for again in plays:
        assert np.array_equal(again[0], first[0]) and again[1] == first[1]


def test_a_seed_makes_dodgeballs_player_forget_where_it_faced():
    left, none = 1, 4
    env = ProcgenGame("dodgeball", start_level=20, num_levels=1)
    fresh, _ = play(env, [none, none])
    play(env, [left])
    carried_over, _ = play(env, [none, none])
    assert np.array_equal(carried_over[0], fresh[0]) and not np.array_equal(carried_over[1], fresh[1])
    play(env, [left])
    assert np.array_equal(play(env, [none, none], seed=0)[0], fresh)


def test_seeds_determine_the_levels():
    def levels(env, seed):
        found = []
        for _ in range(8):
            env.reset(seed=seed)
            seed = None
            found.append(level(env))
        return found

    env = ProcgenGame("maze")
    once = levels(env, 1)
    assert once == levels(env, 1) == levels(ProcgenGame("maze"), 1) != levels(env, 2)
    assert levels(env, 2**40)  # procgen's own seeds are smaller
    assert levels(ProcgenGame("maze"), None) != levels(ProcgenGame("maze"), None)
    few = ProcgenGame("maze", start_level=7, num_levels=2)
    assert set(levels(few, 1) + levels(few, 2)) == {7, 8}


def test_frames():
    env = ProcgenGame("starpilot", start_level=20, num_levels=1, render_mode="rgb_array")
    assert env.render() is None
    observation, _ = env.reset()
    frames = []
    for action in random_actions(60):
        before = env.render()
        assert before.shape == (512, 512, 3) and before.dtype == np.uint8
        for row, column in ((0, 0), (3, 5), (7, 7)):
            assert np.array_equal(before[row::8, column::8], observation)
        frames.append(before)
        observation, _, terminated, _, _ = env.step(action)
        if terminated:
            assert np.array_equal(env.render(), before)
            env.reset()
            assert np.array_equal(env.render(), frames[0])
            break
    assert terminated and all((one != other).any() for one, other in pairwise(frames))
    assert ProcgenGame("starpilot").render() is None


def test_a_game_must_be_reset_and_may_be_closed():
    env = ProcgenGame("starpilot", start_level=20, num_levels=1)
    with pytest.raises(gym.error.ResetNeeded, match="Call reset"):
        env.step(0)
    first, _ = env.reset()
    while not env.step(4)[2]:
        pass
    with pytest.raises(gym.error.ResetNeeded, match="Call reset"):
        env.step(0)
    env.close()
    env.close()
    assert np.array_equal(env.reset()[0], first)
    # -1 would be procgen's own reset
    for action in (-1, 15):
        with pytest.raises(ValueError, match=rf"An action must be an integer between 0 and 14, got {action}"):
            env.step(action)


@pytest.mark.parametrize(
    "kwargs, message",
    [
        ({"start_level": -1}, "`start_level` must be an integer between 0 and .* got -1"),
        ({"start_level": 2**31 - 1, "num_levels": 1}, "`start_level` must be .* got 2147483647"),
        ({"num_levels": -1}, "`num_levels` must be .* got -1"),
        ({"num_levels": 1.0}, "`num_levels` must be an integer .* got 1.0"),
        ({"render_mode": "human"}, "`render_mode` must be None or 'rgb_array', got 'human'"),
    ],
)
def test_bad_arguments_of_a_game(kwargs, message):
    with pytest.raises(ValueError, match=message):
        ProcgenGame("starpilot", **kwargs)


def test_distribution_modes():
    assert DISTRIBUTION_MODES["extreme"] == ("chaser", "dodgeball", "leaper", "starpilot")
    assert DISTRIBUTION_MODES["memory"] == ("caveflyer", "dodgeball", "heist", "jumper", "maze", "miner")
    for mode, games in DISTRIBUTION_MODES.items():
        for game in GAMES:
            if game not in games:
                with pytest.raises(
                    ValueError, match=f"`distribution_mode` must be one of easy, hard.* for {game}, got '{mode}'"
                ):
                    ProcgenGame(game, distribution_mode=mode)
                continue
            # Procgen would end the process if it were not one of its modes
            env = ProcgenGame(game, start_level=20, num_levels=1, distribution_mode=mode)
            assert np.array_equal(env.reset()[0], Reference(game, distribution_mode=mode).observe())


# --- The environment ------------------------------------------------------------------------------------------------------


def test_the_sixteen_are_registered():
    own = {name for name, entry in CONTINUAL_ENVS.items() if "ContinualProcgen" in entry["entry_point"]}
    assert own == {f"{name}-v0" for name in NAMES}
    assert sorted(GAMES) == sorted(NAMES.values()) == sorted(procgen.env.ENV_NAMES)
    for name, game in NAMES.items():
        env = gym.make(f"Continual/{name}-v0")
        assert env.unwrapped.game == game
        observation, _ = env.reset()
        assert np.array_equal(observation, Reference(game, 20).observe())
        env.close()


def test_defaults_are_the_papers():
    env = gym.make("Continual/Starpilot-v0").unwrapped
    assert env.n_tasks == 5 and env.steps_per_task == [2_000_000] * 5
    assert [list(levels) for levels in env.levels] == [[20], [21], [22], [23], [24]]
    assert env.observation_space == spaces.Box(0, 255, (64, 64, 3), np.uint8)
    assert env.action_space == spaces.Discrete(15)
    env.set_task(3)
    assert np.array_equal(env.reset()[0], Reference("starpilot", 23).observe())
    hard, easy = (Reference("maze", 20, distribution_mode=mode).observe() for mode in ("hard", "easy"))
    observation, _ = gym.make("Continual/Maze-v0").reset()
    assert np.array_equal(observation, hard) and not np.array_equal(observation, easy)
    assert np.array_equal(ContinualProcgen("maze", distribution_mode="easy").reset()[0], easy)
    assert np.array_equal(ContinualProcgenVecEnv("maze", 1, distribution_mode="easy").reset()[0], easy)


def test_switches_in_time_with_procgens_own_episodes():
    lengths = [90, 13, 100]
    env = ContinualProcgen("starpilot", n_tasks=3, steps_per_task=lengths, first_level=30)
    observation, _ = env.reset(seed=7)
    n_ends = 0
    for task_id, length in enumerate(lengths):
        reference = Reference("starpilot", 30 + task_id)
        expected, episode_return = reference.observe(), 0.0
        for step, action in enumerate(random_actions(length, seed=task_id), start=1):
            assert np.array_equal(observation, expected)
            before = observation
            observation, reward, terminated, truncated, info = env.step(action)
            expected, expected_reward, done = reference.step(action)
            episode_return += expected_reward
            assert (reward, terminated) == (expected_reward, done)
            assert truncated == (step == length and task_id < 2)
            assert info == {"task_id": task_id, "task_reward": reward, "episode_return": episode_return}
            # A switch ends no episode of procgen's, so there the observation is the true one
            assert np.array_equal(observation, before if done else expected)
            if terminated or truncated:
                n_ends += 1
                observation, _ = env.reset()
                episode_return = 0.0
    assert n_ends >= 4
    env.close()


def test_levels_per_task():
    env = ContinualProcgen("maze", n_tasks=2, first_level=3, num_levels=4)
    assert env.levels == [range(3, 7), range(7, 11)]
    assert env.task_sequence == [("maze", 3, 4), ("maze", 7, 4)]
    for task_id in range(2):
        env.set_task(task_id)
        found = set()
        for seed in range(30):
            env.reset(seed=seed)
            found.add(level(env.task))
        assert found == set(env.levels[task_id])
    assert ContinualProcgen("maze", n_tasks=np.int64(2), first_level=np.int64(3), num_levels=np.int64(1)).reset(seed=0)


@pytest.mark.parametrize(
    "kwargs, message",
    [
        ({"game": "Starpilot"}, "`game` must be one of bigfish, bossfight, .* starpilot, got 'Starpilot'"),
        ({"game": ["maze"]}, r"`game` must be one of .* got \['maze'\]"),
        (
            {"distribution_mode": "medium"},
            "`distribution_mode` must be one of easy, hard, extreme for starpilot, got 'medium'",
        ),
        (
            {"distribution_mode": "memory"},
            "`distribution_mode` must be one of easy, hard, extreme for starpilot, got 'memory'",
        ),
        ({"distribution_mode": "exploration"}, "`distribution_mode` must not be 'exploration'.*on one certain level"),
        ({"first_level": -1}, "`first_level` must be an integer between 0 and .* got -1"),
        ({"first_level": 2**31}, "`first_level` must be .* got 2147483648"),
        ({"first_level": "20"}, "`first_level` must be an integer .* got '20'"),
        ({"num_levels": 0}, "`num_levels` must be an integer between 1 and .* got 0"),
        ({"n_tasks": 0}, "`n_tasks` must be an integer .* got 0"),
        ({"first_task": 5}, "`first_task` must be an integer between 0 and 4, got 5"),
        ({"steps_per_task": [10, 10]}, r"`steps_per_task` must be one number or one per task \(5\)"),
    ],
)
def test_bad_arguments(kwargs, message):
    with pytest.raises(ValueError, match=message):
        gym.make("Continual/Starpilot-v0", **kwargs)
    with pytest.raises(ValueError, match=message):
        ContinualProcgenVecEnv(**{"game": "starpilot", "n_envs": 2, **kwargs})


@pytest.mark.parametrize("version, wheel", [((3, 12), False), ((3, 13), True)])
def test_missing_package_says_what_mends_it(monkeypatch, version, wheel):
    monkeypatch.setitem(sys.modules, "procgen", None)
    monkeypatch.setattr("sb3_cchain.envs.procgen.sys.version_info", version)
    with pytest.raises(ImportError, match=r'procgen is not installed: pip install "sb3-cchain\[procgen\]"') as error:
        gym.make("Continual/Starpilot-v0")
    assert ("no wheel" in str(error.value)) == wheel
    with pytest.raises(ImportError, match="procgen is not installed"):
        ContinualProcgenVecEnv("starpilot", 2)


@pytest.mark.parametrize("name", NAMES)
def test_checkers(name):
    env_id = f"Continual/{name}-v0"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(env_id, steps_per_task=20, render_mode="rgb_array").unwrapped, skip_render_check=True)
        sb3_check_env(gym.make(env_id, steps_per_task=20, render_mode="rgb_array"))
        check_env(ProcgenGame(NAMES[name], render_mode="rgb_array"), skip_render_check=True)


def test_frames_of_the_environment():
    env = gym.make("Continual/Maze-v0", render_mode="rgb_array")
    assert env.metadata == {"render_modes": ["rgb_array"], "render_fps": 15}
    env.reset()
    assert env.render().shape == (512, 512, 3)
    # Gymnasium's own window makes up for the mode "human"
    with pytest.warns(UserWarning, match="HumanRendering wrapper is being applied"):
        assert gym.make("Continual/Maze-v0", render_mode="human").render_mode == "human"


# --- Vectorised -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("num_threads", [0, 3])
def test_vectorised_is_the_same_as_single_ones(num_threads):
    kwargs = dict(game="starpilot", n_tasks=3, steps_per_task=[300, 36, 300], first_level=30)
    own = ContinualProcgenVecEnv(n_envs=4, num_threads=num_threads, **kwargs)
    singles = DummyVecEnv([lambda: ContinualProcgen(n_envs=4, **kwargs) for _ in range(4)])
    assert (own.num_envs, own.observation_space, own.action_space) == (
        (singles.num_envs, singles.observation_space, singles.action_space)
    )
    assert own.seed(3) == singles.seed(3)
    assert np.array_equal(own.reset(), singles.reset())
    ends = {"terminated": 0, "truncated": 0}
    for step, actions in enumerate(random_actions(200, size=(4,)), start=1):
        observations, rewards, dones, infos = own.step(actions)
        expected = singles.step(actions)
        assert np.array_equal(observations, expected[0]) and observations.dtype == np.uint8
        assert np.array_equal(rewards, expected[1]) and rewards.dtype == np.float32
        assert np.array_equal(dones, expected[2]) and dones.dtype == bool
        for info, expected_info in zip(infos, expected[3], strict=True):
            terminal, expected_terminal = info.pop("terminal_observation", 0), expected_info.pop("terminal_observation", 0)
            assert info == expected_info and np.array_equal(terminal, expected_terminal)
            assert {key: type(value) for key, value in info.items()} == {
                key: type(value) for key, value in expected_info.items()
            }
            ends["truncated"] += info["TimeLimit.truncated"]
        ends["terminated"] += sum(dones) - sum(info["TimeLimit.truncated"] for info in infos)
        assert own.reset_infos == [{"task_id": int(step >= 75) + int(step >= 84)}] * 4
        if step == 150:
            assert np.array_equal(own.reset(), singles.reset())  # in the middle
    assert ends["terminated"] > 4 and ends["truncated"] > 4
    own.close()


def test_vectorised_arrays_are_not_used_again():
    env = ContinualProcgenVecEnv("starpilot", 3, steps_per_task=60)
    kept = [env.reset()]
    copies = [kept[0].copy()]
    for actions in random_actions(100, size=(3,)):
        observations, rewards, dones, infos = env.step(actions)
        for array in (observations, rewards, dones, *(info.get("terminal_observation", dones) for info in infos)):
            kept.append(array)
            copies.append(array.copy())
    assert all(np.array_equal(one, other) for one, other in zip(kept, copies, strict=True))


def test_vectorised_arrays_may_be_written_to():
    env, spoilt = (ContinualProcgenVecEnv("starpilot", 2) for _ in range(2))
    env.reset()
    spoilt.reset()[:] = 0
    n_ends = 0
    for actions in random_actions(150, size=(2,)):
        *_, dones, infos = env.step(actions)
        observations, *_, same_infos = spoilt.step(actions)
        observations[:] = 0
        for index in np.flatnonzero(dones):
            n_ends += 1
            assert np.array_equal(infos[index]["terminal_observation"], same_infos[index]["terminal_observation"])
    assert n_ends > 2


def test_vectorised_instances_draw_their_own_levels():
    env = ContinualProcgenVecEnv("maze", 6, num_levels=1000)

    def trace(seed):
        env.seed(seed)
        steps = [env.reset(), *(env.step(actions)[0] for actions in random_actions(5, size=(6,))), env.reset()]
        return np.array(steps)

    one = trace(1)
    assert np.array_equal(one, trace(1)) and not np.array_equal(one, trace(2))
    assert len({observation.tobytes() for observation in one[0]}) == 6
    assert (one[0] != one[-1]).any(axis=(1, 2, 3)).all()  # a reset begins another episode


def test_vectorised_interface():
    env = ContinualProcgenVecEnv("maze", 3, n_tasks=4, steps_per_task=30, first_task=1, render_mode="rgb_array")
    assert is_continual(env) and not env.has_attr("games")
    assert env.get_attr("task_id") == [1, 1, 1] and env.get_attr("n_tasks", indices=0) == [4]
    assert env.get_attr("steps_per_task", indices=[0, 2]) == [[30] * 4] * 2
    assert env.env_is_wrapped(gym.Wrapper) == [False] * 3
    with pytest.raises(gym.error.ResetNeeded):
        env.step([0, 0, 0])
    observations = env.reset()
    given = env.reset()
    given[:] = 0  # the environment keeps its own
    assert all(np.array_equal(image, observation) for image, observation in zip(env.get_images(), observations, strict=True))
    assert env.render().shape[2] == 3
    for actions in ([0, 0], [0, -1, 0], [0, 15, 0]):
        with pytest.raises(ValueError, match="Actions must be 3 integers between 0 and 14"):
            env.step(actions)
    with pytest.raises(NotImplementedError, match="`task_id` cannot be set"):
        env.set_attr("task_id", 2)
    with pytest.raises(AttributeError, match="got 'reset'"):
        env.env_method("reset")
    with pytest.raises(ValueError, match="`n_envs` must be an integer greater than or equal to 1, got 0"):
        ContinualProcgenVecEnv("maze", 0)
    with pytest.raises(ValueError, match=r"`num_threads` must be .* got -1"):
        ContinualProcgenVecEnv("maze", 1, num_threads=-1)
    plain = ContinualProcgenVecEnv("maze", 2)
    with pytest.warns(UserWarning, match="need render_mode='rgb_array'"):
        assert plain.get_images() == [None, None]
    env.close()
    env.close()
    assert np.array_equal(env.reset(), observations)


def test_vectorised_clock():
    env = ContinualProcgenVecEnv("maze", 2, n_tasks=3, steps_per_task=20)
    first = [Reference("maze", 20 + task).observe() for task in range(3)]
    assert np.array_equal(env.reset()[1], first[0])
    # Told the time, it goes on with that task at the next reset, and with the next one in time
    assert env.env_method("set_clock", 30, 2) == [True, True]
    assert env.get_attr("task_id") == [0, 0]
    assert np.array_equal(env.reset()[1], first[1])
    assert env.env_method("set_clock", 30, 2, indices=0) == [False]
    for step in range(1, 6):
        observations, _, dones, infos = env.step([4, 4])
        assert dones.all() == (step == 5) and infos[0]["task_id"] == 1
    assert np.array_equal(observations[0], first[2]) and env.get_attr("task_id") == [2, 2]
    # Without a reset the switch comes with the next step
    env.env_method("set_clock", 0, 2)
    observations, _, dones, infos = env.step([4, 4])
    assert dones.all() and infos[1]["task_id"] == 2 and np.array_equal(observations[0], first[0])
    # Put on a task it stays there, from the next reset on
    env.env_method("set_task", 1)
    _, _, dones, infos = env.step([4, 4])
    assert infos[0]["task_id"] == 0 and not dones.any()
    assert np.array_equal(env.reset()[0], first[1])
    assert all(env.step([4, 4])[3][0]["task_id"] == 1 for _ in range(40))


# --- Training -------------------------------------------------------------------------------------------------------------


class Record(BaseCallback):
    """The task of each step."""

    def _on_training_start(self):
        self.tasks = {}

    def _on_step(self):
        self.tasks[self.num_timesteps] = {info["task_id"] for info in self.locals["infos"]}
        return True


def vectorised(**kwargs):
    return ContinualProcgenVecEnv("starpilot", 2, **kwargs)


def dummy(**kwargs):
    return make_vec_env("Continual/Starpilot-v0", n_envs=2, env_kwargs=kwargs)


@pytest.mark.filterwarnings("ignore:Training and eval env are not of the same type")
@pytest.mark.parametrize("make", [vectorised, dummy])
def test_learning_over_a_switch(make):
    record, eval_env = Record(), make(steps_per_task=64)
    on_eval = EvalCallback(eval_env, eval_freq=16, n_eval_episodes=1, verbose=0, warn=False)
    model = CChainPPO("CnnPolicy", make(steps_per_task=64), **SETTINGS)
    model.learn(96, callback=[record, on_eval])
    assert record.tasks == {step: {int(step > 64)} for step in range(2, 98, 2)}
    assert eval_env.get_attr("task_id") == [1, 1]  # followed
    # Going on in a new environment
    model.set_env(make(steps_per_task=64))
    model.learn(64, callback=record, reset_num_timesteps=False)
    assert record.tasks == {step: {1 if step <= 128 else 2} for step in range(98, 162, 2)}


def test_other_algorithms_and_wrappers():
    env = VecNormalize(VecMonitor(VecFrameStack(vectorised(steps_per_task=64), 2)), norm_obs=False)
    record = Record()
    model = PPO("CnnPolicy", env, **SETTINGS)
    model.learn(96, callback=[TaskSync(), record])
    assert record.tasks == {step: {int(step > 64)} for step in range(2, 98, 2)}
    assert model.ep_info_buffer
    returns, lengths = evaluate_policy(model, env, n_eval_episodes=2, return_episode_rewards=True)
    assert returns[0] == returns[1] and lengths[0] == lengths[1]  # one level, one policy, one episode


def test_in_a_process_of_its_own():
    kwargs = dict(game="starpilot", n_tasks=2, steps_per_task=20)
    own = ContinualProcgenVecEnv(n_envs=1, **kwargs)
    other = SubprocVecEnv([lambda: ContinualProcgen(**kwargs)])
    assert np.array_equal(own.reset(), other.reset())
    for actions in random_actions(30, size=(1,)):
        assert np.array_equal(own.step(actions)[0], other.step(actions)[0])
    other.close()


@pytest.mark.parametrize("enabled", [True, False])
def test_the_garbage_collector_does_not_run_while_a_game_is_made(monkeypatch, enabled):
    """It could close another game while cffi holds its lock, which would wait for ever."""
    collects, looked_up = [], []

    class Library:
        def __getattr__(self, name):
            looked_up.append((name, gc.isenabled()))

    class Game:
        def __init__(self, **kwargs):
            collects.append(gc.isenabled())
            self._c_lib = Library()

    game = ProcgenGame("starpilot")
    monkeypatch.setattr("sb3_cchain.envs.procgen._import_procgen", lambda: Game)
    try:
        if not enabled:
            gc.disable()
        game.launch(1, 0)
        assert gc.isenabled() == enabled
    finally:
        gc.enable()
    assert collects == [False] and looked_up == [("libenv_close", False)]
