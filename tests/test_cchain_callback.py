"""CChainCallback is refused where it would not be called at every rollout."""

import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import CallbackList, EveryNTimesteps

from sb3_cchain import CChainCallback
from tests.envs import RandomEnv


@pytest.mark.parametrize("held", [CChainCallback, lambda: CallbackList([CChainCallback()])], ids=["alone", "in a list"])
def test_an_event_does_not_hold_it(held):
    model = PPO("MlpPolicy", RandomEnv(), n_steps=16, batch_size=8, device="cpu")
    with pytest.raises(ValueError, match=r"EveryNTimesteps holds it: give it to `learn\(\)`"):
        model.learn(32, callback=EveryNTimesteps(16, held()))
    assert model.num_timesteps == 0
