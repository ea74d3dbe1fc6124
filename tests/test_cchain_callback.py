"""CChainCallback: where it is refused, and what it leaves on the model."""

import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EveryNTimesteps

from sb3_cchain import CChainCallback
from sb3_cchain.churn import ChurnReducer
from tests.envs import RandomEnv


def make_model():
    return PPO("MlpPolicy", RandomEnv(), n_steps=16, batch_size=8, n_epochs=1, seed=0, device="cpu")


@pytest.mark.parametrize("held", [CChainCallback, lambda: CallbackList([CChainCallback()])], ids=["alone", "in a list"])
def test_an_event_does_not_hold_it(held):
    model = make_model()
    with pytest.raises(ValueError, match=r"EveryNTimesteps holds it: give it to `learn\(\)`"):
        model.learn(32, callback=EveryNTimesteps(16, held()))
    assert model.num_timesteps == 0


class InterruptOnce(BaseCallback):
    """Interrupts training between the end of a rollout and train(), once."""

    def __init__(self):
        super().__init__()
        self.over = False

    def _on_rollout_end(self):
        if not self.over:
            self.over = True
            raise KeyboardInterrupt

    def _on_step(self):
        return True


def test_the_same_callback_acts_once_after_an_interruption():
    model, callback, interrupt = make_model(), CChainCallback(), InterruptOnce()
    with pytest.raises(KeyboardInterrupt):
        model.learn(16, callback=[callback, interrupt])
    n_losses = []
    end_iteration = ChurnReducer.end_iteration

    def count(reducer, base_loss):
        n_losses.append(len(reducer.losses))
        end_iteration(reducer, base_loss)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ChurnReducer, "end_iteration", count)
        model.learn(32, callback=[callback, interrupt])
    assert n_losses == [1, 2]  # of two updates each, the first without a churn loss


def test_a_train_method_of_the_user_stays():
    model, calls = make_model(), []

    def train():
        calls.append(model.num_timesteps)
        PPO.train(model)

    model.train = train
    model.learn(48, callback=CChainCallback())
    assert calls == [16, 32, 48]
    assert model.train is train
