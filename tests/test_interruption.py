"""Training that was interrupted leaves nothing behind that goes on looking."""

import pytest
from stable_baselines3 import PPO

from sb3_cchain import ChurnMonitor
from sb3_cchain.analysis import NetworkHealth


def interrupt(model, callback):
    """Ctrl-C in the second update of training."""
    step = model.policy.optimizer.step

    def interrupted(*args, **kwargs):
        if model.policy.optimizer.state:
            raise KeyboardInterrupt
        return step(*args, **kwargs)

    model.policy.optimizer.step = interrupted
    with pytest.raises(KeyboardInterrupt):
        model.learn(64, callback=callback)
    model.policy.optimizer.step = step


@pytest.mark.parametrize("monitor, prefix", [(ChurnMonitor, "churn_monitor/"), (NetworkHealth, "health/")])
def test_training_without_the_monitor_is_not_watched(monitor, prefix):
    model = PPO("MlpPolicy", "CartPole-v1", n_steps=32, batch_size=16, seed=0, device="cpu")
    interrupt(model, monitor(interval=1))
    assert model.policy.optimizer._optimizer_step_pre_hooks
    model.logger.name_to_value.clear()
    model.learn(64, reset_num_timesteps=False)
    assert not model.policy.optimizer._optimizer_step_pre_hooks
    assert not any(key.startswith(prefix) for key in model.logger.name_to_value)


def test_a_monitor_goes_on_with_another_model():
    """Whose observations have another shape."""
    monitor = ChurnMonitor(interval=1)
    interrupt(PPO("MlpPolicy", "CartPole-v1", n_steps=32, batch_size=16, seed=0, device="cpu"), monitor)
    model = PPO("MlpPolicy", "MountainCar-v0", n_steps=32, batch_size=16, seed=0, device="cpu")
    model.learn(32, callback=monitor)
    assert "churn_monitor/fixed/policy_churn" in model.logger.name_to_value
