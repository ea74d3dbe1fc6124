"""Continual DeepMind Control."""

import os
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.env_util import make_vec_env

from sb3_cchain import CChainPPO
from sb3_cchain.envs import ContinualDMControl, FlatDMControl, TaskVecNormalize
from tests.envs import RandomEnv
from tests.extras import NO_WHEELS, needs_dm_control

if not NO_WHEELS:
    from dm_control import suite

SEQUENCES = {
    "Walker": ("walker", ["stand", "walk", "run"], 24, 6),
    "Quadruped": ("quadruped", ["walk", "run", "walk"], 78, 12),
    "Dog": ("dog", ["stand", "walk", "run", "trot"], 223, 38),
}


class Reference:
    """dm_control driven directly, its observations flattened by hand: their parts by name."""

    def __init__(self, domain, task, seed):
        self.env = suite.load(domain, task, task_kwargs={"random": seed})

    def observe(self, timestep):
        parts = sorted(timestep.observation.items())
        return np.hstack([np.asarray(part).flatten() for _, part in parts]).astype(np.float32)

    def reset(self):
        return self.observe(self.env.reset())

    def step(self, action):
        spec = self.env.action_spec()
        timestep = self.env.step(np.clip(action.astype(np.float64), spec.minimum, spec.maximum))
        assert timestep.discount == 1.0
        return self.observe(timestep), timestep.reward, timestep.last()


def random_actions(env, n_steps, seed=0):
    """Half of them out of bounds."""
    return np.random.default_rng(seed).uniform(-2, 2, (n_steps, *env.action_space.shape)).astype(np.float32)


def play(env, actions, seed):
    trace = [env.reset(seed=seed)[0]]
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        trace += [observation, reward, terminated, truncated]
        if terminated or truncated:
            trace.append(env.reset()[0])
    return trace


def equal(one, other):
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


@needs_dm_control
@pytest.mark.parametrize("name", SEQUENCES)
def test_defaults_are_the_papers(name):
    domain, tasks, n_observations, n_actions = SEQUENCES[name]
    env = gym.make(f"Continual/{name}-v0").unwrapped
    assert (env.domain, env.task_names) == (domain, tasks)
    assert env.task_sequence == [(domain, task) for task in tasks]
    assert [task.spec.id for task in env.tasks] == [f"dm_control/{domain}-{task}-v0" for task in tasks]
    assert env.steps_per_task == [1_000_000] * len(tasks)
    assert env.observation_space == spaces.Box(-np.inf, np.inf, (n_observations,), np.float32)
    low, high = np.full(n_actions, -1.0, np.float32), np.full(n_actions, 1.0, np.float32)
    if domain == "quadruped":
        low[2::3], high[1::3], high[2::3] = -0.8, 1.1, 0.8
    assert env.action_space == spaces.Box(low, high, dtype=np.float32)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()


@needs_dm_control
@pytest.mark.parametrize("domain, tasks", [("walker", ["stand", "run"]), ("quadruped", ["walk", "run"]), ("dog", ["trot"])])
def test_tasks_are_dm_controls_own_and_switch_in_time(domain, tasks):
    length = 40
    env = ContinualDMControl(domain, tasks, steps_per_task=length)
    observation, info = env.reset(seed=7)
    for task_id, task in enumerate(tasks):
        # The first task has the seed itself, the others one drawn from it
        seed = 7 if task_id == 0 else int(np.random.Generator(np.random.PCG64(7)).integers(2**31))
        reference = Reference(domain, task, seed)
        expected = reference.reset()
        for step, action in enumerate(random_actions(env, length, seed=task_id), start=1):
            assert info["task_id"] == task_id
            assert np.array_equal(observation, expected) and observation.dtype == np.float32
            observation, reward, terminated, truncated, info = env.step(action)
            expected, expected_reward, _ = reference.step(action)
            assert type(reward) is float and reward == expected_reward
            assert not terminated and truncated == (step == length and task_id < len(tasks) - 1)
        assert np.array_equal(observation, expected)
        if task_id < len(tasks) - 1:
            observation, info = env.reset()
    env.close()


@needs_dm_control
def test_episodes_are_truncated_after_1000_steps():
    env = ContinualDMControl(steps_per_task=10_000)
    reference = Reference("walker", "stand", 3)
    assert np.array_equal(env.reset(seed=3)[0], reference.reset())
    for step, action in enumerate(random_actions(env, 1000), start=1):
        observation, _, terminated, truncated, _ = env.step(action)
        expected, _, last = reference.step(action)
        assert np.array_equal(observation, expected)
        assert not terminated and truncated == last == (step == 1000)
    # The random numbers go on, and the next episode begins at once
    assert np.array_equal(env.reset()[0], reference.reset())
    assert not env.step(action)[3]


@needs_dm_control
@pytest.mark.parametrize("domain, tasks", [("walker", ["walk", "run"]), ("quadruped", ["walk", "run"])])
def test_a_seed_determines_all_that_follows_whatever_was_before(domain, tasks):
    used, fresh = (ContinualDMControl(domain, tasks, steps_per_task=30) for _ in range(2))
    actions = random_actions(fresh, 70)
    expected = play(fresh, actions, 1)
    for seed in (0, 1):
        play(used, random_actions(used, 35, seed=5), seed + 10)
        used.set_clock(0)
        assert equal(play(used, actions, seed), expected) == (seed == 1)


@needs_dm_control
def test_actions_are_clipped_to_dm_controls_bounds():
    env = ContinualDMControl("quadruped", ["walk"])
    env.reset(seed=0)
    bounds = env.task.unwrapped.action_spec()
    for extreme, bound in ((-5, bounds.minimum), (5, bounds.maximum), (env.action_space.high, bounds.maximum)):
        env.step(np.full(12, extreme, dtype=np.float32))
        assert np.array_equal(env.task.unwrapped.physics.data.ctrl, bound)
    inside = np.linspace(-0.7, 0.7, 12, dtype=np.float32)
    env.step(inside)
    assert np.array_equal(env.task.unwrapped.physics.data.ctrl, inside)


@needs_dm_control
def test_observations_are_new_arrays():
    env = ContinualDMControl()
    kept = [env.reset(seed=0)[0], *(env.step(action)[0] for action in random_actions(env, 3))]
    assert len(np.unique(kept, axis=0)) == 4


@needs_dm_control
@pytest.mark.parametrize(
    "arguments, error, message",
    [
        (("wolker",), ValueError, "Unknown `domain` 'wolker'; it must be one of acrobot, .*walker"),
        ((3,), ValueError, "Unknown `domain` 3; it must be one of"),
        (("walker", ["stand", "trot"]), ValueError, "Unknown task 'trot' in `tasks`; those of 'walker' are stand, walk, run"),
        (("walker", "stand"), TypeError, "`tasks` must be a list of tasks, got the string 'stand'"),
        (("walker", 3), TypeError, "`tasks` must be a list of tasks, got 3"),
        (("walker", []), ValueError, "`tasks` must name at least one task"),
        (
            ("cartpole", ["balance", "two_poles"]),
            ValueError,
            r"same observation_space, but task 0 \(dm_control/cartpole-balance-v0\) has Box.*\(5,\).* and task 1 .*\(8,\)",
        ),
    ],
)
def test_bad_arguments(arguments, error, message):
    with pytest.raises(error, match=message):
        ContinualDMControl(*arguments)


@needs_dm_control
def test_other_domains():
    env = ContinualDMControl("cartpole", ["balance", "swingup"], steps_per_task=5, first_task=1)
    reference = Reference("cartpole", "swingup", 4)
    assert np.array_equal(env.reset(seed=4)[0], reference.reset())
    env = ContinualDMControl("manipulator", ["bring_ball"])  # some of its parts are matrices
    assert np.array_equal(env.reset(seed=4)[0], Reference("manipulator", "bring_ball", 4).reset())


def test_flattening_refuses_other_environments():
    with pytest.raises(TypeError, match="needs Dict observations and Box actions, got Box"):
        FlatDMControl(RandomEnv())


def test_without_the_packages(tmp_path):
    (tmp_path / "triton.py").touch()  # is to be imported before dm_control
    # In a process of its own, which has not imported them yet
    code = """
import sys
import sb3_cchain, gymnasium
packages = ["dm_control", "mujoco", "shimmy"]
assert not sys.modules.keys() & set(packages)
for package in packages:
    sys.modules[package] = None
    try:
        gymnasium.make("Continual/Walker-v0")
    except ImportError as error:
        assert 'pip install "sb3-cchain[dmc]"' in str(error) and "3.13" in str(error), error
    else:
        sys.exit(f"no error without {package}")
    assert "triton" in sys.modules
    del sys.modules[package]
"""
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    subprocess.run([sys.executable, "-c", code], check=True, env={**os.environ, "PYTHONPATH": path})


@needs_dm_control
def test_frames():
    # In a process of its own: without a display MuJoCo may end it, and the backend is chosen at the first import
    code = """
import sb3_cchain, gymnasium, numpy as np
env = gymnasium.make("Continual/Walker-v0", render_mode="rgb_array", first_task=1)
env.reset(seed=0)
try:
    first = env.render()
except Exception as error:
    print("no backend", repr(error))
else:
    env.step(env.action_space.sample())
    frame = env.render()
    assert frame.shape == (240, 320, 3) and frame.dtype == np.uint8 and len(np.unique(frame)) > 20
    assert (frame != first).any()
    assert env.unwrapped.metadata == {"render_modes": ["human", "rgb_array"], "render_fps": 40}
env.close()
"""
    backend = {"MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}
    result = subprocess.run([sys.executable, "-c", code], env={**os.environ, **backend}, capture_output=True, text=True)
    if "no backend" in result.stdout or result.returncode < 0 or "OpenGL" in result.stderr:
        pytest.skip(f"no OpenGL backend: {result.stdout or result.stderr[-200:]}")
    assert result.returncode == 0, result.stderr


# --- With Stable-Baselines3 -----------------------------------------------------------------------------------------------


@needs_dm_control
@pytest.mark.parametrize("domain", ["walker", "quadruped"])
def test_checkers(domain):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        env = ContinualDMControl(domain, ["walk", "run"], steps_per_task=20)
        check_env(env, skip_render_check=True)
        sb3_check_env(env)
    # They recommend bounded observations and actions from -1 to 1; dm_control's own are not
    allowed = ("infinity", "symmetric and normalized", "unmaintained")
    own = [str(warning.message) for warning in caught if warning.category is not DeprecationWarning]
    assert all(any(words in message for words in allowed) for message in own), own


@needs_dm_control
def test_cchain_ppo_learns_over_a_switch():
    env = make_vec_env("Continual/Walker-v0", env_kwargs={"steps_per_task": 96}, seed=0)
    env = TaskVecNormalize(env)
    model = CChainPPO("MlpPolicy", env, n_steps=64, batch_size=16, n_epochs=2, device="cpu", seed=0)
    model.learn(128)
    assert env.get_attr("task_id") == [1]
    # The first observation of the task and its 32 steps
    assert env.obs_rms.count == pytest.approx(33, abs=1e-3) and env.ret_rms.count == pytest.approx(32, abs=1e-3)
    observations = model.rollout_buffer.observations
    assert observations.dtype == np.float32 and np.abs(observations).max() <= 10
    # At the switch, step 33 of the second rollout, statistics of one observation give numbers near zero
    assert np.abs(observations[32]).max() < 0.02 < np.abs(observations[31]).max()
    assert model.policy.action_space == env.action_space
