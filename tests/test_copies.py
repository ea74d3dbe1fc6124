"""Copies of a model, by pickle or deepcopy, are models of their own: what they save is their own state."""

import copy
import pickle

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cchain import CChainCallback, CChainDQN, CChainPPO, TaskSignal
from sb3_cchain.methods import ExplorationRateRestart
from tests.churn_models import assert_equal
from tests.envs import RandomEnv


def make_ppo():
    return CChainPPO("MlpPolicy", RandomEnv(), n_steps=16, batch_size=8, n_epochs=1, churn_warmup=0, device="cpu")


def make_dqn():
    return CChainDQN("MlpPolicy", RandomEnv(), learning_starts=4, batch_size=8, buffer_size=100, device="cpu")


def make_dqn_ahead():
    return CChainDQN(
        *("MlpPolicy", RandomEnv()), learning_starts=4, batch_size=8, buffer_size=100, churn_reference="next", device="cpu"
    )


def pickled(model):
    return pickle.loads(pickle.dumps(model))


# After training, deepcopy fails for PPO's policy as it does for SB3's own: it keeps its last distribution
@pytest.mark.parametrize(
    "make, duplicate",
    [(make_ppo, pickled), *((make, how) for make in (make_dqn, make_dqn_ahead) for how in (pickled, copy.deepcopy))],
)
def test_a_copy_goes_on_and_saves_what_it_learned(make, duplicate, tmp_path):
    model = make().learn(48)
    n_seen = int(model.churn_reducer.coefficient.n_seen)
    other = duplicate(model)
    assert int(other.churn_reducer.coefficient.n_seen) == n_seen > 0
    other.learn(48, reset_num_timesteps=False)
    other.save(tmp_path / "model")
    assert int(model.churn_reducer.coefficient.n_seen) == n_seen

    loaded = type(model).load(tmp_path / "model")
    saved, kept = loaded.churn_reducer, other.churn_reducer
    assert int(saved.coefficient.n_seen) == int(kept.coefficient.n_seen) > n_seen
    assert saved.coefficient.value == kept.coefficient.value
    assert np.array_equal(saved.reference, kept.reference)


def test_a_copy_that_is_made_in_training_trains_itself():
    class Copy(BaseCallback):
        def _on_step(self):
            if self.n_calls == 20:
                copies.append(copy.deepcopy(self.model))
            return True

    model, copies = make_dqn(), []
    model.learn(32, [TaskSignal(switch_at=[8]), ExplorationRateRestart(), Copy()])
    copies[0].learn(48)
    assert model.num_timesteps == model._n_calls == 32 and copies[0]._n_calls == 19 + 48


@pytest.mark.parametrize("make", [make_ppo, make_dqn, make_dqn_ahead])
def test_an_untrained_copy_has_a_reducer_of_its_own(make):
    model = make()
    other = copy.deepcopy(model)
    assert other.churn_state.model is other and other.churn_state.reducers is other.churn_reducers
    assert other.churn_reducer is not model.churn_reducer
    other.learn(48)
    assert int(other.churn_reducer.coefficient.n_seen) > 0 == int(model.churn_reducer.coefficient.n_seen)


@pytest.mark.parametrize("duplicate", [pickled, copy.deepcopy])
def test_a_copy_trains_on_the_minibatch_that_was_drawn_ahead(duplicate):
    model = make_dqn_ahead().learn(48)
    other = duplicate(model)
    assert th.equal(other._next_minibatch.observations, other.churn_reducer.reference)
    for each in (model, other):
        np.random.seed(0)
        each.train(gradient_steps=3, batch_size=8)
    assert_equal(model, other)
    assert model.logger.name_to_value["churn/loss"] > 0


def test_a_stock_model_that_was_pickled_goes_on_with_the_callback(tmp_path):
    model = PPO("MlpPolicy", RandomEnv(), n_steps=16, batch_size=8, n_epochs=1, device="cpu").learn(48, CChainCallback())
    other, callback = pickled(model), CChainCallback()
    other.learn(32, callback, reset_num_timesteps=False)
    assert int(callback.churn_reducer.coefficient.n_seen) == 5
    other.save(tmp_path / "model")
    callback = CChainCallback()
    PPO.load(tmp_path / "model", RandomEnv()).learn(16, callback, reset_num_timesteps=False)
    assert int(callback.churn_reducer.coefficient.n_seen) == 6
