"""The units of least use are recycled, a few at a time."""

import pytest
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_cchain.methods import ContinualBackprop
from sb3_cchain.methods import continual_backprop as module
from sb3_cchain.methods.continual_backprop import Usefulness, hand_over_means
from sb3_cchain.methods.hidden_units import HiddenUnits, find_hidden_units, received_activity
from sb3_cchain.networks.extractors import MinAtarCNN
from tests.method_models import make_model, make_random_env, parameters

NET = dict(net_arch=[4], activation_fn=nn.ReLU)
ACTOR = "mlp_extractor.policy_net.0"


def hidden(**kwargs):
    return Usefulness(th.zeros(3)), ContinualBackprop(**kwargs)


def contributions(callback, usefulness, inputs):
    """Of two units with incoming weights 1 and -4 and outgoing (1, -2) and (3, 3), behind a ReLU."""
    network = nn.Sequential(nn.Linear(1, 2, bias=False), nn.ReLU(), nn.Linear(2, 2))
    with th.no_grad():
        network[0].weight.copy_(th.tensor([[1.0], [-4.0]]))
        network[2].weight.copy_(th.tensor([[1.0, 3.0], [-2.0, 3.0]]))
    source = th.arange(2)
    layer = HiddenUnits("0", 2, {"2": source}, {})
    activations = received_activity(network, [layer], lambda: network(inputs), measure=lambda matrix: matrix)
    with th.no_grad():
        return callback._contribution(network, layer, usefulness, activations).tolist(), network, layer


def test_contribution_by_hand():
    # Activations (2, 0) and (0, 4): means 1 and 2; sums of outgoing weights 3 and 6
    found, *_ = contributions(ContinualBackprop(), Usefulness(th.zeros(2)), th.tensor([[2.0], [-1.0]]))
    assert found == [3.0, 12.0]


def test_adaptable_contribution_by_hand():
    callback, usefulness = ContinualBackprop(utility="adaptable_contribution", decay_rate=0.5), Usefulness(th.zeros(2))
    usefulness.ages += 1
    # Both are 1 and 2 away from their means 1 and 2; divided by incoming weights 1 and 4
    found, *_ = contributions(callback, usefulness, th.tensor([[2.0], [-1.0]]))
    assert found == [3.0, 3.0]
    usefulness.ages += 1
    # Activations 4 and 0. The running averages with weights 1/3 and 2/3: 3 and 2/3; so 1 * 3 / 1, and 2/3 * 6 / 4
    found, network, layer = contributions(callback, usefulness, th.tensor([[4.0], [4.0]]))
    assert found == [pytest.approx(3.0), pytest.approx(1.0)]
    # The bias of the next layer takes over 3 * (1, -2)
    bias = network[2].bias.detach().clone()
    with th.no_grad():
        hand_over_means(network, layer, usefulness.means, th.tensor([True, False]))
    assert th.allclose(network[2].bias - bias, th.tensor([3.0, -6.0]))


def test_the_running_average_is_corrected_for_the_age():
    """Units of ages 1 and 2 with the utility 1 of one update and 1.5 of two: 1 / 0.5 and 1.5 / 0.75. The third is young."""
    usefulness, callback = hidden(replacement_rate=1.0, maturity_threshold=1, decay_rate=0.5)
    usefulness.utility, usefulness.ages = th.tensor([1.4, 1.5, 0.0]), th.tensor([2, 3, 1])
    # 1.4 / 0.75 = 1.87, 1.5 / 0.875 = 1.71
    usefulness.to_recycle = -1.0
    assert callback._choose(usefulness).tolist() == [False, True, False]


def test_fractions_are_accumulated():
    usefulness, callback = hidden(replacement_rate=0.2, maturity_threshold=4)
    usefulness.utility = th.tensor([3.0, 1.0, 2.0])
    chosen = []
    for _ in range(10):
        usefulness.ages += 1
        units = callback._choose(usefulness)
        usefulness.ages[units] = 0
        chosen.append(units.nonzero().flatten().tolist())
    # Eligible from the 5th update on: 0.6, 1.2; then with two units 0.2 + 0.4, 1.0; then with one
    assert chosen[:4] == [[]] * 4 and chosen[4:6] == [[], [1]]
    assert [unit for units in chosen for unit in units] == [1, 2] and usefulness.to_recycle < 1


def test_of_filters_by_hand():
    """A filter contributes to all positions of the flattened layer."""
    space = spaces.Box(0, 1, (4, 4, 1))
    network = nn.Sequential(MinAtarCNN(space, features_dim=2), nn.Linear(2, 1)).eval()
    layers = find_hidden_units(network, lambda: network(th.zeros(1, 4, 4, 1)))
    inputs = th.rand(3, 4, 4, 1)
    activations = received_activity(network, layers, lambda: network(inputs), measure=lambda matrix: matrix)
    with th.no_grad():
        found = ContinualBackprop()._contribution(network, layers[0], Usefulness(th.zeros(16)), activations)
        features = network[0].cnn(inputs.permute(0, 3, 1, 2)).permute(0, 2, 3, 1).reshape(3, 4, 16).mean(dim=0)
        outgoing = network[0].linear[0].weight.abs().sum(dim=0).reshape(4, 16)
        assert th.allclose(found, (features * outgoing).sum(dim=0), rtol=1e-5)
        # The mean of what all filters contribute, in the biases
        means = {"0.linear.0": activations["0.linear.0"].mean(dim=0)}
        expected = network[0].linear[0](network[0].cnn(inputs.permute(0, 3, 1, 2)).permute(0, 2, 3, 1).flatten(1)).mean(dim=0)
        hand_over_means(network, layers[0], means, th.ones(16, dtype=th.bool))
        assert th.allclose(network[0].linear[0].bias, expected, atol=1e-6)


@pytest.mark.parametrize("utility", ["contribution", "adaptable_contribution"])
@pytest.mark.parametrize("name", ["PPO", "DQN", "CChainPPO", "CChainDQN"])
def test_in_training_one_unit_of_least_use_is_recycled(name, utility):
    layer, head = ("q_net.q_net.0", "q_net.q_net.2") if "DQN" in name else (ACTOR, "action_net")
    settings = dict(learning_starts=8) if "DQN" in name else dict(n_epochs=2)
    model = make_model(name, env=make_random_env(), policy_kwargs=NET, learning_rate=0.0, **settings)
    with th.no_grad():
        model.policy.get_parameter(f"{layer}.bias").fill_(5.0)
        model.policy.get_parameter(f"{head}.weight")[:, 2] = 1e-6
    # 4 units: 0.26 * 4 = 1.04 at the 4th update
    callback = ContinualBackprop(replacement_rate=0.26, maturity_threshold=3, utility=utility)
    before = parameters(model)
    model.learn(16 if "DQN" not in name else 12, callback=callback, log_interval=1)
    after = parameters(model)
    changed = (before[f"{layer}.weight"] != after[f"{layer}.weight"]).any(dim=1)
    assert changed.tolist() == [False, False, True, False]
    assert not after[f"{head}.weight"][:, 2].any()
    assert th.equal(after[f"{head}.weight"][:, [0, 1, 3]], before[f"{head}.weight"][:, [0, 1, 3]])
    moved = after[f"{head}.bias"] - before[f"{head}.bias"]
    assert moved.abs().max() < 1e-4 and moved.any() == (utility != "contribution")
    adam = model.policy.optimizer.state
    weight, outgoing = model.policy.get_parameter(f"{layer}.weight"), model.policy.get_parameter(f"{head}.weight")
    assert not adam[weight]["exp_avg"][2].any() and adam[weight]["exp_avg"][[0, 1, 3]].any()
    assert not adam[outgoing]["exp_avg_sq"][:, 2].any() and adam[outgoing]["exp_avg_sq"][:, [0, 1, 3]].any()
    ages = callback._usefulness[0].ages.tolist()
    assert ages[2] == 0 and set(ages) == {0, 4}


def test_with_the_same_callback_ages_go_on():
    model, callback = make_model("PPO", env=make_random_env()), ContinualBackprop()
    for age in (4, 8):
        model.learn(16, callback=callback, reset_num_timesteps=False)
        assert set(callback._usefulness[0].ages.tolist()) == {age}


def test_what_it_refuses():
    for argument, value in [
        *(("replacement_rate", -0.1), ("replacement_rate", 2), ("maturity_threshold", 1.5), ("decay_rate", 1)),
        *(("utility", "weight"), ("batch_size", 0)),
    ]:
        with pytest.raises(ValueError, match=f"`{argument}` must be .* got {value!r}"):
            ContinualBackprop(**{argument: value})


def test_utilities_are_running_averages():
    model = make_model(
        "PPO", env=make_random_env(), policy_kwargs=dict(net_arch=[4], activation_fn=nn.ReLU), learning_rate=0.0, n_epochs=1
    )  # two updates
    contributions = []

    class Spy(ContinualBackprop):
        def _contribution(self, *arguments):
            contributions.append(super()._contribution(*arguments))
            return contributions[-1]

    callback = Spy(decay_rate=0.5)
    model.learn(16, callback=callback)
    first, second = contributions[0], contributions[len(callback._layers)]
    assert th.allclose(callback._usefulness[0].utility, 0.25 * first + 0.5 * second)


def test_recycled_units_have_no_utility_and_the_batch_has_its_size(monkeypatch):
    sizes, sample = [], module.sample_batch
    monkeypatch.setattr(module, "sample_batch", lambda model, n: (sizes.append(n), sample(model, n))[1])
    callback = ContinualBackprop(replacement_rate=0.5, maturity_threshold=0, batch_size=3)
    make_model("PPO", env=make_random_env()).learn(16, callback=callback)
    assert set(sizes) == {3}
    assert all((u.ages == 0).any() and (u.utility[u.ages == 0] == 0).all() for u in callback._usefulness)
