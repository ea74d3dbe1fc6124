"""Training that was interrupted leaves nothing behind that goes on looking."""

import pytest
from stable_baselines3 import PPO

from sb3_cchain import ChurnMonitor
from sb3_cchain.analysis import NetworkHealth


@pytest.mark.parametrize("monitor, prefix", [(ChurnMonitor, "churn_monitor/"), (NetworkHealth, "health/")])
def test_training_without_the_monitor_is_not_watched(monitor, prefix):
    model = PPO("MlpPolicy", "CartPole-v1", n_steps=32, batch_size=16, seed=0, device="cpu")
    step = model.policy.optimizer.step

    def interrupted(*args, **kwargs):
        raise KeyboardInterrupt

    model.policy.optimizer.step = interrupted
    with pytest.raises(KeyboardInterrupt):
        model.learn(64, callback=monitor(interval=1))
    model.policy.optimizer.step = step
    assert model.policy.optimizer._optimizer_step_pre_hooks
    model.logger.name_to_value.clear()
    model.learn(64, reset_num_timesteps=False)
    assert not model.policy.optimizer._optimizer_step_pre_hooks
    assert not any(key.startswith(prefix) for key in model.logger.name_to_value)
