"""Gymnasium's specs: environments of this package can be described, sent elsewhere and made again; `make_vec` makes them."""

import pickle

import gymnasium as gym
import minatar.gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec

from sb3_cchain.envs import (
    ChannelPadding,
    CommonSpaces,
    FlatDMControl,
    NoRewardLimit,
    ObservationOffset,
    PixelFrames,
    RewardScale,
    SeededStickyAction,
    TaskCaption,
)
from sb3_cchain.envs.registration import CONTINUAL_ENVS, OTHER_ENVS
from tests.envs import RandomEnv
from tests.extras import NO_WHEELS

ALL_ENVS = CONTINUAL_ENVS | OTHER_ENVS
# The entries of a suite differ in their arguments alone
ONE_OF_A_SUITE = list(
    {
        entry["entry_point"]: f"Continual/{name}"
        for name, entry in reversed(ALL_ENVS.items())
        if not any(module in entry["entry_point"] for module in NO_WHEELS)
    }.values()
)


def copied(spec):
    """By way of a pickle and of JSON."""
    read = EnvSpec.from_json(pickle.loads(pickle.dumps(spec)).to_json())
    assert read == spec
    return read


@pytest.mark.parametrize("name", ALL_ENVS)
def test_every_registered_spec_can_be_sent_elsewhere(name):
    copied(gym.spec(f"Continual/{name}"))


@pytest.mark.parametrize("env_id", ONE_OF_A_SUITE)
def test_the_spec_of_a_registered_environment_makes_it_again(env_id):
    env = gym.make(env_id, steps_per_task=7)
    again = gym.make(copied(env.spec))
    assert again.unwrapped.task_sequence == env.unwrapped.task_sequence
    assert again.unwrapped.steps_per_task == env.unwrapped.steps_per_task == [7] * env.unwrapped.n_tasks
    env.close()
    again.close()


@pytest.mark.parametrize("mode", ["sync", "async"])
@pytest.mark.parametrize("env_id", ONE_OF_A_SUITE)
def test_make_vec(env_id, mode):
    env = gym.make_vec(env_id, num_envs=2, vectorization_mode=mode)
    env.reset(seed=0)
    env.action_space.seed(0)
    observations, _, _, _, infos = env.step(env.action_space.sample())
    assert len(observations) == 2 and infos["task_id"].tolist() == [0, 0]
    read = EnvSpec.from_json(pickle.loads(pickle.dumps(env.spec)).to_json())
    assert (read.id, read.kwargs) == (env.spec.id, env.spec.kwargs)
    env.close()


def cart_pole(**kwargs):
    return gym.make("CartPole-v1", **kwargs)


def minatar_game():
    minatar.gym.register_envs()
    return gym.make("MinAtar/Breakout-v1")


def dm_control():
    import shimmy

    gym.register_envs(shimmy)
    return gym.make("dm_control/cartpole-balance-v0")


WRAPPED = {
    "ObservationOffset": (lambda: ObservationOffset(cart_pole(), np.float32([0.1, 1, 2, 3])), {"offset"}),
    "RewardScale": (lambda: RewardScale(cart_pole(), 0.05), {"scale"}),
    "CommonSpaces": (lambda: CommonSpaces(cart_pole(), 6, 3, "wrap"), {"observation_size", "n_actions", "extra_actions"}),
    "NoRewardLimit": (lambda: NoRewardLimit(cart_pole(), 9), {"n_steps"}),
    "TaskCaption": (lambda: TaskCaption(cart_pole(render_mode="rgb_array"), "level"), {"key"}),
    "ChannelPadding": (lambda: ChannelPadding(minatar_game(), 10), {"n_channels"}),
    "SeededStickyAction": (lambda: SeededStickyAction(minatar_game()), set()),
    "PixelFrames": (lambda: PixelFrames(minatar_game(), 3), {"scale"}),
    "FlatDMControl": (lambda: FlatDMControl(dm_control()), set()),
}


@pytest.mark.parametrize("name", [name for name in WRAPPED if name != "FlatDMControl" or "dm_control" not in NO_WHEELS])
def test_the_spec_of_a_wrapped_environment_makes_it_again(name):
    wrap, arguments = WRAPPED[name]
    env = wrap()
    wrapper = env.spec.additional_wrappers[-1]
    assert wrapper.name == name and set(wrapper.kwargs) == arguments
    # Shimmy's own specs name functions that cannot be pickled
    again = gym.make(env.spec if name == "FlatDMControl" else copied(env.spec))
    assert type(again) is type(env)
    assert again.observation_space == env.observation_space and again.action_space == env.action_space
    observations = [each.reset(seed=3)[0] for each in (env, again)]
    assert np.array_equal(*observations)
    env.action_space.seed(3)
    action = env.action_space.sample()
    assert env.step(action)[1] == again.step(action)[1]


def test_every_wrapper_is_tried():
    import sb3_cchain.envs as envs

    public = {name for name in envs.__all__ if isinstance(getattr(envs, name), type)}
    assert {name for name in public if issubclass(getattr(envs, name), gym.Wrapper)} == set(WRAPPED)


def test_a_wrapper_around_an_environment_without_a_spec_has_none():
    assert RewardScale(RandomEnv(spaces.Box(-1, 1, (2,))), 2.0).spec is None
