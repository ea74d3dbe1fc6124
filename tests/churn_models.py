"""Tiny models of each form of churn reduction. A further algorithm with churn reduction needs a row in ``FORMS``."""

from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any
from unittest.mock import Mock, patch

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, FlattenExtractor
from torch import nn

from sb3_cchain import CChainCallback, CChainDQN, CChainPPO
from sb3_cchain.algorithms.churn_state import ChurnState
from sb3_cchain.networks import evaluation_mode
from tests import method_models
from tests.envs import RandomEnv

BOX = spaces.Box(-1, 1, (4,), np.float32)
IMAGE = spaces.Box(0, 255, (36, 36, 3), np.uint8)
DICT = spaces.Dict({"a": spaces.Box(-1, 1, (2,), np.float32), "b": spaces.Discrete(3)})
ACTION_SPACES = (spaces.Discrete(3), spaces.MultiDiscrete([2, 4]), spaces.MultiBinary(3), spaces.Box(-1, 1, (2,), np.float32))
PPO_SETTINGS = dict(n_steps=32, batch_size=8, n_epochs=2, seed=0, device="cpu")
DQN_SETTINGS = dict(learning_starts=20, buffer_size=200, batch_size=8, train_freq=1, learning_rate=1e-3, seed=0, device="cpu")


@dataclass(frozen=True)
class Form:
    """
    :param algorithm: Class of the model
    :param stock: SB3's algorithm, of which it is a variant and which loads its models
    :param settings: Arguments of the algorithm
    :param n_timesteps: Environment steps per environment, the last of which make updates with a churn loss
    :param own_key: What it logs besides what all forms log
    :param action_spaces: The kinds of actions that it can train on
    :param callback: Class of the callback that reduces churn, where the algorithm does not
    """

    algorithm: type[BaseAlgorithm]
    stock: type[BaseAlgorithm]
    settings: dict[str, Any]
    n_timesteps: int
    own_key: str
    action_spaces: tuple[spaces.Space, ...] = ACTION_SPACES
    callback: type[CChainCallback] | None = None

    def make(self, env=None, policy="MlpPolicy", **kwargs):
        """A model and its callback, which is None for an algorithm that reduces churn by itself."""
        churn = {name: kwargs.pop(name) for name in list(kwargs) if "churn" in name}
        callback = self.callback and self.callback(**churn)
        if callback is None:
            kwargs.update(churn)
        return self.algorithm(policy, env or RandomEnv(), **{**self.settings, **kwargs}), callback

    def learn(self, env=None, policy="MlpPolicy", n_timesteps=None, **kwargs):
        """A trained model. Nothing is logged in between, so that what the last updates recorded can be looked at."""
        model, callback = self.make(env, policy, **kwargs)
        return model.learn(n_timesteps or self.n_timesteps * model.n_envs, callback, log_interval=10**6)


FORMS = {
    "CChainPPO": Form(CChainPPO, PPO, PPO_SETTINGS, 64, "churn/policy_churn"),
    "CChainDQN": Form(CChainDQN, DQN, DQN_SETTINGS, 50, "churn/greedy_action_changes", ACTION_SPACES[:1]),
    "CChainCallback": Form(PPO, PPO, PPO_SETTINGS, 64, "churn/policy_churn", callback=CChainCallback),
}
ALGORITHMS = {name: form for name, form in FORMS.items() if form.callback is None}
each_form = pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
each_algorithm = pytest.mark.parametrize("form", ALGORITHMS.values(), ids=ALGORITHMS)


class NormalisedExtractor(BaseFeaturesExtractor):
    """BatchNorm and dropout, as module and as function."""

    def __init__(self, observation_space):
        super().__init__(observation_space, 8)
        self.net = nn.Sequential(nn.Linear(4, 8), nn.BatchNorm1d(8), nn.Dropout(0.5))

    def forward(self, observations):
        return nn.functional.dropout(self.net(observations), training=self.training)


class GenerousBuffer(ReplayBuffer):
    """Twice as many samples as it is asked for."""

    def sample(self, batch_size, env=None):
        return super().sample(2 * batch_size, env)


class DoubleFlattenExtractor(FlattenExtractor):
    def forward(self, observations):
        return super().forward(observations).double()


class DoubleCombinedExtractor(CombinedExtractor):
    def forward(self, observations):
        return super().forward(observations).double()


def learn_in_double_precision(make, n_timesteps, env="CartPole-v1", policy="MlpPolicy", policy_kwargs=None, **arguments):
    """The churn loss is a difference of nearly equal numbers: in single precision its rounding errors soon show."""
    extractor = DoubleCombinedExtractor if policy == "MultiInputPolicy" else DoubleFlattenExtractor
    arguments["policy_kwargs"] = {"net_arch": [16], **(policy_kwargs or {}), "features_extractor_class": extractor}
    model = make(policy, env, **arguments)
    model.policy.double()
    # These extractors act in training as in evaluation, as those of SB3 do
    packages = (*evaluation_mode._MODE_FREE_PACKAGES, extractor.__module__)
    with patch.object(evaluation_mode, "_MODE_FREE_PACKAGES", packages):
        return model.learn(n_timesteps)


@contextmanager
def spied(module, name):
    """A mock that does what the function does."""
    with patch.object(module, name, Mock(wraps=getattr(module, name))) as spy:
        yield spy


def churn_keys(model):
    own_keys = {form.algorithm: form.own_key for form in FORMS.values()}
    return {"churn/loss", "churn/coef", "churn/relative_loss", "churn/value_churn", own_keys[type(model)]}


def assert_churn_was_reduced(model):
    keys, logged = churn_keys(model), model.logger.name_to_value
    assert keys <= set(logged)
    assert all(np.isfinite(logged[key]) for key in keys)
    assert all(logged[key] > 0 for key in keys & {"churn/policy_churn", "churn/value_churn"})


def differ(model, other):
    """Whether any tensor of their policies does."""
    mine, others = model.policy.state_dict(), other.policy.state_dict()
    return any(not th.equal(tensor, others[name]) for name, tensor in mine.items())


def assert_equal(model, other):
    """Their policies to the bit, and λ where both have it."""
    for name, tensor in model.policy.state_dict().items():
        assert th.equal(tensor, other.policy.state_dict()[name]), name
    # The state of a model that a stock algorithm loaded is a dict
    states = [getattr(each, "churn_state", None) for each in (model, other)]
    if all(isinstance(state, ChurnState) for state in states):
        assert states[0].reducers.first.coefficient.value == states[1].reducers.first.coefficient.value


def assert_close(model, other, atol):
    """Their policies."""
    for name, tensor in model.policy.state_dict().items():
        assert th.allclose(tensor, other.policy.state_dict()[name], rtol=0, atol=atol), name


def state_of(model):
    """Parameters, and C-CHAIN's numbers."""
    coefficient = model.churn_state.reducers.first.coefficient.state_dict() if hasattr(model, "churn_state") else {}
    return [tensor.clone() for tensor in (*model.policy.state_dict().values(), *coefficient.values())]


# Two rollouts
go_on = partial(method_models.go_on, n_steps=40)
