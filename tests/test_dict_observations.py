"""This package's policies with ``Dict`` observations."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor

from sb3_cchain import networks
from tests.envs import RandomEnv
from tests.method_models import OFF_POLICY, ON_POLICY

DICT = spaces.Dict({"a": spaces.Box(-1, 1, (2,), np.float32), "b": spaces.Discrete(3)})
BOX = spaces.Box(-1, 1, (2,), np.float32)
# But for ImpalaPolicy, which is for images
POLICIES = [name for name in networks.__all__ if name.endswith("Policy") and name != "ImpalaPolicy"]


class OnlyA(BaseFeaturesExtractor):
    """The first part of the observations."""

    def __init__(self, observation_space):
        super().__init__(observation_space, features_dim=2)

    def forward(self, observations):
        return observations["a"]


def make(name, **kwargs):
    algorithm = DQN if "DQN" in name else SAC if "SAC" in name else PPO
    env = RandomEnv(DICT, BOX if algorithm is SAC else None)
    settings = ON_POLICY if algorithm is PPO else OFF_POLICY
    return algorithm(getattr(networks, name), env, seed=0, device="cpu", **{**settings, **kwargs})


@pytest.mark.parametrize("name", POLICIES)
def test_they_are_combined(name, tmp_path):
    model = make(name, policy_kwargs={})
    model.learn(32).save(tmp_path / "model")
    model.policy.save(tmp_path / "policy")
    loaded = type(model).load(tmp_path / "model", device="cpu").policy, type(model.policy).load(tmp_path / "policy", "cpu")
    for policy in (model.policy, *loaded):
        assert policy.features_extractor_class is CombinedExtractor
        assert all(th.equal(p, q) for p, q in zip(policy.parameters(), model.policy.parameters(), strict=True))


@pytest.mark.parametrize("name", POLICIES)
def test_an_extractor_that_is_given_stays(name):
    assert make(name, policy_kwargs=dict(features_extractor_class=OnlyA)).policy.features_extractor_class is OnlyA
