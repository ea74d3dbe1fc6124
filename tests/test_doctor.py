"""The doctor: each finding in a model made sick, none in a healthy one; all algorithms; remedies; the live callback."""

import json
import math
import warnings
from functools import cache, partial
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import ARS, QRDQN, TQC, TRPO, CrossQ, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn

from sb3_cchain import CChainCallback, CChainDQN, CChainPPO, CChainSAC, DoubleDQN, TrainingCheckpoint, resume
from sb3_cchain.algorithms.contrib import CChainTQC
from sb3_cchain.analysis import Doctor, remedies
from sb3_cchain.analysis import doctor as doctor_module
from sb3_cchain.analysis import symptoms as symptoms_module
from sb3_cchain.analysis.findings import BY_NAME, CHECKS, diagnose
from sb3_cchain.analysis.inspection import inspect_model
from sb3_cchain.analysis.model_outputs import ModelOutputs
from sb3_cchain.analysis.remedies import Remedy
from sb3_cchain.analysis.report_page import html_report
from sb3_cchain.analysis.saved_algorithm import algorithm_of
from sb3_cchain.analysis.symptoms import (
    acting_symptoms,
    network_symptoms,
    note_gradients,
    policy_change,
    value_symptoms,
    weight_symptoms,
)
from sb3_cchain.methods import TRAC, UPGD, L2Init, WeightClipping
from sb3_cchain.methods.registry import METHOD_NAMES
from sb3_cchain.networks import CReLUPolicy, LayerNormDQNPolicy, LayerNormPolicy
from tests.envs import CountEnv, RandomEnv
from tests.resume_cases import Stop, Stopped

NET = dict(net_arch=[16])
BOX_ACTIONS = spaces.Box(-1, 1, (2,), np.float32)
VECTOR = spaces.Box(-1, 1, (4,), np.float32)
IMAGE = spaces.Box(0, 255, (36, 36, 3), np.uint8)
DICT = spaces.Dict({"a": spaces.Box(-1, 1, (2,), np.float32), "b": spaces.Discrete(3)})


class MaskedEnv(RandomEnv):
    def action_masks(self):
        return np.array([True, True, False])


def make(algorithm, observations=VECTOR, actions=None, policy=None, env=None, **settings):
    """A tiny model."""
    if actions is None:
        continuous = issubclass(algorithm, (DDPG, SAC, TD3, TQC, CrossQ))
        actions = BOX_ACTIONS if continuous else spaces.Discrete(3)
    kind = "Cnn" if observations is IMAGE else "MultiInput" if observations is DICT else "Mlp"
    lstm = "Lstm" if algorithm is RecurrentPPO else ""
    if issubclass(algorithm, OnPolicyAlgorithm):
        settings = {"n_steps": 64, **settings}
        if not issubclass(algorithm, A2C):
            settings = {"batch_size": min(32, settings["n_steps"]), **settings}
        if lstm:
            settings["policy_kwargs"] = dict(NET, lstm_hidden_size=8)
    elif algorithm is ARS:
        settings = {"n_delta": 1, **settings}
    else:
        settings = {"learning_starts": 10, "buffer_size": 200, "batch_size": 16, **settings}
    settings = {"policy_kwargs": dict(NET), **settings}
    if settings["policy_kwargs"] == NET and observations is IMAGE:
        settings["policy_kwargs"] = dict(NET, features_extractor_kwargs=dict(features_dim=8))
    env = env or (MaskedEnv if algorithm is MaskablePPO else RandomEnv)(observations, actions)
    return algorithm(policy or f"{kind}{lstm}Policy", env, seed=0, device="cpu", **settings)


def names(model):
    """Of the findings in a model."""
    return {finding.check.name for finding in inspect_model(model, n_steps=64, n_updates=4).findings}


# --- Each finding, in a model made sick and in none other --------------------------------------------------------------


def fill(tensor, value):
    with th.no_grad():
        tensor.fill_(value)


def one_action():
    model = make(PPO)
    with th.no_grad():
        model.policy.action_net.bias[0] = 50
    return model


def dead_units(algorithm=PPO):
    model = make(algorithm, policy_kwargs=dict(NET, activation_fn=nn.ReLU))
    for module in model.policy.modules():
        if isinstance(module, nn.Linear) and module.out_features == 16:
            fill(module.bias, -100)
    return model


def scaled_first_layer():
    model = make(PPO)
    with th.no_grad():
        model.policy.mlp_extractor.policy_net[0].weight *= 1e4
    return model


def constant_features():
    model = make(PPO, n_epochs=1, learning_rate=0.0)
    fill(model.policy.mlp_extractor.policy_net[0].weight, 0)
    return model


def saturated_actions():
    model = make(SAC)
    fill(model.actor.mu.bias, 20)
    return model


def diverged_values():
    model = make(DQN)
    fill(model.q_net.q_net[-1].bias, 1e6)
    return model


def not_finite():
    model = make(PPO)
    with th.no_grad():
        model.policy.value_net.weight[0, 0] = th.nan
    return model


SICK = {
    "collapsed_policy": one_action,
    "no_exploration": one_action,
    "saturated_actions": saturated_actions,
    "saturated_units": scaled_first_layer,
    "rank_collapse": constant_features,
    "dormant_units": dead_units,
    "exploding_weights": scaled_first_layer,
    "vanishing_gradients": dead_units,
    "too_large_updates": lambda: make(PPO, learning_rate=0.3, clip_range=100.0),
    "dead_values": partial(dead_units, DQN),
    "large_rewards": lambda: make(PPO, env=gym.wrappers.TransformReward(RandomEnv(), lambda reward: 1e5 * reward)),
    "diverged_values": diverged_values,
    "short_horizon": lambda: make(PPO, gamma=0.0),
}


@cache
def healthy(algorithm):
    settings = {TD3: dict(action_noise=NormalActionNoise(np.zeros(2), np.full(2, 0.1)))}.get(algorithm, {})
    return inspect_model(make(algorithm, **settings), n_steps=64, n_updates=4)


def test_each_finding_is_tried():
    assert set(SICK) == set(BY_NAME) and len(BY_NAME) == len(CHECKS)


@pytest.mark.parametrize("name", SICK)
def test_a_sick_model_has_the_finding_and_a_healthy_one_has_not(name):
    model = SICK[name]()
    assert name in names(model)
    measured = healthy(next(algorithm for algorithm in (PPO, DQN, SAC) if type(model) is algorithm))
    assert BY_NAME[name].worst(measured.symptoms) is not None
    assert name not in {finding.check.name for finding in measured.findings}


@pytest.mark.parametrize("algorithm", [PPO, A2C, SAC, TD3])
def test_healthy_models_have_no_findings(algorithm):
    assert healthy(algorithm).findings == []


def test_dqn_without_epsilon_and_td3_without_noise_do_not_explore():
    assert "no_exploration" in names(make(DQN, exploration_initial_eps=0.0, exploration_final_eps=0.0))
    assert "no_exploration" in names(make(TD3))


def test_a_model_that_is_not_finite_has_one_finding():
    inspection = inspect_model(not_finite())
    (finding,) = inspection.findings
    assert finding.check.name == "exploding_weights" and math.isinf(finding.value) and finding.part == "value_net.weight"
    assert json.loads(json.dumps(inspection.to_json(), allow_nan=False))["findings"][0]["value"] is None


def test_a_model_that_an_update_breaks():
    settings = dict(learning_rate=1e38, max_grad_norm=1e30, policy_kwargs=dict(NET, optimizer_class=th.optim.SGD))
    inspection = inspect_model(make(PPO, **settings))
    assert "exploding_weights" in {f.check.name for f in inspection.findings if math.isinf(f.value)}
    assert inspection.symptoms["action_diversity"] > 0.9  # before the update
    # DQN does not notice. There is no second look at what is infinite
    (message,) = warned(lambda: make(DQN, **settings).learn(20, callback=Doctor(interval=1, patience=50)))
    assert "weight gain inf" in message


@pytest.mark.parametrize("value, found", [(math.nan, "exploding_weights"), (-200.0, "too_large_updates")])
def test_a_standard_deviation_that_an_update_breaks(value, found, monkeypatch):
    model, doctor = make(PPO, actions=BOX_ACTIONS), Doctor(interval=1)
    monkeypatch.setattr(model, "train", lambda: fill(model.policy.log_std, value))
    (message,) = warned(lambda: model.learn(64, callback=doctor))
    assert [finding.check.name for finding in doctor.findings] == [found] and "inf" in message


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_values_that_are_not_finite_say_nothing_of_the_rewards(value):
    model = make(PPO).learn(64)
    assert "value_scale" in value_symptoms(model, 32)
    model.rollout_buffer.values[0] = value
    assert value_symptoms(model, 32) == {}
    model = make(DQN).learn(64)
    fill(next(model.q_net.parameters()), value)
    assert value_symptoms(model, 32) == {}


def test_likely_findings_come_first():
    symptoms = {"discount": 0.0, "weight_gain/a": 1.0, "weight_gain/b": 100.0}
    first, second = diagnose(symptoms, make(PPO))
    assert (first.check.name, first.value, first.part) == ("exploding_weights", 100.0, "b")
    assert second.check.name == "short_horizon" and second.check.certainty == "possible"
    assert first.sentence() == "The weights have grown huge: weight gain 100 in b; healthy: at most 20."


# --- Numbers worked by hand ---------------------------------------------------------------------------------------------


def test_policy_change():
    old, new = (ModelOutputs(probabilities=th.tensor([[p, 1 - p]])) for p in (0.5, 0.25))
    assert policy_change(old, new, None, None) == pytest.approx(0.5 * math.log(2) + 0.5 * math.log(2 / 3))
    old, new = (ModelOutputs(action_means=th.tensor([[mean, 0.0]])) for mean in (0.0, 3.0))
    assert policy_change(old, new, th.tensor([[2.0, 1.0]]), th.tensor([[2.0, 1.0]])) == pytest.approx(9 / 8)
    assert policy_change(ModelOutputs(), ModelOutputs(), None, None) is None
    # An action that has become impossible
    old, new = (ModelOutputs(probabilities=th.tensor([[p, 1 - p]])) for p in (0.5, 0.0))
    assert 10 < policy_change(old, new, None, None) < math.inf


def test_gradients_are_the_greatest_of_all_updates_in_units_of_epsilon():
    weight = nn.Parameter(th.zeros(2, 2))
    sizes: dict[str, float] = {}
    for size in (1e-3, 4e-3, 2e-3):
        weight.grad = th.full((2, 2), size)
        note_gradients(sizes, {"layer": weight}, th.optim.Adam([weight], eps=1e-5))
    assert sizes == {"gradient_size/layer": pytest.approx(400)}


def test_networks():
    model = make(PPO, policy_kwargs=dict(net_arch=[4]))
    layer = model.policy.mlp_extractor.policy_net[0]
    with th.no_grad():
        # One unit that observes, one that is saturated, and two that do nothing
        layer.weight.copy_(th.tensor([[1.0, 0, 0, 0], [0.0] * 4, [0.0] * 4, [0.0] * 4]))
        layer.bias.copy_(th.tensor([0.0, 5.0, 0.0, 0.0]))
        symptoms = network_symptoms(model, {"observations": th.linspace(-1, 1, 20).reshape(-1, 1).expand(-1, 4)})
    part = "mlp_extractor.policy_net"
    assert symptoms[f"dormant_units/{part}"] == 0.5
    assert symptoms[f"saturated_units/{part}.1"] == 0.25
    assert symptoms[f"feature_rank/{part}"] == 1
    # Root mean square 1/4, of 4 inputs
    assert symptoms[f"weight_gain/{part}.0.weight"] == 0.5
    assert f"saturated_units/{part.replace('policy', 'value')}.1" not in symptoms


def test_the_rank_of_features_that_differ_by_rounding_or_of_a_single_one():
    model, observations = make(PPO, policy_kwargs=dict(net_arch=dict(pi=[4], vf=[1]))), th.linspace(-1, 1, 20)
    layer = model.policy.mlp_extractor.policy_net[0]
    fill(layer.weight, 1e-7)
    fill(layer.bias, 1.0)
    symptoms = network_symptoms(model, {"observations": observations.reshape(-1, 1).expand(-1, 4)})
    assert symptoms["feature_rank/mlp_extractor.policy_net"] == 0
    assert "feature_rank/mlp_extractor.value_net" not in symptoms


@pytest.mark.parametrize(
    "algorithm, bound, settings, mean, diversity, saturated",
    [
        (PPO, 4, {}, 2.0, 0.5, 0.0),
        (PPO, 4, {}, 5.0, 1.0, 1.0),
        (SAC, 4, {}, 1.0, 1.0, 1.0),  # its networks act between -1 and 1
        (PPO, 1, dict(use_sde=True, policy_kwargs=dict(squash_output=True)), 0.5, math.tanh(0.5), 0.0),
    ],
)
def test_continuous_actions(algorithm, bound, settings, mean, diversity, saturated, monkeypatch):
    monkeypatch.setattr(symptoms_module, "_exploration", lambda *_: None)
    model = make(algorithm, actions=spaces.Box(-bound, bound, (1,), np.float32), **settings)
    found = acting_symptoms(model, {}, ModelOutputs(action_means=th.tensor([[mean], [-mean]])))
    assert found == {"action_diversity": pytest.approx(diversity), "saturated_actions": saturated}


def test_diversity_of_sub_actions_of_different_sizes():
    """Two equally likely actions of two, and of four, where half the entropy is the greatest."""
    model = make(PPO, actions=spaces.MultiDiscrete([2, 4]))
    probabilities = th.tensor([[[0.5, 0.5, 0.0, 0.0], [0.5, 0.5, 0.0, 0.0]]])
    found = acting_symptoms(model, {}, ModelOutputs(probabilities=probabilities))
    assert found == {"action_diversity": pytest.approx(0.75), "exploration": pytest.approx(0.75)}


def test_noise_of_several_environments():
    noise = VectorizedActionNoise(NormalActionNoise(np.zeros(2), np.full(2, 0.3)), 1)
    model = make(TD3, action_noise=noise)
    found = acting_symptoms(model, {"observations": th.zeros(2, 4)}, ModelOutputs(action_means=th.zeros(2, 2)))
    assert found["exploration"] == pytest.approx(0.3)


def test_diversity_and_exploration():
    """A policy that is uniform explores fully; one that is greedy but reacts is diverse and does not explore."""
    model = make(PPO, actions=spaces.Discrete(2))
    fill(model.policy.action_net.weight, 0)
    symptoms = inspect_model(model).symptoms
    assert symptoms["action_diversity"] == pytest.approx(1) and symptoms["exploration"] == pytest.approx(1)
    model = make(PPO, actions=spaces.Discrete(2), n_epochs=1, learning_rate=0.0)
    with th.no_grad():
        model.policy.action_net.weight.copy_(th.cat([th.ones(1, 16), -th.ones(1, 16)]) * 1e4)
        model.policy.action_net.bias.zero_()
    symptoms = inspect_model(model).symptoms
    assert symptoms["action_diversity"] > 0.8 and symptoms["exploration"] < 0.01


def test_standard_deviation_is_a_share_of_half_the_range():
    actions = spaces.Box(-4, 4, (2,), np.float32)
    symptoms = inspect_model(make(PPO, actions=actions)).symptoms
    assert symptoms["exploration"] == pytest.approx(0.25, abs=0.01)  # log_std is 0


# --- All algorithms -----------------------------------------------------------------------------------------------------

ALL = [
    (A2C, VECTOR, spaces.Discrete(3)),
    (A2C, VECTOR, BOX_ACTIONS),
    (PPO, IMAGE, spaces.Discrete(3)),
    (PPO, DICT, spaces.MultiDiscrete([2, 4])),
    (PPO, VECTOR, spaces.MultiBinary(3)),
    (DQN, DICT, spaces.Discrete(3)),
    (DQN, IMAGE, spaces.Discrete(3)),
    (DDPG, VECTOR, BOX_ACTIONS),
    (SAC, DICT, BOX_ACTIONS),
    (TD3, VECTOR, BOX_ACTIONS),
    (TQC, VECTOR, BOX_ACTIONS),
    (QRDQN, VECTOR, spaces.Discrete(3)),
    (CrossQ, VECTOR, BOX_ACTIONS),
    (TRPO, VECTOR, BOX_ACTIONS),
    (ARS, VECTOR, BOX_ACTIONS),
    (ARS, VECTOR, spaces.Discrete(3)),
    (RecurrentPPO, VECTOR, spaces.Discrete(3)),
    (RecurrentPPO, VECTOR, BOX_ACTIONS),
    (MaskablePPO, VECTOR, spaces.Discrete(3)),
    (CChainPPO, VECTOR, BOX_ACTIONS),
    (CChainDQN, VECTOR, spaces.Discrete(3)),
    (CChainSAC, VECTOR, BOX_ACTIONS),
    (CChainTQC, VECTOR, BOX_ACTIONS),
    (DoubleDQN, VECTOR, spaces.Discrete(3)),
]


@pytest.mark.parametrize("algorithm, observations, actions", ALL)
def test_any_saved_model(algorithm, observations, actions, tmp_path):
    make(algorithm, observations, actions).save(tmp_path / "model")
    assert algorithm_of(tmp_path / "model.zip") is algorithm
    env = DummyVecEnv([lambda: (MaskedEnv if algorithm is MaskablePPO else RandomEnv)(observations, actions)])
    if observations is VECTOR:
        env = VecNormalize(env)
    model = algorithm.load(tmp_path / "model", env)
    inspection = inspect_model(model, n_steps=40, n_updates=2)
    plain = json.loads(json.dumps(inspection.to_json(), allow_nan=False))
    assert plain["algorithm"] == algorithm.__name__
    measured = {"action_diversity", "weight_gain", *(["saturated_actions"] if actions is BOX_ACTIONS else [])}
    if algorithm is not ARS:
        measured |= {"exploration", "value_scale", "value_spread", "gradient_size", "discount"}
        measured |= {"policy_change"} if isinstance(model, OnPolicyAlgorithm) else {"value_excess"}
    assert {name.split("/")[0] for name in plain["measures"]} >= measured
    assert all(np.isfinite(value) for value in inspection.symptoms.values())
    assert algorithm.__name__ in html_report([inspection], "Report", with_picture=False)


@pytest.mark.parametrize("n_steps", [1, 3])
def test_values_are_compared_with_the_rewards_of_single_steps(n_steps):
    """Rewards of 1 add up to at most 1 / (1 - 0.5) = 2; values of 8 are four times as large."""
    model = make(DQN, env=CountEnv(length=1000), gamma=0.5, n_steps=n_steps, learning_starts=150)
    model.learn(150)
    for parameter in model.q_net.parameters():
        nn.init.zeros_(parameter)
    nn.init.constant_(model.q_net.q_net[-1].bias, 8.0)
    symptoms = value_symptoms(model, 32)
    assert symptoms["value_excess"] == pytest.approx(4, rel=1e-3)
    assert symptoms["value_scale"] == pytest.approx({1: 1 + 0.5 * 8, 3: 1.75 + 0.125 * 8}[n_steps], rel=0.1)


@pytest.mark.parametrize("length, target", [(1, 1.0), (1000, 1 + 0.5 * 8)])
def test_the_value_of_a_state_is_the_greatest_and_that_of_the_last_one_is_zero(length, target):
    model = make(DQN, env=CountEnv(length=length), gamma=0.5, learning_starts=150).learn(150)
    for parameter in model.q_net.parameters():
        nn.init.zeros_(parameter)
    with th.no_grad():
        model.q_net.q_net[-1].bias.copy_(th.tensor([8.0, -8.0]))
    # Of targets that are all the same there is no spread
    assert value_symptoms(model, 32) == {"value_scale": pytest.approx(target), "value_excess": pytest.approx(4)}


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_the_threshold_is_healthy_and_what_is_no_number_says_nothing(check):
    assert not check.is_sick(check.threshold)
    assert check.is_sick(math.nextafter(check.threshold, math.inf if check.sick == "above" else -math.inf))
    values = {f"{check.measure}/a": math.nan, f"{check.measure}/b": 0.5}
    assert check.worst(values) == check.worst(dict(reversed(values.items()))) == ("b", 0.5)
    assert check.worst({check.measure: math.nan}) is None


# --- Remedies -----------------------------------------------------------------------------------------------------------

REMEDIES = {name: value for name, value in vars(remedies).items() if isinstance(value, Remedy)}
BY_CLASS_NAME = {
    cls.__name__: cls for cls in (A2C, DDPG, DQN, PPO, SAC, TD3, QRDQN, TQC, TRPO, CrossQ, MaskablePPO, RecurrentPPO)
}


def optimised_by(*classes):
    """For each class a model whose optimiser is of it, within another one."""
    for cls in classes:
        arguments = dict(optimizer_class=UPGD, optimizer_kwargs=dict(base_class=cls))
        yield partial(make, PPO, policy_kwargs={**NET, **arguments})


def test_all_remedies_are_used_and_each_finding_has_one_for_each_kind_of_algorithm():
    used = {remedy for check in CHECKS for remedy in check.remedies}
    assert used == set(REMEDIES.values())
    for check in CHECKS:
        assert check.remedies, check.name
    assert {remedy.method for remedy in used} - {None} <= set(METHOD_NAMES)
    assert set(remedies.ALL) == set(BY_CLASS_NAME)


@pytest.mark.parametrize("name", REMEDIES)
def test_the_lines_of_remedies_run(name):
    remedy = REMEDIES[name]
    for algorithm in remedy.algorithms:
        cls = BY_CLASS_NAME[algorithm]
        model = make(cls, **(dict(n_steps=8) if issubclass(cls, OnPolicyAlgorithm) else {}))
        assert remedy.is_for(model) or not remedy.is_new(model)
        given = {"env": model.env, "model": model, "total_timesteps": 12, algorithm: cls}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of tiny batches
            exec(remedy.line_for(model), given)
        assert given["model"].policy is not None


@pytest.mark.parametrize(
    "name, model, other",
    [
        ("SMALLER_RATE", partial(make, PPO), partial(make, PPO, learning_rate=1e-5)),
        ("NORMALIZE", partial(make, PPO), lambda: make(PPO, env=VecNormalize(DummyVecEnv([RandomEnv])))),
        ("RELU", partial(make, PPO), partial(make, PPO, policy_kwargs=dict(activation_fn=nn.ReLU))),
        ("ENTROPY_BONUS", partial(make, PPO), partial(make, PPO, ent_coef=0.01)),
        ("ENTROPY_TARGET", partial(make, SAC, ent_coef=0.1), partial(make, SAC)),
        ("EPSILON", partial(make, DQN, exploration_final_eps=0.0), partial(make, DQN)),
        ("VALUE_COEF", partial(make, PPO, vf_coef=0.0), partial(make, PPO)),
        ("SLOW_TARGET", partial(make, TD3, tau=1.0), partial(make, TD3)),
        ("NORMALIZE", partial(make, PPO), partial(make, PPO, DICT)),  # a part of which is discrete
        ("CCHAIN", partial(make, PPO), partial(make, CChainPPO)),
        ("CCHAIN", partial(make, PPO), lambda: make(PPO).learn(8, CChainCallback())),
        ("DOUBLE_DQN", partial(make, DoubleDQN, double_q=False), partial(make, DoubleDQN)),
        ("LAYER_NORM", partial(make, PPO), partial(make, PPO, policy=LayerNormPolicy)),
        ("LAYER_NORM_DQN", partial(make, DQN), partial(make, DQN, policy=LayerNormDQNPolicy)),
        ("CRELU", partial(make, PPO), partial(make, PPO, policy=CReLUPolicy)),
        ("L2_INIT", *optimised_by(TRAC, L2Init)),
        ("CLIPPING", *optimised_by(L2Init, WeightClipping)),
    ],
)
def test_nothing_is_proposed_that_is_there(name, model, other):
    assert REMEDIES[name].is_for(model()) and not REMEDIES[name].is_for(other())
    assert not REMEDIES[name].is_for(make(ARS))


def test_lines_name_the_policy_for_the_observations():
    assert '"CnnPolicy"' in remedies.SMALLER_RATE.line_for(make(PPO, IMAGE))
    assert '"MultiInputPolicy"' in remedies.SMALLER_RATE.line_for(make(PPO, DICT))
    assert '"MlpLstmPolicy"' in remedies.SMALLER_RATE.line_for(make(RecurrentPPO))


# --- The live callback --------------------------------------------------------------------------------------------------


def warned(function):
    """What the doctor warns of while a function runs."""
    with warnings.catch_warnings(record=True) as recorded:
        warnings.simplefilter("always")
        function()
    return [str(warning.message) for warning in recorded if str(warning.message).startswith("At step")]


def test_warns_once_of_each_finding():
    model, doctor = dead_units(), Doctor(interval=1)

    def learn():
        model.learn(64 * 2, callback=doctor, log_interval=100)
        model.learn(64, callback=doctor, log_interval=100, reset_num_timesteps=False)

    messages = warned(learn)
    (dormant,) = (message for message in messages if "Hidden units are dormant" in message)
    assert len(messages) == len({message.split(": ")[1] for message in messages})
    # Twice in a row
    assert dormant.startswith("At step 128: ") and "Try: ReDo, which" in dormant
    logged = model.logger.name_to_value
    assert logged["doctor/dormant_units"] == 1 and logged["doctor/n_findings"] == len(doctor.findings) >= 3


def test_a_training_that_begins_anew_is_warned_of_again():
    model, doctor = dead_units(), Doctor(interval=1)
    first, second = (warned(lambda: model.learn(64 * 2, callback=doctor, log_interval=100)) for _ in range(2))
    assert first and second == first


def test_a_look_sees_what_its_own_training_did():
    """The weights after it, and no gradients of the next."""
    looks = []
    for n_steps in (64, 128):
        model, doctor = make(PPO), Doctor(interval=100)
        model.learn(n_steps, callback=doctor)
        looks.append(doctor.symptoms)
        assert (doctor.symptoms.items() >= weight_symptoms(model).items()) is (n_steps == 64)
    assert looks[0] == looks[1]


def test_a_look_that_was_interrupted_is_forgotten(monkeypatch):
    model, doctor, looked_at = make(PPO), Doctor(interval=1), []
    monkeypatch.setattr(doctor, "_log", lambda: looked_at.append(doctor.num_timesteps))
    with monkeypatch.context() as patched, pytest.raises(Stopped):
        patched.setattr(model, "train", lambda: (_ for _ in ()).throw(Stopped))
        model.learn(64, callback=doctor)
    model.learn(64, callback=doctor)
    assert looked_at == [64]


def test_a_healthy_training_is_not_warned_of():
    assert warned(lambda: make(PPO).learn(64 * 3, callback=Doctor(interval=1))) == []


@pytest.mark.parametrize("checkpoint_last", [False, True])
def test_what_was_warned_of_is_known_after_resuming(checkpoint_last, tmp_path):
    def callbacks():
        both = [TrainingCheckpoint(64, tmp_path), Doctor(interval=1)]
        return both[::-1] if checkpoint_last else both

    def learn():
        with pytest.raises(Stopped):
            dead_units().learn(64 * 5, callback=[*callbacks(), Stop(64 * 3 + 10)], log_interval=1)

    assert any("dormant" in message for message in warned(learn))
    again = callbacks()
    assert warned(lambda: resume(tmp_path, RandomEnv(), [*again, Stop(math.inf)])) == []
    (doctor,) = (callback for callback in again if isinstance(callback, Doctor))
    assert doctor._warned and doctor._n_in_a_row["dormant_units"] == 5


@pytest.mark.parametrize("algorithm", [PPO, SAC])
def test_training_is_the_same_with_and_without(algorithm):
    models = [
        make(algorithm).learn(66 if algorithm is PPO else 20, callback=callback) for callback in (None, Doctor(interval=1))
    ]
    for with_doctor, without in zip(*(model.policy.state_dict().values() for model in models), strict=True):
        assert th.equal(with_doctor, without)


def test_bad_arguments_and_algorithms():
    with pytest.raises(ValueError, match="`patience` must be an integer greater than or equal to 1, got 0"):
        Doctor(patience=0)
    with pytest.raises(TypeError, match="Doctor is for on-policy and off-policy algorithms, got ARS"):
        make(ARS).learn(10, callback=Doctor())


# --- What a reader sees -------------------------------------------------------------------------------------------------


def test_the_page_needs_nothing_beside_it():
    page = html_report([inspect_model(dead_units(), "<model>")], "A & B")
    assert page.startswith("<!DOCTYPE html>") and "<title>A &amp; B</title>" in page and "<h2>&lt;model&gt;</h2>" in page
    assert 'src="data:image/png;base64,' in page and "://" not in page
    assert page.count("<img") == page.count("<img alt=") == 1
    assert "Findings: 4 likely" in page and "from sb3_cchain.methods import ReDo" in page
    assert "looks healthy" in html_report([healthy(PPO)], "title", with_picture=False)


def test_patience_and_size_of_the_batch(monkeypatch):
    sizes, sample = [], doctor_module.sample_batch
    monkeypatch.setattr(doctor_module, "sample_batch", lambda model, n: (sizes.append(n), sample(model, n))[1])
    doctor = Doctor(interval=1, patience=4, batch_size=50)
    messages = warned(lambda: dead_units().learn(64 * 4, callback=doctor, log_interval=100))
    assert set(sizes) == {50} and messages and all(message.startswith("At step 256") for message in messages)


def test_a_finding_must_hold_in_a_row():
    doctor = Doctor(patience=2)
    doctor.num_timesteps = 0
    finding = SimpleNamespace(check=SimpleNamespace(name="a"), value=1.0, sentence=lambda: "a.", remedies=[])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for doctor.findings in ([finding], [], [finding]):
            doctor._warn()
    with pytest.warns(UserWarning):
        doctor._warn()
