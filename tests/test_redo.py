"""Dormant units are recycled."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from torch import nn

from sb3_cchain import CChainCallback
from sb3_cchain.methods import L2Init, ReDo, WeightClipping
from sb3_cchain.methods.hidden_units import find_hidden_units
from sb3_cchain.methods.unit_recycling import recycle_units
from sb3_cchain.networks import LayerNormPolicy
from sb3_cchain.networks.extractors import MinAtarCNN
from sb3_cchain.networks.impala_policy import ImpalaPolicy
from tests.envs import RandomEnv
from tests.method_models import ALGORITHMS, make_model, make_random_env, parameters

IMAGES = spaces.Box(0, 255, (12, 12, 3), np.uint8)
FRAMES = spaces.Box(0, 255, (36, 36, 1), np.uint8)
DICT = spaces.Dict({"a": spaces.Box(-1, 1, (2,), np.float32), "b": spaces.Discrete(3)})


def one_adam_step(network, inputs, **kwargs):
    optimizer = th.optim.Adam(network.parameters(), lr=1e-3, **kwargs)
    network(inputs).square().sum().backward()
    optimizer.step()
    return optimizer


def make_network():
    return nn.Sequential(nn.Linear(2, 4), nn.ReLU(), nn.Linear(4, 3), nn.ReLU(), nn.Linear(3, 2))


@pytest.mark.parametrize("amsgrad", [False, True])
def test_recycled_units_by_hand(amsgrad):
    th.manual_seed(0)
    network, fresh, inputs = make_network(), make_network(), th.randn(8, 2)
    optimizer = one_adam_step(network, inputs, amsgrad=amsgrad)
    before = {name: p.detach().clone() for name, p in network.named_parameters()}
    moments = {name: {k: v.clone() for k, v in optimizer.state[p].items()} for name, p in network.named_parameters()}
    first, _ = find_hidden_units(network.eval(), lambda: network(th.zeros(1, 2)))
    recycle_units(first, th.tensor([False, True, False, True]), network, fresh, optimizer)

    changed = {name: th.zeros_like(p, dtype=th.bool) for name, p in before.items()}
    changed["0.weight"][[1, 3]] = changed["0.bias"][[1, 3]] = changed["2.weight"][:, [1, 3]] = True
    for name, parameter in network.named_parameters():
        expected = th.zeros_like(parameter) if name == "2.weight" else fresh.get_parameter(name)
        assert th.equal(parameter, th.where(changed[name], expected, before[name])), name
        for key in ["exp_avg", "exp_avg_sq", *["max_exp_avg_sq"] * amsgrad]:
            moment, old = optimizer.state[parameter][key], moments[name][key]
            assert th.equal(moment, th.where(changed[name], 0.0, old)), (name, key)
            # Dead inputs of the second layer aside, there was something to forget
            assert name == "2.weight" or old[changed[name]].any() == changed[name].any()
        assert optimizer.state[parameter]["step"] == 1


def test_of_a_convolution_and_a_norm_by_hand():
    space = spaces.Box(0, 1, (4, 4, 2), np.float32)
    network, fresh = (nn.Sequential(MinAtarCNN(space, features_dim=3, layer_norm=True), nn.Linear(3, 1)) for _ in range(2))
    norm = network[0].linear[0]
    nn.init.uniform_(norm.weight), nn.init.uniform_(norm.bias)
    before = {name: p.detach().clone() for name, p in network.named_parameters()}
    optimizer = th.optim.SGD(network.parameters(), lr=0.1)
    convolution, _ = find_hidden_units(network.eval(), lambda: network(th.zeros(1, 4, 4, 2)))
    units = th.arange(16) == 5
    recycle_units(convolution, units, network, fresh, optimizer)
    # Flattened channels last: filter 5 is at 5, 21, 37 and 53
    flat = th.zeros(64, dtype=th.bool)
    flat[[5, 21, 37, 53]] = True
    assert th.equal(network[0].linear[0].weight, th.where(flat, 1.0, before["0.linear.0.weight"]))
    assert th.equal(network[0].linear[0].bias, th.where(flat, 0.0, before["0.linear.0.bias"]))
    assert th.equal(network[0].linear[2].weight, th.where(flat, 0.0, before["0.linear.2.weight"]))
    assert th.equal(network[0].cnn[0].weight[5], fresh[0].cnn[0].weight[5])
    assert th.equal(network[0].cnn[0].weight[6], before["0.cnn.0.weight"][6])


def enliven(policy):
    """Make all units active, whatever is observed (from -1 to 1)."""
    with th.no_grad():
        for module in policy.modules():
            if isinstance(module, (nn.Linear, nn.Conv2d)):
                module.weight.copy_(module.weight.abs() * 0.1)
                module.bias.fill_(1.0)


def kill(policy, layer, units):
    """Make units whose ReLU is never active."""
    module = policy.get_submodule(layer)
    with th.no_grad():
        module.weight[units] = 0.0
        module.bias[units] = -1.0


class Kill(BaseCallback):
    """Kills units before `ReDo`, which stands behind, may recycle them; records the outputs before and after."""

    def __init__(self, killed, redo, observations):
        super().__init__()
        self.killed, self.redo, self.observations, self.records = killed, redo, observations, []

    def _on_step(self):
        return True

    def outputs(self):
        with th.no_grad():
            if isinstance(self.model, DQN):
                return [self.model.q_net(self.observations)]
            distribution = self.model.policy.get_distribution(self.observations).distribution
            return [distribution.logits, self.model.policy.predict_values(self.observations)]

    def _on_rollout_start(self):
        enliven(self.model.policy)
        for layer, units in self.killed.items():
            kill(self.model.policy, layer, units)
        before, old = self.outputs(), parameters(self.model)
        n_recycled = self.redo.n_recycled
        self.redo._on_rollout_start()
        self.records.append((self.redo.n_recycled - n_recycled, before, self.outputs(), old, parameters(self.model)))


def policies():
    small = dict(net_arch=[8], activation_fn=nn.ReLU)
    minatar = dict(features_extractor_class=MinAtarCNN, features_extractor_kwargs=dict(features_dim=8))
    separate = dict(small, share_features_extractor=False)
    impala = dict(features_extractor_kwargs=dict(features_dim=8, channels=(2, 4)))
    nature = dict(features_extractor_kwargs=dict(features_dim=8))
    mlp = "mlp_extractor.policy_net.0"
    yield PPO, "MlpPolicy", None, small, {mlp: [1, 2], "mlp_extractor.value_net.0": [3]}
    yield A2C, "MlpPolicy", None, small, {mlp: [1, 2]}
    yield PPO, "MultiInputPolicy", DICT, small, {mlp: [0]}
    yield PPO, "CnnPolicy", FRAMES, dict(nature, net_arch=[]), {
        "features_extractor.cnn.4": [3],
        "features_extractor.cnn.0": [7],
    }
    yield PPO, "CnnPolicy", IMAGES, dict(minatar, net_arch=[]), {"features_extractor.cnn.0": [3, 9]}
    yield PPO, "CnnPolicy", IMAGES, dict(minatar, **separate), {"vf_features_extractor.cnn.0": [2], mlp: [7]}
    yield PPO, ImpalaPolicy, IMAGES, impala, {"features_extractor.cnn.2.residual.1": [1], "features_extractor.linear.1": [2]}
    yield DQN, "MlpPolicy", None, small, {"q_net.q_net.0": [1, 2]}
    yield DQN, "CnnPolicy", IMAGES, dict(minatar, net_arch=[]), {"q_net.features_extractor.cnn.0": [3]}
    yield DQN, "CnnPolicy", FRAMES, dict(nature, net_arch=[]), {"q_net.features_extractor.cnn.4": [60, 61]}


@pytest.mark.parametrize("algorithm, policy, space, policy_kwargs, killed", policies())
def test_dead_units_are_recycled_and_the_outputs_stay(algorithm, policy, space, policy_kwargs, killed):
    settings = dict(seed=0, device="cpu", policy_kwargs=policy_kwargs, learning_rate=0.0)
    if algorithm is DQN:
        settings.update(train_freq=4, learning_starts=4, buffer_size=40, batch_size=4, gradient_steps=1)
    else:
        settings.update(n_steps=8) if algorithm is A2C else settings.update(n_steps=8, batch_size=4, n_epochs=1)
    model = algorithm(policy, RandomEnv(space), **settings)
    redo = ReDo(tau=0.0, interval=1, batch_size=8)
    zeros = model.env.reset()
    observations, _ = model.policy.obs_to_tensor(
        {key: np.repeat(value, 5, axis=0) for key, value in zeros.items()} if isinstance(zeros, dict) else zeros.repeat(5, 0)
    )
    spy = Kill(killed, redo, observations)
    model.learn(16, callback=[spy, redo])
    n_killed = sum(map(len, killed.values()))
    recycled = [record for record in spy.records if record[0]]
    assert recycled and all(record[0] == n_killed for record in recycled), [record[0] for record in recycled]
    for _, before, after, old, new in recycled:
        for x, y in zip(before, after, strict=True):
            assert th.allclose(x, y, rtol=1e-5, atol=0)
        for layer, units in killed.items():
            weight = f"{layer}.weight"
            assert (new[weight][units] != 0).any() and (old[weight][units] == 0).all()
            rest = np.setdiff1d(np.arange(len(old[weight])), units)
            assert th.equal(new[weight][rest], old[weight][rest])
        assert not any("target" in name and not th.equal(new[name], old[name]) for name in new)


def test_recycled_units_have_the_initialisation_of_the_policy():
    """SB3's: orthogonal with gain √2, and biases of 0."""
    model = PPO("MlpPolicy", make_random_env(), n_steps=8, batch_size=8, n_epochs=1, seed=0, device="cpu")
    model.policy.mlp_extractor.policy_net[3] = nn.ReLU()
    redo = ReDo(tau=0.0, interval=1)
    spy = Kill({"mlp_extractor.policy_net.2": [0, 1, 2]}, redo, th.zeros(1, 4))
    model.learn(16, callback=[spy, redo])
    n_recycled, *_, new = spy.records[1]
    assert n_recycled == 3
    rows = new["mlp_extractor.policy_net.2.weight"][:3]
    assert th.allclose(rows @ rows.T, 2 * th.eye(3), atol=1e-5)
    assert not new["mlp_extractor.policy_net.2.bias"][:3].any()


class SpyReDo(ReDo):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.recycled_at, self.batches = [], []

    def _recycle(self, observations):
        n_updates = self.model._n_updates
        self.recycled_at.append(n_updates if isinstance(self.model, DQN) else self.model.num_timesteps)
        self.batches.append(observations)
        super()._recycle(observations)


def test_interval_on_policy():
    redo = SpyReDo(interval=2)
    model = make_model("PPO").learn(16 * 7, callback=redo)
    assert redo.recycled_at == [32, 64, 96]
    # Saved in between, the phase is kept
    again = SpyReDo(interval=2)
    model.learn(16 * 2, callback=again, reset_num_timesteps=False)
    assert again.recycled_at == [16 * 8]


@pytest.mark.parametrize(
    "name, interval, n_steps, recycled_at", [("PPO", 2, (32, 32), [32, 64]), ("DQN", 5, (13, 5), [5, 10])]
)
def test_what_is_due_at_the_end_of_training_is_recycled(name, interval, n_steps, recycled_at):
    redo, model = SpyReDo(interval=interval), make_model(name)
    for n_more in n_steps:
        model.learn(n_more, callback=redo, reset_num_timesteps=False)
    assert redo.recycled_at == recycled_at


def test_interval_off_policy():
    redo = SpyReDo(interval=5)
    model = make_model("DQN").learn(25, callback=redo)
    assert redo.recycled_at == [5, 10, 15]
    model.learn(10, callback=redo, reset_num_timesteps=False)
    assert redo.recycled_at == [5, 10, 15, 20, 25]
    several = SpyReDo(interval=5)
    make_model("DQN", train_freq=4, gradient_steps=4).learn(33, callback=several)
    assert several.recycled_at == [8, 12, 16, 20, 28]


@pytest.mark.parametrize("name, interval", [("PPO", 10), ("CChainDQN", 1000)])
def test_default_interval(name, interval):
    redo = ReDo()
    make_model(name).learn(16, callback=redo)
    assert redo._interval == interval


@pytest.mark.parametrize("n_envs", [1, 2])
def test_batches_are_of_the_latest_rollout(n_envs):
    class Observes(BaseCallback):
        rollouts = []  # noqa: RUF012

        def _on_step(self):
            return True

        def _on_rollout_end(self):
            self.rollouts.append(self.model.rollout_buffer.observations.reshape(-1, 4).copy())

    spy, redo = Observes(), SpyReDo(interval=1, batch_size=5)
    Observes.rollouts = []
    make_model("PPO", env=make_vec_env(make_random_env, n_envs=n_envs)).learn(16 * n_envs * 3, callback=[redo, spy])
    for batch, rollout in zip(redo.batches, spy.rollouts, strict=True):
        rows = {tuple(row) for row in batch.tolist()}
        assert len(rows) == 5 and rows <= {tuple(row) for row in rollout.tolist()}


@pytest.mark.parametrize("name", ALGORITHMS)
def test_scores_of_a_network_by_hand(name):
    """All units give the same but one, which gives a tenth."""
    model = make_model(name, env=make_random_env(), policy_kwargs=dict(net_arch=[4], activation_fn=nn.ReLU), learning_rate=0.0)
    hidden = model.policy.q_net.q_net[0] if "DQN" in name else model.policy.mlp_extractor.policy_net[0]
    with th.no_grad():
        hidden.weight.zero_()
        hidden.bias.copy_(th.tensor([1.0, 1.0, 0.1, 1.0]))
    score = 0.1 / (3.1 / 4)
    layer = "q_net.q_net.0" if "DQN" in name else "mlp_extractor.policy_net.0"
    for tau, share in [(score * 0.99, 0.0), (score * 1.01, 0.25)]:
        redo = ReDo(tau=tau, interval=1)
        logged = {}

        class Logged(BaseCallback):
            def _on_step(self):
                return True

            def _on_rollout_start(self, logged=logged):
                for key, value in self.logger.name_to_value.items():
                    logged.setdefault(key, value)  # of the first recycling

        model.learn(17, callback=[redo, Logged()], log_interval=None)
        assert logged[f"redo/dormant_share/{layer}"] == pytest.approx(share)
        assert logged["redo/n_recycled"] == redo.n_recycled >= (share > 0)
        assert (hidden.weight[2] != 0).any() == (share > 0)


def test_moments_inside_a_wrapped_optimizer():
    optimizer = dict(optimizer_class=L2Init, optimizer_kwargs=dict(base_class=WeightClipping))
    model = make_model("PPO", env=make_random_env(), policy_kwargs=dict(net_arch=[4], activation_fn=nn.ReLU, **optimizer))
    adam = model.policy.optimizer.base.base
    assert isinstance(adam, th.optim.Adam)
    model.learn(16)
    kill(model.policy, "mlp_extractor.policy_net.0", [1])
    redo = ReDo(tau=0.0, interval=1)
    redo.init_callback(model)
    redo.on_training_start({}, {})
    redo._recycle(th.randn(16, 4))
    assert redo.n_recycled >= 1
    for name, row in [("mlp_extractor.policy_net.0.weight", 1), ("action_net.weight", (slice(None), 1))]:
        state = adam.state[model.policy.get_parameter(name)]
        assert not state["exp_avg"][row].any() and not state["exp_avg_sq"][row].any()
        assert state["exp_avg"].any()


@pytest.mark.parametrize("as_callback", [False, True])
def test_c_chain_forgets_the_network_before(as_callback):
    c_chain = CChainCallback() if as_callback else None
    model = make_model("PPO" if as_callback else "CChainPPO", env=make_random_env())
    forgotten = []

    class SpyReducer(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_start(self):
            forgotten.append((c_chain or self.model).churn_reducer.reference is None)

    # All units of the network are dormant, at the second recycling none is left to be asked
    model.learn(48, callback=[*[c_chain] * as_callback, ReDo(tau=100.0, interval=2), SpyReducer()])
    assert forgotten == [True, False, True]


def test_the_table_on_the_screen(capsys):
    """SB3's refuses keys that are alike in their first 36 characters."""
    make_model("PPO", verbose=1, policy_kwargs=dict(net_arch=[8, 8])).learn(48, callback=ReDo(interval=1))
    out = capsys.readouterr().out
    assert "dormant_share" in out and "policy_net" not in out


def test_what_it_refuses():
    for argument, value in [("tau", -1), ("interval", 0), ("interval", 1.5), ("batch_size", 0)]:
        with pytest.raises(ValueError, match=f"`{argument}` must be .* got {value}"):
            ReDo(**{argument: value})
    box = RandomEnv(action_space=spaces.Box(-1, 1, (2,), np.float32))
    with pytest.raises(TypeError, match="ReDo is for on-policy algorithms and DQN, got SAC"):
        SAC("MlpPolicy", box, buffer_size=10, device="cpu").learn(10, callback=ReDo())
    with pytest.raises(TypeError, match="ReDo does not know recurrent networks, got RecurrentPPO"):
        RecurrentPPO("MlpLstmPolicy", RandomEnv(), n_steps=16, device="cpu").learn(10, callback=ReDo())
    with pytest.raises(ValueError, match="ReDo finds no hidden unit"):
        make_model("PPO", policy_kwargs=dict(net_arch=[])).learn(10, callback=ReDo())


def test_of_a_policy_without_gsde():
    redo = ReDo(tau=1.0, interval=1)
    MaskablePPO("MlpPolicy", RandomEnv(), n_steps=16, batch_size=8, seed=0, device="cpu").learn(32, redo, use_masking=False)
    assert redo.n_recycled > 0


@pytest.mark.parametrize(
    "action_space, settings",
    [
        (spaces.Box(-1, 1, (2,), np.float32), {}),
        (spaces.Box(-1, 1, (2,), np.float32), dict(use_sde=True)),
        (spaces.MultiDiscrete([2, 3]), {}),
        (spaces.MultiBinary(2), {}),
    ],
)
def test_action_spaces(action_space, settings):
    redo = ReDo(tau=1.0, interval=1)
    model = make_model("CChainPPO", env=RandomEnv(action_space=action_space), **settings)
    model.learn(48, callback=redo)
    assert [layer.layer for layer in redo._layers] == ["mlp_extractor.policy_net.0", "mlp_extractor.value_net.0"]
    assert redo.n_recycled > 0


def test_of_a_layer_norm_network():
    policy_kwargs = dict(net_arch=[8], activation_fn=nn.ReLU)
    model = PPO(LayerNormPolicy, make_random_env(), n_steps=8, batch_size=8, seed=0, device="cpu", policy_kwargs=policy_kwargs)
    norm = model.policy.mlp_extractor.policy_net[1]
    with th.no_grad():
        norm.bias[3] = -100.0  # whatever the linear layer gives
    redo = ReDo(tau=0.0, interval=1)
    redo.init_callback(model)
    model.learn(16, callback=redo)
    assert norm.bias[3] > -1


@pytest.mark.parametrize(
    "policy, policy_kwargs, space",
    [
        ("CnnPolicy", dict(features_extractor_kwargs=dict(features_dim=8), net_arch=[]), FRAMES),
        (ImpalaPolicy, dict(features_extractor_kwargs=dict(features_dim=8, channels=(2, 4))), IMAGES),
    ],
)
def test_the_flattened_layer_is_scored_on_request(policy, policy_kwargs, space):
    """Inputs of the linear layer that are never active: their outgoing weights become 0, with the moments."""
    model = PPO(
        policy, RandomEnv(space), n_steps=8, batch_size=8, n_epochs=1, seed=0, device="cpu", policy_kwargs=policy_kwargs
    )
    name = "features_extractor.linear.1" if policy is ImpalaPolicy else "features_extractor.linear.0"
    linear = model.policy.get_submodule(name)
    inputs = []
    linear.register_forward_hook(lambda module, given, output: inputs.append(given[0]))
    before, redo = parameters(model), ReDo(tau=0.0, interval=1, batch_size=8, score_flattened=True)
    learning = model.lr_schedule
    model.lr_schedule = lambda _: 0.0
    model.learn(8, callback=redo)
    assert redo._layers[-1].layer == f"{name}.inputs" and not redo._layers[-1].has_weights
    silent = (inputs[-1] == 0).all(dim=0)
    after = parameters(model)
    # Of the units of the layer before, and of the flattened one
    zeroed = (after[f"{name}.weight"] == 0).all(dim=0)
    assert silent.any() and not silent.all() and (zeroed[silent]).all() and not zeroed[~silent].any()
    assert (
        th.equal(after[f"{name}.weight"][:, ~zeroed], before[f"{name}.weight"][:, ~zeroed]) or redo.n_recycled > silent.sum()
    )
    assert not model.policy.optimizer.state[linear.weight]["exp_avg"][:, silent].any()
    assert model.logger.name_to_value[f"redo/dormant_share/{name}.inputs"] == pytest.approx(silent.float().mean().item())
    model.lr_schedule = learning
    model.learn(8, callback=redo, reset_num_timesteps=False)


def test_a_network_without_convolutions_has_no_flattened_layer():
    redo = ReDo(score_flattened=True)
    make_model("PPO", env=make_random_env()).learn(16, callback=redo)
    assert all(layer.has_weights for layer in redo._layers)


@pytest.mark.parametrize("reset_steps", [False, True])
def test_step_counts(reset_steps):
    network, fresh, inputs = make_network(), make_network(), th.randn(8, 2)
    optimizer = one_adam_step(network, inputs)
    first, _ = find_hidden_units(network.eval(), lambda: network(th.zeros(1, 2)))
    recycle_units(first, th.tensor([False, True, False, False]), network, fresh, optimizer, reset_steps)
    steps = {name: int(optimizer.state[parameter]["step"]) for name, parameter in network.named_parameters()}
    concerned = {"0.weight", "0.bias", "2.weight"} if reset_steps else set()
    assert steps == {name: int(name not in concerned) for name in steps}


def test_the_option_reaches_the_optimiser():
    for reset_steps, step in ((False, 4), (True, 0)):
        model = make_model("PPO", env=make_random_env())
        model.learn(16, callback=ReDo(tau=0.9, interval=1, reset_steps=reset_steps))
        parameter = model.policy.mlp_extractor.policy_net[0].weight
        assert model.policy.optimizer.state[parameter]["step"] == step
        assert model.policy.optimizer.state[model.policy.value_net.bias]["step"] == 4


@pytest.mark.parametrize("name", ["PPO", "DQN"])
def test_redo_looks_at_a_batch_of_its_size(name):
    sizes = []

    class Spy(ReDo):
        def _choose(self, observations):
            sizes.append(len(observations))
            return super()._choose(observations)

    make_model(name, env=make_random_env()).learn(32, callback=Spy(interval=1, batch_size=5))
    assert set(sizes) == {5}
