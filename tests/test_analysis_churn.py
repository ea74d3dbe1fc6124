"""What the outputs of a model are, and how far they moved."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import QRDQN, TQC, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO, SAC, TD3

from sb3_cchain.analysis.metrics.churn import kl_divergence
from sb3_cchain.analysis.model_outputs import ModelOutputs, churn, model_outputs
from sb3_cchain.churn.divergence import action_changes, mean_absolute_change
from sb3_cchain.networks.evaluation_mode import evaluation_mode
from tests.envs import RandomEnv

BOX = spaces.Box(-2, 2, (2,), np.float32)
OBSERVATIONS = th.linspace(-1, 1, 20).reshape(5, 4)


def small(**settings):
    return dict(seed=0, device="cpu", policy_kwargs=dict(net_arch=[8]), **settings)


def test_kl_divergence_by_hand():
    old = th.tensor([[0.5, 0.5], [0.9, 0.1]])
    new = th.tensor([[0.25, 0.75], [0.9, 0.1]])
    # (½ log(0.5 / 0.25) + ½ log(0.5 / 0.75) + 0) / 2
    assert kl_divergence(old, new) == pytest.approx(np.log(4 / 3) / 4, rel=1e-6)
    assert kl_divergence(old, old) == 0
    assert kl_divergence(th.tensor([[1.0, 0.0]]), th.tensor([[0.5, 0.5]])) == pytest.approx(np.log(2), rel=1e-6)


def test_kl_divergence_of_sub_actions_is_their_sum():
    old = th.tensor([[[0.5, 0.5, 0.0], [1.0, 0.0, 0.0]]])
    new = th.tensor([[[0.25, 0.75, 0.0], [0.5, 0.25, 0.25]]])
    assert kl_divergence(old, new) == pytest.approx(np.log(4 / 3) / 2 + np.log(2), rel=1e-6)


def test_kl_divergence_of_a_small_update():
    """Of single-precision probabilities, and smaller than their rounding."""
    th.manual_seed(0)
    old = th.randn(64, 5, dtype=th.float64)
    new = old + 1e-4 * th.randn(64, 5, dtype=th.float64)
    expected = th.distributions.kl_divergence(*(th.distributions.Categorical(logits=logits) for logits in (old, new))).mean()
    assert expected < 1e-8
    assert kl_divergence(old.float().softmax(dim=1), new.float().softmax(dim=1)) == pytest.approx(expected.item(), rel=0.01)


def test_changes_by_hand():
    assert mean_absolute_change(th.tensor([[1.0, 2.0], [3.0, 4.0]]), th.tensor([[0.0, 2.0], [5.0, 4.0]])) == 0.75
    assert action_changes(th.tensor([0, 1, 2, 3]), th.tensor([0, 2, 2, 3])) == 0.25
    assert action_changes(th.tensor([[0, 1], [2, 3], [1, 1]]), th.tensor([[1, 2], [2, 3], [1, 0]])) == pytest.approx(2 / 3)


def test_churn_of_what_there_is():
    values = th.zeros(2, 1), th.tensor([[1.0], [-2.0]])
    actions = th.tensor([0, 1]), th.tensor([1, 1])
    means = th.zeros(2, 2), th.tensor([[1.0, 0.0], [0.0, 2.0]])
    probabilities = th.tensor([[0.5, 0.5]]), th.tensor([[0.25, 0.75]])

    def of(**outputs):
        return churn(*(ModelOutputs(**{name: pair[i] for name, pair in outputs.items()}) for i in (0, 1)))

    assert of(values=values, greedy_actions=actions) == {"value_churn": 1.5, "greedy_action_changes": 0.5}
    assert of(values=values, action_means=means) == {"policy_churn": 1.25, "value_churn": 1.5}
    assert of(probabilities=probabilities) == {"policy_churn": pytest.approx(np.log(4 / 3) / 2, rel=1e-6)}
    assert of() == {}


@pytest.mark.parametrize(
    "action_space, shape, greedy_shape",
    [
        (spaces.Discrete(3), (5, 3), (5,)),
        (spaces.MultiDiscrete([2, 3]), (5, 2, 3), (5, 2)),
        (spaces.MultiBinary(4), (5, 4, 2), (5, 4)),
    ],
)
@pytest.mark.parametrize("algorithm", [PPO, MaskablePPO, RecurrentPPO])
def test_outputs_of_categorical_policies(algorithm, action_space, shape, greedy_shape):
    model = algorithm("MlpLstmPolicy" if algorithm is RecurrentPPO else "MlpPolicy", RandomEnv(None, action_space), **small())
    outputs = model_outputs(model, {"observations": OBSERVATIONS})
    assert outputs.probabilities.shape == shape and outputs.action_means is None
    assert th.allclose(outputs.probabilities.sum(dim=-1), th.ones(shape[:-1]))
    assert outputs.values.shape == (5, 1)
    assert outputs.greedy_actions.shape == greedy_shape
    actions, _ = model.predict(OBSERVATIONS.numpy(), deterministic=True)
    assert np.array_equal(outputs.greedy_actions, actions)


@pytest.mark.parametrize("action_space, n", [(spaces.Discrete(3), 3), (spaces.MultiDiscrete([2, 3]), 5)])
def test_outputs_of_a_maskable_policy_with_masks(action_space, n):
    model = MaskablePPO("MlpPolicy", RandomEnv(None, action_space), **small())
    masks = th.zeros(5, n)
    masks[:, [1, -1]] = 1.0
    outputs = model_outputs(model, {"observations": OBSERVATIONS, "action_masks": masks})
    if n == 3:
        assert not outputs.probabilities[:, 0].any() and (outputs.probabilities[:, 1:] > 0).all()
    else:
        assert th.equal(outputs.probabilities, th.tensor([[[0.0, 1, 0], [0, 0, 1]]]).repeat(5, 1, 1))
    actions, _ = model.predict(OBSERVATIONS.numpy(), deterministic=True, action_masks=masks.numpy())
    assert np.array_equal(outputs.greedy_actions, actions)


@pytest.mark.parametrize("algorithm, settings", [(PPO, {}), (A2C, dict(use_sde=True))])
def test_outputs_of_gaussian_policies(algorithm, settings):
    model = algorithm("MlpPolicy", RandomEnv(None, BOX), **small(**settings))
    outputs = model_outputs(model, {"observations": OBSERVATIONS})
    with th.no_grad():
        assert th.allclose(outputs.action_means, model.policy.get_distribution(OBSERVATIONS).mode())
        assert th.allclose(outputs.values, model.policy.predict_values(OBSERVATIONS))
    assert outputs.probabilities is None and outputs.greedy_actions is None


@pytest.mark.parametrize("settings", [dict(shared_lstm=True, enable_critic_lstm=False), dict(n_lstm_layers=2)])
def test_outputs_of_recurrent_policies_are_those_of_first_observations(settings):
    model = RecurrentPPO("MlpLstmPolicy", RandomEnv(None, BOX), seed=0, device="cpu", policy_kwargs=settings)
    outputs = model_outputs(model, {"observations": OBSERVATIONS})
    for observation, mean in zip(OBSERVATIONS, outputs.action_means, strict=True):
        action, _ = model.predict(observation.numpy(), deterministic=True)
        assert np.allclose(mean.clamp(-2, 2), action, atol=1e-6)
    assert outputs.values.shape == (5, 1)


@pytest.mark.parametrize("algorithm", [DQN, QRDQN])
def test_outputs_of_q_networks(algorithm):
    model = algorithm("MlpPolicy", RandomEnv(), buffer_size=10, **small())
    outputs = model_outputs(model, {"observations": OBSERVATIONS})
    actions, _ = model.predict(OBSERVATIONS.numpy(), deterministic=True)
    assert outputs.values.shape == (5, 3)
    assert np.array_equal(outputs.values.argmax(dim=1), actions) and np.array_equal(outputs.greedy_actions, actions)
    assert outputs.probabilities is None and outputs.action_means is None


@pytest.mark.parametrize("algorithm, settings", [(SAC, {}), (SAC, dict(use_sde=True)), (TD3, {}), (TQC, {})])
def test_outputs_of_actors_and_critics(algorithm, settings):
    model = algorithm("MlpPolicy", RandomEnv(None, BOX), buffer_size=10, **small(**settings))
    actions = th.linspace(-1, 1, 10).reshape(5, 2)
    outputs = model_outputs(model, {"observations": OBSERVATIONS, "actions": actions})
    predicted, _ = model.predict(OBSERVATIONS.numpy(), deterministic=True)
    assert np.allclose(2 * outputs.action_means, predicted, atol=1e-6)
    with th.no_grad():
        critics = model.critic(OBSERVATIONS, actions)
    for i in range(2):
        values = critics[:, i].mean(dim=1) if algorithm is TQC else critics[i][:, 0]
        assert th.allclose(outputs.values[:, i], values)
    assert outputs.probabilities is None and outputs.greedy_actions is None


def test_evaluation_mode_gives_every_module_its_own_back():
    network = th.nn.Sequential(th.nn.Linear(2, 2), th.nn.Dropout(), th.nn.BatchNorm1d(2))
    network[2].eval()
    with pytest.raises(RuntimeError), evaluation_mode(network):
        assert not any(module.training for module in network.modules())
        raise RuntimeError
    assert [module.training for module in network.modules()] == [True, True, True, False]


def test_recurrent_layers_keep_their_mode_without_their_dropout():
    """cuDNN computes no gradient of them in evaluation mode."""
    th.manual_seed(0)
    lstm, sequence = th.nn.LSTM(2, 3, num_layers=2, dropout=0.9), th.randn(4, 2)
    with evaluation_mode(lstm):
        assert lstm.training
        inside = lstm(sequence)[0]
    assert lstm.training and lstm.dropout == 0.9 and not th.equal(lstm(sequence)[0], inside)
    assert th.equal(lstm.eval()(sequence)[0], inside)


def test_unknown_algorithms():
    with pytest.raises(TypeError, match="SimpleNamespace with object are not known"):
        model_outputs(SimpleNamespace(policy=object()), {"observations": OBSERVATIONS})
