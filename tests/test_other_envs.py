"""The environments that the paper does not have: Slippery Ant, MiniGrid, Atari, sequences of any environments."""

import pickle
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.env_util import make_vec_env

from sb3_cchain import ContinualEnv, ContinualMetrics, TaskSync, TrainingCheckpoint
from sb3_cchain.envs import AtariTask, CommonSpaces, ContinualSequence
from sb3_cchain.envs.registration import OTHER_ENVS
from tests.envs import CountEnv, RandomEnv

ROOT = Path(__file__).parent.parent
# The package that each needs, and arguments for short episodes
PACKAGES = {"SlipperyAnt-v0": "mujoco", "MiniGrid-v0": "minigrid", "Atari-v0": "ale_py", "Sequence-v0": None}
ARGUMENTS = {"SlipperyAnt-v0": dict(n_tasks=3), "Atari-v0": dict(tasks=["Pong", {"game": "Freeway", "mode": 1}])}
ALL = pytest.mark.parametrize("name", OTHER_ENVS)


def make(name, **kwargs):
    if PACKAGES[name] is not None:
        pytest.importorskip(PACKAGES[name])
    return gym.make(f"Continual/{name}", **{**ARGUMENTS.get(name, {}), **kwargs})


def actions_of(env, n_steps):
    env.action_space.seed(3)
    return [env.action_space.sample() for _ in range(n_steps)]


def play(env, n_steps, seed):
    """Observations, rewards and tasks."""
    trace = [env.reset(seed=seed)[0]]
    for action in actions_of(env, n_steps):
        observation, reward, terminated, truncated, info = env.step(action)
        trace += [observation, reward, info["task_id"]]
        if terminated or truncated:
            trace.append(env.reset()[0])
    return trace


@ALL
@pytest.mark.filterwarnings("ignore")
def test_passes_the_checkers(name):
    kwargs = dict(tasks=["Pong"]) if name == "Atari-v0" else {}  # whose seeded resets take long
    check_env(make(name, steps_per_task=40, **kwargs).unwrapped, skip_render_check=True)
    sb3_check_env(make(name, steps_per_task=40, **kwargs))


@ALL
def test_a_seed_determines_all_tasks(name):
    first, same, other = (make(name, steps_per_task=15) for _ in range(3))
    n_steps = 15 * first.unwrapped.n_tasks
    one, two, three = (play(env, n_steps, seed) for env, seed in ((first, 1), (same, 1), (other, 2)))
    assert all(np.array_equal(a, b) for a, b in zip(one, two, strict=True))
    assert len(one) != len(three) or any(not np.array_equal(a, b) for a, b in zip(one, three, strict=True))
    # Also in an environment that has been used before
    first.unwrapped.set_clock(0)
    again = play(first, 10, 1)
    assert all(np.array_equal(a, b) for a, b in zip(one[: len(again)], again, strict=True))


@ALL
def test_spaces_are_those_of_each_task(name):
    env = make(name, steps_per_task=10)
    for task in range(env.unwrapped.n_tasks):
        env.unwrapped.set_task(task)
        observation, info = env.reset(seed=0)
        assert info["task_id"] == task
        for action in actions_of(env, 10):
            assert observation in env.observation_space and observation.dtype == env.observation_space.dtype
            observation, *_ = env.step(action)


@ALL
def test_tasks_are_told_apart_and_come_in_cycles(name):
    once, twice = (make(name, cycles=cycles, steps_per_task=5).unwrapped for cycles in (1, 2))
    assert len({str(task) for task in once.task_sequence}) == once.n_tasks > 1
    assert twice.task_sequence == once.task_sequence * 2 and twice.n_tasks == 2 * once.n_tasks
    assert pickle.loads(pickle.dumps(once.task_sequence)) == once.task_sequence
    twice.set_clock(5 * once.n_tasks)
    assert twice.reset(seed=0)[1]["task_id"] == once.n_tasks


SETTINGS = dict(n_steps=16, batch_size=16, n_epochs=1, device="cpu", policy_kwargs=dict(net_arch=[8]))


@pytest.mark.parametrize("name", [name for name in OTHER_ENVS if name != "Atari-v0"])
def test_ppo_learns_over_a_switch(name):
    env = make_vec_env(make, 2, env_kwargs=dict(name=name, steps_per_task=32))
    model = PPO("MlpPolicy", env, **SETTINGS).learn(64, callback=[TaskSync(), ContinualMetrics()])
    assert {row["task_id"] for row in model.continual_returns} == {0, 1}


@pytest.mark.parametrize("name", [name for name in OTHER_ENVS if PACKAGES[name] is not None])
def test_the_missing_package_is_named(name, monkeypatch):
    for module in [module for module in sys.modules if module.split(".")[0] == PACKAGES[name]]:
        monkeypatch.setitem(sys.modules, module, None)
    for module in [module for module in sys.modules if module.startswith("gymnasium.envs.mujoco")]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, PACKAGES[name], None)
    extra = {"ale_py": "atari"}.get(PACKAGES[name], PACKAGES[name])
    with pytest.raises(ImportError, match=rf'pip install "sb3-cchain\[{extra}\]"'):
        gym.make(f"Continual/{name}")


@ALL
def test_the_command_line_has_settings(name):
    for algo in ("ppo", "ppo_cchain"):
        settings = yaml.safe_load((ROOT / "zoo_hyperparams" / f"{algo}.yml").read_text())[f"Continual/{name}"]
        assert {"policy", "n_timesteps", "callback"} <= settings.keys()
        assert "sb3_cchain.TaskSync" in settings["callback"]


@ALL
@pytest.mark.parametrize(
    "kwargs, message",
    [
        (dict(steps_per_task=0), "`steps_per_task` must be an integer greater than or equal to 1, got 0"),
        (dict(cycles=0), "`cycles` must be .* got 0"),
        (dict(first_task=99), "`first_task` must be an integer between 0 and .*, got 99"),
    ],
)
def test_bad_lengths(name, kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(name, **kwargs)


# --- Slippery Ant -------------------------------------------------------------------------------------------------------


def frictions_now(env):
    return set(env.unwrapped.task.unwrapped.model.geom_friction[:, 0].tolist())


def test_frictions_are_drawn_log_uniformly():
    pytest.importorskip("mujoco")
    env = gym.make("Continual/SlipperyAnt-v0").unwrapped
    assert env.n_tasks == 10 and set(env.steps_per_task) == {2_000_000}
    assert ((env.frictions >= 0.02) & (env.frictions <= 2)).all()
    draws = np.random.default_rng(0).uniform(np.log(0.02), np.log(2), 10)
    assert np.allclose(np.log(env.frictions), draws)
    env.reset(seed=123)
    assert np.array_equal(env.frictions, gym.make("Continual/SlipperyAnt-v0").unwrapped.frictions)
    assert not np.array_equal(env.frictions, gym.make("Continual/SlipperyAnt-v0", friction_seed=1).unwrapped.frictions)


def test_each_task_has_its_friction_and_the_ant_is_gymnasiums():
    pytest.importorskip("mujoco")
    env = gym.make("Continual/SlipperyAnt-v0", n_tasks=2, frictions=[1.0, 0.03], steps_per_task=20)
    plain = gym.make("Ant-v5")
    assert env.observation_space == plain.observation_space and env.action_space == plain.action_space
    assert np.array_equal(env.reset(seed=5)[0], plain.reset(seed=5)[0])
    for action in actions_of(env, 15):
        assert np.array_equal(env.step(action)[0], plain.step(action)[0])
    assert frictions_now(env) == {1.0}
    env.unwrapped.set_task(1)
    assert np.array_equal(env.reset(seed=5)[0], plain.reset(seed=5)[0])
    steps = [(env.step(action)[0], plain.step(action)[0]) for action in actions_of(env, 60)]
    assert frictions_now(env) == {0.03} and not np.array_equal(*steps[-1])


def test_friction_drifts():
    pytest.importorskip("mujoco")
    env = gym.make("Continual/SlipperyAnt-v0", n_tasks=2, frictions=[1.0, 0.01], steps_per_task=8, blend_steps=4)
    env.reset(seed=0)
    seen = []
    for action in actions_of(env, 16):
        _, _, terminated, truncated, _ = env.step(action)
        seen += frictions_now(env)
        if terminated or truncated:
            env.reset()
    assert seen == pytest.approx([1.0] * 8 + [1.0, 10**-0.5, 0.1, 10**-1.5] + [0.01] * 4)


@pytest.mark.parametrize(
    "kwargs, message",
    [
        (dict(n_tasks=0), "`n_tasks` must be an integer .* got 0"),
        (dict(friction_range=(0, 1)), r"`friction_range\[0\]` must be a number greater than 0, got 0"),
        (dict(friction_range=(1, 0.5)), r"`friction_range\[1\]` must be a number greater than or equal to 1, got 0.5"),
        (dict(friction_range=3), "`friction_range` must be two numbers, .* got 3"),
        (dict(friction_seed=-1), "`friction_seed` must be .* got -1"),
        (dict(n_tasks=2, frictions=[1.0]), r"`frictions` must have the shape \(n_tasks,\) = \(2,\), got \(1,\)"),
        (dict(n_tasks=1, frictions=[0.0]), "`frictions` must be finite and greater than 0"),
        (dict(n_tasks=1, frictions=["ice"]), "`frictions` must be an array of numbers, got"),
    ],
)
def test_bad_arguments_of_slippery_ant(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make("SlipperyAnt-v0", **{"n_tasks": 3, **kwargs})


# --- MiniGrid -----------------------------------------------------------------------------------------------------------


def test_what_is_seen_in_minigrid():
    pytest.importorskip("minigrid")
    tasks = ["MiniGrid-Empty-5x5-v0", "MiniGrid-DoorKey-5x5-v0"]
    images, vectors = (gym.make("Continual/MiniGrid-v0", tasks=tasks, observations=kind) for kind in ("image", "one_hot"))
    assert images.observation_space.shape == (7, 7, 3) and vectors.observation_space.shape == (980,)
    assert images.action_space == spaces.Discrete(7)
    plain = gym.make(tasks[0])
    image, vector = images.reset(seed=4)[0], vectors.reset(seed=4)[0].reshape(7, 7, 20)
    assert np.array_equal(image, plain.reset(seed=4)[0]["image"])
    # 11 objects, 6 colours, 3 states
    for part, number in zip(np.split(vector, [11, 17], axis=-1), np.moveaxis(image, -1, 0), strict=True):
        assert np.array_equal(part.argmax(-1), number) and (part.sum(-1) == 1).all()


@pytest.mark.parametrize(
    "kwargs, error, message",
    [
        (
            dict(tasks="MiniGrid-Empty-5x5-v0"),
            TypeError,
            "`tasks` must be a list of ids of MiniGrid's environments, got the str",
        ),
        (dict(tasks=["CartPole-v1"]), ValueError, "`tasks` must be ids of MiniGrid's environments, got 'CartPole-v1'"),
        (dict(tasks=["MiniGrid-Emty-5x5-v0"]), ValueError, "Unknown environment 'MiniGrid-Emty-5x5-v0' in `tasks`: .*Empty"),
        (dict(observations="words"), ValueError, "`observations` must be one of 'one_hot', 'image', got 'words'"),
        (
            dict(tasks=["MiniGrid-Empty-5x5-v0", "MiniGrid-Dynamic-Obstacles-5x5-v0"]),
            ValueError,
            "same action_space, but task 0 .* has Discrete\\(7\\) and task 1 .* has Discrete\\(3\\)",
        ),
    ],
)
def test_bad_arguments_of_minigrid(kwargs, error, message):
    with pytest.raises(error, match=message):
        make("MiniGrid-v0", **kwargs)


# --- Atari --------------------------------------------------------------------------------------------------------------


def test_games_modes_and_difficulties():
    pytest.importorskip("ale_py")
    tasks = ["Pong", {"game": "Freeway", "mode": 3, "difficulty": 1}]
    env = gym.make("Continual/Atari-v0", tasks=tasks, steps_per_task=10).unwrapped
    assert env.atari_tasks == [AtariTask("Pong"), AtariTask("Freeway", 3, 1)]
    assert env.task_sequence == [("Pong", None, None), ("Freeway", 3, 1)]
    games = [task.unwrapped for task in env.tasks]
    assert [(game._game_mode, game._game_difficulty) for game in games] == [(None, None), (3, 1)]
    assert env.action_space == spaces.Discrete(18) and env.observation_space.shape == (4, 84, 84)


def test_learns_without_an_exact_state_of_the_emulator(tmp_path):
    def train(path, **kwargs):
        model = PPO("CnnPolicy", make("Atari-v0", steps_per_task=16), **SETTINGS)
        model.learn(32, callback=[TaskSync(), ContinualMetrics(), TrainingCheckpoint(16, path, **kwargs)])
        return {row["task_id"] for row in model.continual_returns}

    with pytest.raises(ValueError, match="cannot be resumed exactly, because its simulator saves only a part of its state"):
        train(tmp_path / "exact")
    assert train(tmp_path / "not", exact=False) == {0, 1}


@pytest.mark.parametrize(
    "tasks, error, message",
    [
        ("Pong", TypeError, "`tasks` must be a list of games, got the string 'Pong'"),
        (["Pong", 3], ValueError, r"`tasks\[1\]` must be the name of a game, or a mapping of .* got 3"),
        ([{"mode": 1}], ValueError, r"`tasks\[0\]` must be the name of a game, or a mapping"),
        ([{"game": "Pong", "level": 1}], ValueError, r"`tasks\[0\]` must be the name of a game, or a mapping"),
        ([{"game": "Pong", "mode": -1}], ValueError, r"`tasks\[0\]\['mode'\]` must be an integer .* got -1"),
        (
            [{"game": "Freeway", "mode": 99}],
            ValueError,
            "a mode .* that Freeway does not have, .*99.* the modes .0, 1, 2.*difficulties .0, 1",
        ),
        (["Pung"], ValueError, "Unknown game 'Pung' in `tasks`: .*Pong"),
    ],
)
def test_bad_tasks_of_atari(tasks, error, message):
    with pytest.raises(error, match=message):
        make("Atari-v0", tasks=tasks)


# --- Spaces that differ -------------------------------------------------------------------------------------------------


def test_observations_are_padded_with_zeros():
    plain, padded = gym.make("CartPole-v1"), CommonSpaces(gym.make("CartPole-v1"), 6, 3)
    assert padded.observation_space == spaces.Box(-np.inf, np.inf, (6,), np.float32)
    observation = padded.reset(seed=1)[0]
    assert np.array_equal(observation, [*plain.reset(seed=1)[0], 0, 0])
    assert np.array_equal(padded.step(1)[0], [*plain.step(1)[0], 0, 0])


def test_other_observations_are_flattened():
    env = CommonSpaces(RandomEnv(spaces.Discrete(3)), 4, 3)
    assert sorted(env.reset(seed=0)[0].tolist()) == [0, 0, 0, 1]
    nested = spaces.Dict(b=spaces.Box(0, 1, (2, 2)), a=spaces.Discrete(2))
    assert CommonSpaces(RandomEnv(nested), 8, 3).reset(seed=0)[0].shape == (8,)


class Taken(gym.Wrapper):
    """Remembers the action."""

    def step(self, action):
        self.action = action
        return self.env.step(action)


@pytest.mark.parametrize("extra, expected", [("first", [0, 1, 2, 0, 0]), ("wrap", [0, 1, 2, 0, 1])])
@pytest.mark.parametrize("start", [0, 10])
def test_discrete_actions(extra, expected, start):
    inner = Taken(RandomEnv(action_space=spaces.Discrete(3, start=start)))
    env = CommonSpaces(inner, 4, 5, extra)
    assert env.action_space == spaces.Discrete(5)
    env.reset(seed=0)
    taken = []
    for action in range(5):
        env.step(action)
        taken.append(inner.action - start)
    assert taken == expected
    assert env.action_masks().tolist() == [True, True, True, False, False]


def test_continuous_actions():
    inner = Taken(RandomEnv(action_space=spaces.Box(np.float32([-2, 0]), np.float32([2, 4]))))
    env = CommonSpaces(inner, 4, 3)
    assert env.action_space == spaces.Box(-1, 1, (3,), np.float32)
    env.reset(seed=0)
    for action, expected in [([0, 0, 1], [0, 2]), ([-1, 1, 0], [-2, 4]), ([0.5, -0.5, 0], [1, 1]), ([9, -9, 0], [2, 0])]:
        env.step(np.float32(action))
        assert np.allclose(inner.action, expected) and inner.action in inner.action_space
    with pytest.raises(TypeError, match="Only Discrete actions can be masked, got Box"):
        env.action_masks()


def test_a_sequence_takes_the_greatest_sizes():
    env = ContinualSequence(["MountainCar-v0", "Acrobot-v1", "CartPole-v1"], steps_per_task=10)
    assert env.observation_space.shape == (6,) and env.action_space == spaces.Discrete(3)
    masks = []
    for task in range(3):
        env.set_task(task)
        env.reset(seed=0)
        masks.append(env.action_masks().sum())
    assert masks == [3, 3, 2]
    larger = ContinualSequence(["CartPole-v1"], observation_size=9, n_actions=4)
    assert larger.observation_space.shape == (9,) and larger.action_space == spaces.Discrete(4)


def test_maskable_ppo_takes_the_tasks_own_actions_alone():
    contrib = pytest.importorskip("sb3_contrib")
    env = gym.make("Continual/Sequence-v0", env_ids=["CartPole-v1", "Acrobot-v1"], steps_per_task=64)
    model = contrib.MaskablePPO("MlpPolicy", env, n_steps=64, batch_size=64, n_epochs=1, device="cpu", seed=0)
    actions = []
    for _ in range(2):
        model.learn(64, callback=TaskSync(), reset_num_timesteps=False)
        actions.append(set(model.rollout_buffer.actions.flatten().tolist()))
    assert actions == [{0, 1}, {0, 1, 2}]


@pytest.mark.parametrize(
    "make_env, error, message",
    [
        (lambda: CommonSpaces(CountEnv(), 0, 2), ValueError, "`observation_size` must be an integer .* got 0"),
        (lambda: ContinualSequence(observation_size=0), ValueError, "`observation_size` must be an integer .* got 0"),
        (lambda: ContinualSequence(n_actions=0), ValueError, "`n_actions` must be an integer .* got 0"),
        (
            lambda: CommonSpaces(gym.make("CartPole-v1"), 3, 2),
            ValueError,
            "`observation_size` must be at least 4, what .*CartPole",
        ),
        (lambda: CommonSpaces(CountEnv(), 1, 1), ValueError, "`n_actions` must be at least 2, what .*CountEnv.* has, got 1"),
        (
            lambda: CommonSpaces(CountEnv(), 1, 2, "last"),
            ValueError,
            "`extra_actions` must be one of 'first', 'wrap', got 'last'",
        ),
        (
            lambda: CommonSpaces(RandomEnv(action_space=spaces.MultiBinary(2)), 4, 4),
            TypeError,
            "needs actions that are Discrete or a bounded one-dimensional Box, .* has MultiBinary",
        ),
        (
            lambda: CommonSpaces(RandomEnv(action_space=spaces.Box(-1, np.inf, (1,))), 4, 4),
            TypeError,
            "needs actions that are Discrete or a bounded one-dimensional Box, .* has Box",
        ),
        (
            lambda: CommonSpaces(RandomEnv(spaces.Sequence(spaces.Discrete(2))), 4, 3),
            TypeError,
            "needs observations that can be",
        ),
        (lambda: ContinualSequence("CartPole-v1"), TypeError, "`env_ids` must be a list of environment ids"),
        (lambda: ContinualSequence(["CartPol-v1"]), ValueError, "Unknown environment 'CartPol-v1'"),
        (lambda: ContinualSequence([]), ValueError, "must name at least one task"),
        (
            lambda: ContinualSequence(["CartPole-v1", "Pendulum-v1"]),
            ValueError,
            "same action_space, but task 0 .*Discrete.*Box",
        ),
        (lambda: ContinualEnv(["CartPole-v1", "Acrobot-v1"], 9), ValueError, "for instance by CommonSpaces"),
    ],
)
def test_spaces_that_do_not_fit(make_env, error, message):
    with pytest.raises(error, match=message):
        make_env()


def test_the_friction_of_another_cycle():
    settings = dict(n_tasks=2, frictions=[1.0, 0.01], steps_per_task=8, blend_steps=4, cycles=2)
    env = gym.make("Continual/SlipperyAnt-v0", **settings).unwrapped
    env.set_clock(16)
    env.reset(seed=0)
    for _ in range(5):
        env.step(env.action_space.sample())
    assert env.task.unwrapped.model.geom_friction[0, 0] == pytest.approx(1.0)


def test_atari_repeats_as_often_as_told():
    env = gym.make("Continual/Atari-v0", tasks=["Freeway"], repeat_action_probability=0.0).unwrapped
    assert env.task.spec.kwargs["repeat_action_probability"] == 0.0


def test_actions_go_round_and_round():
    env = CommonSpaces(gym.make("CartPole-v1"), 4, 7, "wrap")
    assert [int(env._own_action(action)) for action in range(7)] == [0, 1, 0, 1, 0, 1, 0]
