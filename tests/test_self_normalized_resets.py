"""Units are recycled when they are silent for longer than they used to be."""

import pytest
import torch as th
from torch import nn

from sb3_cchain.methods import SelfNormalizedResets
from sb3_cchain.methods.self_normalized_resets import Silences
from tests.method_models import make_model, make_random_env, parameters


def fired(*units):
    return th.tensor(units, dtype=th.bool)


def silences(*histories, max_threshold=10):
    """Of units of which each has such a history: 1 for a batch in which it fires."""
    found = Silences(len(histories), max_threshold, th.device("cpu"))
    for batch in zip(*histories, strict=True):
        found.count(fired(*batch))
    return found


def test_silences_are_counted():
    found = silences([1, 0, 0, 1, 0, 1, 1], [0, 0, 0, 0, 0, 0, 0], [1, 1, 1, 1, 1, 1, 1])
    assert found.ages.tolist() == [0, 7, 0]
    # Of lengths 0, 1 and 2; the last unit never was silent
    assert found.n_of_length[:, :3].tolist() == [[2, 1, 1], [0, 0, 0], [7, 0, 0]]


@pytest.mark.parametrize("eta, threshold", [(0.0, 4), (0.25, 2), (0.5, 1), (0.19, 4)])
def test_thresholds_by_hand(eta, threshold):
    """Silences of lengths 1, 1, 2 and 4: half of them are at most 1, three quarters at most 2."""
    found = silences([1, 0, 1, 0, 1, 0, 0, 1, 0, 0, 0, 0, 1])
    found.update_thresholds(eta)
    assert found.thresholds.tolist() == [threshold]
    assert not found.n_of_length.any()


def test_thresholds_contract_or_double():
    found = silences([0] * 3 + [1] * 3, [1] * 6, max_threshold=5)
    found.update_thresholds(0.1)
    assert found.thresholds.tolist() == [3, 1]
    found.update_thresholds(0.1)  # no silence since
    assert found.thresholds.tolist() == [1, 2]
    for batch in ([0, 0], [0, 1], [0, 1], [0, 1], [1, 1]):
        found.count(fired(*batch))
    found.update_thresholds(0.1)
    assert found.thresholds.tolist() == [2, 1]  # a silence of 4, beyond twice the threshold; one of 1
    found.thresholds[:] = 4
    found.count(fired(0, 0)), found.count(fired(0, 0)), found.count(fired(0, 0)), found.count(fired(0, 0))
    found.count(fired(1, 1))
    found.update_thresholds(0.1)
    assert found.thresholds.tolist() == [5, 5]  # not above the greatest


def test_units_begin_again():
    found = silences([0, 0, 0], [1, 0, 0], [0, 0, 1])
    found.thresholds[:] = 3
    assert found.end_long_ones().tolist() == [True, False, False]
    assert found.ages.tolist() == [0, 2, 0]
    # The silence that ended with a recycling counts, too
    assert found.n_of_length[0, 3] == 1
    assert found.end_long_ones().tolist() == [False] * 3


@pytest.mark.parametrize("name", ["PPO", "DQN"])
def test_a_dead_unit_is_recycled_at_the_first_threshold(name):
    """And the outputs stay."""
    model = make_model(name, env=make_random_env(), policy_kwargs=dict(net_arch=[8], activation_fn=nn.ReLU), learning_rate=0.0)
    layer, head = ("q_net.q_net.0", "q_net.q_net.2") if name == "DQN" else ("mlp_extractor.policy_net.0", "action_net")
    with th.no_grad():
        model.policy.get_parameter(f"{layer}.weight").copy_(th.randn(8, 4).abs() * 0.1)
        model.policy.get_parameter(f"{layer}.bias").copy_(th.where(th.arange(8) == 3, -10.0, 10.0))
    snr = SelfNormalizedResets(max_threshold=3, interval=1 if name == "PPO" else 4)
    at, before = [], parameters(model)
    for _ in range(4):
        model.learn(16 if name == "PPO" else 4 + 8 * (not at), callback=snr, reset_num_timesteps=False)
        after = parameters(model)
        at.append((after[f"{layer}.weight"] != before[f"{layer}.weight"]).any(dim=1).nonzero().flatten().tolist())
    assert at[:3] == [[], [], [3]]
    changed = {key for key in after if not th.equal(after[key], before[key])}
    assert {f"{layer}.weight", f"{layer}.bias", f"{head}.weight"} <= changed
    assert (after[f"{head}.weight"][:, 3] == 0).all()
    assert th.equal(after[f"{head}.weight"][:, 4:], before[f"{head}.weight"][:, 4:])


def test_with_the_same_callback_silences_go_on():
    model = make_model("PPO", env=make_random_env())
    snr = SelfNormalizedResets()
    for n_batches in (1, 2):
        model.learn(16, callback=snr, reset_num_timesteps=False)
        assert snr._n_batches == n_batches
    make_model("PPO", env=make_random_env()).learn(16, callback=snr)
    assert snr._n_batches == 1


def test_thresholds_are_updated_in_training(monkeypatch):
    etas, update = [], Silences.update_thresholds
    monkeypatch.setattr(Silences, "update_thresholds", lambda self, eta: (etas.append(eta), update(self, eta)))
    model = make_model(
        "PPO", env=make_random_env(), policy_kwargs=dict(net_arch=[4], activation_fn=nn.ReLU), learning_rate=0.0
    )
    with th.no_grad():
        for p in model.policy.mlp_extractor.parameters():
            p.fill_(float(p.dim() == 1))  # all units fire in every batch
    snr = SelfNormalizedResets(eta=0.3, max_threshold=8, update_interval=2, interval=1)
    model.learn(48, callback=snr)
    assert set(etas) == {0.3} and snr._silences[0].thresholds.tolist() == [1] * 4


def test_one_observation_is_enough_to_fire():
    model, snr = (
        make_model("PPO", env=make_random_env(), policy_kwargs=dict(net_arch=[1], activation_fn=nn.ReLU)),
        SelfNormalizedResets(),
    )
    model.learn(16, callback=snr)
    with th.no_grad():
        for p in model.policy.mlp_extractor.parameters():
            p.fill_(0.0)
        model.policy.mlp_extractor.policy_net[0].weight[0, 0] = 1.0
    observations = -th.ones(10, 4)
    observations[3, 0] = 1.0
    snr._choose(observations)
    assert snr._silences[0].ages[0] == 0 and snr._silences[1].ages[0] > 0
