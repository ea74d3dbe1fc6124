"""Callbacks that stand in the wrong order, or twice."""

from functools import partial

import pytest
from gymnasium import spaces
from stable_baselines3.common.callbacks import CallbackList, EvalCallback, EveryNTimesteps
from torch import nn

from sb3_cchain import ChurnMonitor, ContinualEnv, ContinualMetrics, TaskSignal, TaskSync
from sb3_cchain.analysis import Doctor, EvalAllTasks, EvalTrainedTask, NetworkHealth
from sb3_cchain.callbacks import EpisodicRollouts
from sb3_cchain.methods import (
    FIRE,
    TRAC,
    AdamRel,
    EntropyBonusRestart,
    LayerReset,
    LogStdRestart,
    OptimizerMetrics,
    Oracle,
    PlasticityInjection,
    ReDo,
    ReGraMa,
    SelfNormalizedResets,
    ShrinkAndPerturb,
)
from sb3_cchain.networks import InjectionPolicy
from tests.envs import RandomEnv
from tests.method_models import CALLBACK_ARGUMENTS, make_model

CHANGES = [
    Oracle,
    LogStdRestart,
    FIRE,
    LayerReset,
    partial(ShrinkAndPerturb, interval=None),
    ReDo,
    ReGraMa,
    SelfNormalizedResets,
]


def make_env():
    return ContinualEnv([partial(RandomEnv, action_space=spaces.Box(-1, 1, (2,)))] * 2, 32)


def learn(callbacks, n_steps=64):
    policy_kwargs = dict(net_arch=[8], activation_fn=nn.ReLU)
    return make_model("CChainPPO", make_env(), policy_kwargs=policy_kwargs).learn(n_steps, callback=callbacks)


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: getattr(change, "func", change).__name__)
@pytest.mark.parametrize(
    "monitor", [lambda: EvalAllTasks(make_env()), lambda: EvalTrainedTask(make_env()), ChurnMonitor, Doctor]
)
def test_what_looks_at_the_network_comes_before_what_changes_it(monitor, change):
    looks, changes = monitor(), change()
    with pytest.raises(ValueError, match=f"{type(looks).__name__} must come before {type(changes).__name__}, which changes"):
        learn([changes, looks])
    learn([monitor(), change()])


def test_what_changes_the_network_in_updates_may_come_first():
    learn([ShrinkAndPerturb(interval=1), ChurnMonitor()])


@pytest.mark.parametrize("name", ["ContinualBackprop", "ReDo", "ReGraMa", "SelfNormalizedResets", "ShrinkAndPerturb"])
def test_a_method_that_would_act_twice_is_refused(name):
    from sb3_cchain import methods

    make = partial(getattr(methods, name), **CALLBACK_ARGUMENTS[name])
    with pytest.raises(ValueError, match=f"`learn\\(\\)` was given 2 callbacks {name}: give it one"):
        learn([make(), make()])


IN_AN_EVENT = [
    *CHANGES,
    partial(FIRE, interval=16),
    partial(LayerReset, interval=16),
    partial(PlasticityInjection, timestep=16),
    AdamRel,
    EntropyBonusRestart,
    EpisodicRollouts,
    OptimizerMetrics,
    TaskSync,
    TaskSignal,
    ContinualMetrics,
    ChurnMonitor,
    Doctor,
    NetworkHealth,
    lambda: EvalAllTasks(make_env()),
    lambda: EvalTrainedTask(make_env()),
]


@pytest.mark.parametrize("make", IN_AN_EVENT, ids=lambda make: type(make()).__name__)
def test_what_acts_between_rollouts_is_not_held_by_an_event(make):
    """EventCallback tells those it holds of no rollout, so that they would do nothing."""
    held = make()
    policy = InjectionPolicy if isinstance(held, PlasticityInjection) else "MlpPolicy"
    policy_kwargs = dict(net_arch=[8], optimizer_class=TRAC)
    model = make_model("PPO", make_env(), policy=policy, policy_kwargs=policy_kwargs, normalize_advantage=False)
    after_eval = EvalCallback(make_env(), callback_after_eval=CallbackList([held]))
    for event in (EveryNTimesteps(16, held), CallbackList([after_eval])):
        with pytest.raises(ValueError, match=f"^{type(held).__name__} must be called at every rollout, but E.* holds it"):
            model.learn(32, callback=event)
    assert model.num_timesteps == 0
    model.learn(32, callback=held)
