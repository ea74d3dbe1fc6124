"""CChainCallback trains a stock PPO as CChainPPO trains, and leaves nothing behind."""

from copy import deepcopy

import pytest
import torch as th
from sb3_contrib import ARS
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback, EveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env

from sb3_cchain import CChainCallback, CChainPPO, TaskSignal
from sb3_cchain.churn import ChurnReducer
from sb3_cchain.methods import EntropyBonusRestart
from tests.churn_models import PPO_SETTINGS as SETTINGS
from tests.churn_models import assert_churn_was_reduced, assert_equal, differ
from tests.envs import RandomEnv


def test_callback_on_stock_ppo_equals_cchain_ppo():
    arguments = dict(target_churn_ratio=1e3, churn_warmup=1, churn_window=3, churn_base_loss="surrogate")
    cchain = CChainPPO("MlpPolicy", "CartPole-v1", **arguments, **SETTINGS).learn(4 * 32)
    stock = PPO("MlpPolicy", "CartPole-v1", **SETTINGS).learn(4 * 32, callback=CChainCallback(**arguments))
    assert_churn_was_reduced(stock)
    assert_equal(cchain, stock)
    assert "zero_grad" not in vars(stock.policy.optimizer)


def test_a_model_saved_at_the_end_of_a_rollout_learns_when_it_is_loaded(tmp_path):
    class Save(BaseCallback):
        def _on_rollout_end(self):
            self.model.save(tmp_path / "model")

        def _on_step(self):
            return True

    PPO("MlpPolicy", "CartPole-v1", **SETTINGS).learn(32, callback=[CChainCallback(), Save()])
    loaded = PPO.load(tmp_path / "model", env=make_vec_env("CartPole-v1"), device="cpu")
    assert not {"train", "_excluded_save_params"} & set(vars(loaded))
    before = deepcopy(loaded.policy.state_dict())
    loaded.learn(64)
    assert not th.equal(before["action_net.weight"], loaded.policy.action_net.weight)


@pytest.mark.parametrize("another", [False, True])
def test_another_call_of_learn_goes_on_with_the_history(another):
    callback = CChainCallback()
    model = PPO("MlpPolicy", "CartPole-v1", **SETTINGS).learn(2 * 32, callback=callback)
    callback = CChainCallback() if another else callback
    model.learn(2 * 32, callback=callback, reset_num_timesteps=False)
    assert callback.churn_reducer.coefficient.n_seen == 4


def test_training_without_the_callback_in_between_is_no_churn():
    callback, references = CChainCallback(), []
    model = PPO("MlpPolicy", "CartPole-v1", **SETTINGS).learn(32, callback=callback)
    for between in (lambda: None, lambda: model.learn(32)):
        between()
        callback.init_callback(model)
        references.append(callback.churn_reducer.reference)
    assert references[0] is not None and references[1] is None
    assert callback.churn_reducer.coefficient.n_seen == 1


SAME = CChainCallback()


@pytest.mark.parametrize(
    "callbacks",
    [
        [CChainCallback(), CChainCallback()],
        [SAME, SAME],
        [CallbackList([CChainCallback()]), CallbackList([CallbackList([CChainCallback()])])],
    ],
    ids=["two", "the same twice", "nested"],
)
def test_two_callbacks_are_refused(callbacks):
    model = PPO("MlpPolicy", "CartPole-v1", **SETTINGS)
    with pytest.raises(ValueError, match=r"`learn\(\)` was given 2 callbacks CChainCallback: give it one"):
        model.learn(32, callback=callbacks)
    assert model.num_timesteps == 0


@pytest.mark.parametrize("argument", ["callback_after_eval", "callback_on_new_best"])
def test_a_callback_held_by_another_is_refused(argument):
    """It would be called at events alone, and reduce no churn."""
    holder = EvalCallback(make_vec_env("CartPole-v1"), **{argument: CChainCallback()})
    with pytest.raises(ValueError, match=r"EvalCallback holds it: give it to `learn\(\)`"):
        PPO("MlpPolicy", "CartPole-v1", **SETTINGS).learn(32, callback=holder)


@pytest.mark.parametrize("again", [False, True])
def test_an_interruption_before_the_update_leaves_nothing_that_reduces_churn(again):
    class Interrupt(BaseCallback):
        def _on_rollout_end(self):
            raise KeyboardInterrupt

        def _on_step(self):
            return True

    models = []
    for callbacks in ([CChainCallback(), Interrupt()], [Interrupt()]):
        models.append(PPO("MlpPolicy", "CartPole-v1", **SETTINGS))
        with pytest.raises(KeyboardInterrupt):
            models[-1].learn(32, callback=callbacks)
        models[-1].learn(64, callback=CChainCallback() if again else None)
        assert "train" not in vars(models[-1])
    assert not differ(*models)


def test_callback_refuses_other_algorithms():
    with pytest.raises(TypeError, match=r"Churn reduction is for PPO, .* DDPG, got ARS"):
        ARS("MlpPolicy", "CartPole-v1", device="cpu").learn(10, callback=CChainCallback())
    with pytest.raises(TypeError, match="CChainPPO reduces churn by itself"):
        CChainPPO("MlpPolicy", "CartPole-v1", **SETTINGS).learn(10, callback=CChainCallback())


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


def test_what_an_error_left_before_train_does_not_meet_other_callbacks():
    class Error(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_end(self):
            raise KeyboardInterrupt

    model = make_model()
    with pytest.raises(KeyboardInterrupt):
        model.learn(48, [CChainCallback(), Error()])
    model.learn(48, [CChainCallback(), TaskSignal(switch_at=[16]), EntropyBonusRestart()])
    assert not {"train", "_excluded_save_params"} & set(vars(model))


def test_a_train_method_of_the_user_stays():
    model, calls = make_model(), []

    def train():
        calls.append(model.num_timesteps)
        PPO.train(model)

    model.train = train
    model.learn(48, callback=CChainCallback())
    assert calls == [16, 32, 48]
    assert model.train is train


def test_the_callback_takes_larger_reference_batches():
    callback = CChainCallback(churn_batch_size=2.0)
    PPO("MlpPolicy", RandomEnv(), n_steps=32, batch_size=8, device="cpu").learn(32, callback)
    assert len(callback.churn_reducer.reference) == 16
