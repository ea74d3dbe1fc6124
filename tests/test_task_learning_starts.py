"""Random actions and no updates at the beginning of each task."""

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_cchain import CChainDQN, ContinualEnv
from sb3_cchain.callbacks import TaskLearningStarts
from tests.envs import CountEnv


class SpyDQN(CChainDQN):
    """Records at which environment steps it acts by its network, and after which it is trained."""

    def _setup_model(self):
        super()._setup_model()
        self.acted, self.trained = [], []

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        self.acted.append(self.num_timesteps)
        return super().predict(observation, state, episode_start, deterministic)

    def train(self, gradient_steps, batch_size=100):
        self.trained.append(self.num_timesteps)
        super().train(gradient_steps, batch_size)


def make_env():
    return ContinualEnv([CountEnv] * 3, 100)


def make_model(env, **kwargs):
    return SpyDQN("MlpPolicy", env, learning_starts=50, batch_size=8, train_freq=1, seed=0, device="cpu", **kwargs)


def test_every_task_begins_with_random_steps():
    model = make_model(make_env()).learn(300, callback=TaskLearningStarts(20))
    assert model.acted == [*range(20, 100), *range(120, 200), *range(220, 300)]
    # After the last step of a task, the random steps of the next have begun
    assert model.trained == [*range(21, 100), *range(121, 200), *range(221, 301)]


def test_exploration_goes_on_over_a_switch():
    rates = []
    model = make_model(make_env(), exploration_fraction=0.5)
    model.learn(
        300, callback=[TaskLearningStarts(20), ConvertCallback(lambda *_: rates.append(model.exploration_rate) or True)]
    )
    assert rates[1:] == sorted(rates[1:], reverse=True)
    # At the end of each step; the callback sees that of the step before
    assert rates[76] == pytest.approx(1 - 0.95 * 76 / 150)
    assert rates[-1] == pytest.approx(0.05)


def test_environments_side_by_side():
    env = make_vec_env(make_env, n_envs=4)
    model = make_model(env).learn(300, callback=TaskLearningStarts(20))
    assert model.acted == [*range(20, 100, 4), *range(120, 200, 4), *range(220, 300, 4)]


@pytest.mark.parametrize("n_before, rest", [(60, range(60, 100)), (110, [])])
def test_resumed_in_a_new_environment(tmp_path, n_before, rest):
    make_model(make_env()).learn(n_before, callback=TaskLearningStarts(20)).save(tmp_path / "model")
    model = SpyDQN.load(tmp_path / "model", env=make_env(), device="cpu")
    model.learn(300 - n_before, callback=TaskLearningStarts(20), reset_num_timesteps=False)
    assert model.acted == [*rest, *range(120, 200), *range(220, 300)]


class SaveAt(BaseCallback):
    """Saves as a checkpoint does that comes before the others hear of the step."""

    def __init__(self, path):
        super().__init__()
        self.path = path

    def _on_step(self):
        if self.num_timesteps == 100:
            self.model.save(self.path)
        return True


def test_saved_at_a_switch_before_the_callback_heard_of_it(tmp_path):
    make_model(make_env()).learn(110, callback=[SaveAt(tmp_path / "model"), TaskLearningStarts(20)])
    model = SpyDQN.load(tmp_path / "model", env=make_env(), device="cpu")
    model.learn(100, callback=TaskLearningStarts(20), reset_num_timesteps=False)
    assert model.acted[0] == 120


def test_one_environment_after_the_other():
    model = make_model(CountEnv())
    for _ in range(2):
        model.set_env(CountEnv())
        model.learn(50, callback=TaskLearningStarts(20), reset_num_timesteps=False)
    assert model.acted == [*range(20, 50), *range(70, 100)]


def test_another_learn_begins_again():
    model = make_model(make_env()).learn(150, callback=TaskLearningStarts(20))
    model.acted.clear()
    model.learn(150, callback=TaskLearningStarts(20))
    assert model.acted == [*range(20, 100), *range(120, 150)]


@pytest.mark.parametrize("value", [-1, 1.5, "many"])
def test_bad_number_of_steps(value):
    with pytest.raises(ValueError, match=f"`learning_starts`.*got {value!r}"):
        TaskLearningStarts(value)


def test_other_algorithms_and_environments_are_refused():
    with pytest.raises(TypeError, match="TaskLearningStarts is for off-policy algorithms, got PPO"):
        PPO("MlpPolicy", make_env(), device="cpu").learn(10, callback=TaskLearningStarts())
    with pytest.raises(TypeError, match="the training environment is not one"):
        make_model(CountEnv()).learn(10, callback=TaskLearningStarts())


def test_observations_of_the_switch_are_the_old_tasks():
    """The step that ends a task leads to that task's last observation, not to the next one's first."""
    env = ContinualEnv([CountEnv, lambda: CountEnv(name=5)], 10)
    model = make_model(env).learn(20)
    observations, next_observations = model.replay_buffer.observations, model.replay_buffer.next_observations
    assert [int(x) for x in observations[:20, 0, 0]] == [0] * 10 + [5] * 10
    assert np.allclose(np.trunc(next_observations[:20, 0, 0]), [0] * 10 + [5] * 10)
