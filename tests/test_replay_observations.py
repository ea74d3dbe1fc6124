"""Observations drawn from a replay buffer are those that its ``sample()`` would draw."""

from functools import partial

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN, HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.vec_env import VecNormalize

from sb3_cchain import CChainCallback
from sb3_cchain.algorithms.replay_observations import sample_observations
from sb3_cchain.analysis import ChurnMonitor
from sb3_cchain.analysis.ntk import q_ntk
from sb3_cchain.analysis.reference_batch import sample_batch
from tests.churn_models import DICT, GenerousBuffer
from tests.envs import RandomEnv


class NegatingBuffer(ReplayBuffer):
    """Minus the observations."""

    def _get_samples(self, batch_inds, env=None):
        samples = super()._get_samples(batch_inds, env)
        return samples._replace(observations=-samples.observations)


class RememberingBuffer(ReplayBuffer):
    """Knows what it drew last, as one with priorities does, which follow the losses of those transitions."""

    def sample(self, batch_size, env=None):
        self.last_drawn = np.random.randint(self.size(), size=batch_size)
        return self._get_samples(self.last_drawn, env)


CompactBuffer = partial(ReplayBuffer, optimize_memory_usage=True, handle_timeout_termination=False)

# By name: buffer, environment, whether only its observations are read
BUFFERS = {
    "Box": (ReplayBuffer, RandomEnv, True),
    "images": (ReplayBuffer, partial(RandomEnv, spaces.Box(0, 255, (3, 8, 8), np.uint8)), True),
    "Discrete": (ReplayBuffer, partial(RandomEnv, spaces.Discrete(5)), True),
    "compact": (CompactBuffer, RandomEnv, True),
    "Dict": (DictReplayBuffer, partial(RandomEnv, DICT), True),
    "n steps": (NStepReplayBuffer, RandomEnv, True),
    "HER": (HerReplayBuffer, partial(BitFlippingEnv, n_bits=3), False),
    "own sample()": (GenerousBuffer, RandomEnv, False),
    "own _get_samples()": (NegatingBuffer, RandomEnv, False),
}


def fill(buffer, env, n_steps):
    observations = env.reset()
    for _ in range(n_steps):
        actions = np.array([env.action_space.sample() for _ in range(env.num_envs)])
        next_observations, rewards, dones, infos = env.step(actions)
        buffer.add(observations, next_observations, actions, rewards, dones, infos)
        observations = next_observations


def make_buffer(name, n_envs=1, n_steps=30, capacity=50):
    make, make_env, _ = BUFFERS[name]
    env = make_vec_env(make_env, n_envs=n_envs, seed=0)
    arguments = dict(env=env) if make is HerReplayBuffer else {}
    buffer = make(capacity * n_envs, env.observation_space, env.action_space, device="cpu", n_envs=n_envs, **arguments)
    fill(buffer, env, n_steps)
    return buffer, env


def draw(call):
    """
    :return: The observations by key, and a random number drawn after them
    """
    np.random.seed(3)
    observations = call()
    return observations if isinstance(observations, dict) else {"": observations}, np.random.random()


def assert_equal_draws(buffer, env=None):
    expected, number_after = draw(lambda: buffer.sample(16, env=env).observations)
    drawn, number_after_drawn = draw(lambda: sample_observations(buffer, 16, env))
    assert number_after_drawn == number_after
    assert drawn.keys() == expected.keys()
    for key, tensor in expected.items():
        assert drawn[key].dtype == tensor.dtype and th.equal(drawn[key], tensor)
    assert len({tuple(row) for row in next(iter(expected.values())).flatten(start_dim=1).tolist()}) > 2


@pytest.mark.parametrize("n_steps", [30, 50, 70])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("name", BUFFERS)
def test_same_observations_and_random_numbers_as_sample(name, n_envs, n_steps):
    buffer, _ = make_buffer(name, n_envs, n_steps)
    assert buffer.full == (n_steps >= 50)
    assert_equal_draws(buffer)


@pytest.mark.parametrize("name", ["Box", "compact", "Dict", "n steps"])
def test_normalised_observations(name):
    buffer, env = make_buffer(name, n_envs=2)
    normalize = VecNormalize(env, norm_obs_keys=["a"] if name == "Dict" else None)
    normalize.reset()
    for _ in range(20):
        normalize.step(np.array([env.action_space.sample() for _ in range(2)]))
    plain, _ = draw(lambda: sample_observations(buffer, 16, None))
    normalised, _ = draw(lambda: sample_observations(buffer, 16, normalize))
    assert any(not th.equal(plain[key], normalised[key]) for key in plain)
    assert_equal_draws(buffer, normalize)


@pytest.mark.parametrize("name", BUFFERS)
def test_the_rest_is_not_read_from_buffers_that_are_known(name):
    buffer, _ = make_buffer(name)
    del buffer.actions, buffer.rewards
    if BUFFERS[name][-1]:
        assert sample_observations(buffer, 16, None) is not None
    else:
        with pytest.raises(AttributeError):
            sample_observations(buffer, 16, None)


@pytest.mark.parametrize("method", ["sample", "_get_samples"])
def test_a_method_of_the_buffer_that_was_replaced_is_called(method, monkeypatch):
    buffer, _ = make_buffer("Box")
    calls, original = [], getattr(buffer, method)

    def replacement(*args, **kwargs):
        calls.append(args)
        return original(*args, **kwargs)

    monkeypatch.setattr(buffer, method, replacement)
    assert len(sample_observations(buffer, 16, None)) == 16
    assert len(calls) == 1


@pytest.mark.parametrize(
    "draw_beside_training",
    [lambda model: sample_observations(model.replay_buffer, 8, None), lambda model: sample_batch(model, 8), q_ntk],
)
def test_the_buffer_of_training_is_left_as_it_is(draw_beside_training):
    model = DQN("MlpPolicy", "CartPole-v1", replay_buffer_class=RememberingBuffer, device="cpu", seed=0)
    model.learn(20)
    model.replay_buffer.sample(16)
    before = dict(vars(model.replay_buffer))
    assert draw_beside_training(model) is not None
    assert all(vars(model.replay_buffer)[name] is value for name, value in before.items())
    assert len(vars(model.replay_buffer)) == len(before)


@pytest.mark.parametrize("callback", [CChainCallback(), ChurnMonitor(interval=1, batch_size=8)])
def test_at_each_update_the_buffer_remembers_the_minibatch(callback):
    drawn, remembers_minibatch = [], []

    class Buffer(RememberingBuffer):
        def sample(self, batch_size, env=None):
            samples = super().sample(batch_size, env)
            drawn.append(self.last_drawn)
            return samples

    def after_update(*_):
        minibatch = next(each for each in drawn if len(each) == model.batch_size)
        remembers_minibatch.append(model.replay_buffer.last_drawn is minibatch)
        drawn.clear()

    model = DQN("MlpPolicy", "CartPole-v1", replay_buffer_class=Buffer, learning_starts=8, device="cpu", seed=0)
    model.policy.optimizer.register_step_post_hook(after_update)
    model.learn(40, callback)
    assert len(remembers_minibatch) == model._n_updates > 0 and all(remembers_minibatch)


class SlowBuffer(ReplayBuffer):
    """While it is drawn from, another thread fills it."""

    filled_by_another = None

    def sample(self, batch_size, env=None):
        samples = super().sample(batch_size, env)
        self.filled_by_another()
        return samples


def test_transitions_that_another_thread_adds_stay():
    buffer, env = make_buffer("Box", n_steps=49)
    buffer.__class__ = SlowBuffer
    buffer.filled_by_another = lambda: fill(buffer, env, 2)
    sample_observations(buffer, 8, None)
    assert (buffer.pos, buffer.full) == (1, True)


class SelfReferringBuffer(RememberingBuffer):
    """Draws by a method that it keeps, as by an object that knows the buffer."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self._get_samples = self._remembering

    def _remembering(self, indices, env=None):
        self.last_drawn = indices
        return super()._get_samples(indices, env)


def test_a_buffer_that_refers_to_itself_is_left_as_it_is():
    env = make_vec_env(RandomEnv)
    buffer = SelfReferringBuffer(50, env.observation_space, env.action_space, device="cpu")
    fill(buffer, env, 30)
    buffer.sample(4)
    last_drawn = buffer.last_drawn
    assert len(sample_observations(buffer, 8, None)) == 8
    assert buffer.last_drawn is last_drawn and len(last_drawn) == 4


def test_a_function_in_place_of_sample_leaves_the_buffer_as_it_is():
    buffer, env = make_buffer("Box")
    buffer.__class__ = RememberingBuffer
    minibatch = buffer.sample(4)
    last_drawn, sample = buffer.last_drawn, buffer.sample

    def sample_while_filled(*args, **kwargs):
        fill(buffer, env, 1)
        return sample(*args, **kwargs)

    buffer.sample = sample_while_filled
    assert len(sample_observations(buffer, 8, None)) == 8
    assert buffer.last_drawn is last_drawn and buffer.pos == 31 and len(minibatch.observations) == 4
