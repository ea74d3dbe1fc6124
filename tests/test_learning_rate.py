"""Schedules of the learning rate, which end with each call of learn()."""

import warnings

import pytest
from stable_baselines3.common.utils import LinearSchedule

from sb3_cchain import CChainPPO
from tests.envs import RandomEnv

SETTINGS = dict(n_steps=16, batch_size=8, n_epochs=1, policy_kwargs=dict(net_arch=[4]), device="cpu")


def test_a_learn_in_which_nothing_is_learned_warns_once():
    model = CChainPPO("MlpPolicy", RandomEnv(), learning_rate=LinearSchedule(1e-3, 0.0, 1.0), **SETTINGS)
    for _ in range(2):
        with pytest.warns(UserWarning, match="learning rate is 0 from the first update") as caught:
            model.learn(16, reset_num_timesteps=False)
        assert len(caught) == 1


@pytest.mark.parametrize("learning_rate", [1e-3, 0.0, LinearSchedule(1e-3, 0.0, 1.0)])
def test_a_learn_of_several_rollouts_does_not_warn(learning_rate):
    model = CChainPPO("MlpPolicy", RandomEnv(), learning_rate=learning_rate, **SETTINGS)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(48)
