"""Layer reset: which layers, when, and what the optimiser remembers."""

import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import set_random_seed
from torch import nn

from sb3_cchain import TaskSync
from sb3_cchain.methods import LayerReset
from sb3_cchain.methods.fresh_policy import fresh_policy
from sb3_cchain.methods.layer_reset import network_layers, reset_layers
from sb3_cchain.networks import InjectionPolicy, LayerNormDQNPolicy, LayerNormPolicy
from tests.envs import CountEnv, RandomEnv
from tests.method_models import ALGORITHMS, STEPS_PER_TASK, make_env, make_model, make_random_env, parameters

NET = dict(net_arch=[8, 8])
# The layers behind each other, by the number of the last ones that are reset
ACTOR = ["mlp_extractor.policy_net.0", "mlp_extractor.policy_net.2", "action_net"]
CRITIC = ["mlp_extractor.value_net.0", "mlp_extractor.value_net.2", "value_net"]
Q = ["q_net.q_net.0", "q_net.q_net.2", "q_net.q_net.4"]


def reset_names(name, n_layers):
    networks = [Q, [layer.replace("q_net.", "q_net_target.", 1) for layer in Q]] if "DQN" in name else [ACTOR, CRITIC]
    layers = [layer for network in networks for layer in network[-n_layers if n_layers else 0 :]]
    return {f"{layer}.{kind}" for layer in layers for kind in ("weight", "bias")}


@pytest.mark.parametrize("n_layers", [1, 2, None])
@pytest.mark.parametrize("name", ["PPO", "DQN", "CChainPPO", "CChainDQN"])
def test_by_hand(name, n_layers):
    model = make_model(name, env=make_random_env(), policy_kwargs=NET)
    model.learn(48)
    optimizer = model.policy.optimizer
    trained = {key: p for key, p in model.policy.named_parameters() if "target" not in key}
    moments = {key: optimizer.state[p] for key, p in trained.items()}
    old = parameters(model)
    kept = {key: {name: value.clone() for name, value in state.items()} for key, state in moments.items()}
    fresh = fresh_policy(model)
    reset_layers(model.policy, fresh, n_layers)

    names = reset_names(name, n_layers)
    draws = dict(fresh.named_parameters())
    assert names <= old.keys()
    for key, parameter in model.policy.named_parameters():
        source = draws[key.replace("q_net_target.", "q_net.")] if key in names else old[key]
        assert th.equal(parameter, source), key
    for key, parameter in trained.items():
        assert (parameter in optimizer.state) == (key not in names)
        if key not in names:
            assert all(th.equal(optimizer.state[parameter][each], value) for each, value in kept[key].items())
    # All are still trained by the optimiser
    assert {id(p) for p in trained.values()} == {id(p) for group in optimizer.param_groups for p in group["params"]}
    before = parameters(model)
    model.learn(16, reset_num_timesteps=False)
    assert all(not th.equal(p, before[key]) for key, p in trained.items())


def test_the_first_update_of_a_fresh_layer_is_adams_first():
    """Of the size of the learning rate: m̂ / √v̂ = ±1."""
    model = make_model("PPO", env=make_random_env(), policy_kwargs=NET)
    model.learn(48)
    reset_layers(model.policy, fresh_policy(model), 1)
    head, hidden = model.policy.value_net.bias, model.policy.mlp_extractor.value_net[0].bias
    before, n_before = head.item(), optimizer_step(model, hidden)
    head.grad, hidden.grad = th.full_like(head, 2.0), th.zeros_like(hidden)
    model.policy.optimizer.step()
    assert head.item() == pytest.approx(before - 3e-4, rel=1e-4)
    assert (optimizer_step(model, head), optimizer_step(model, hidden)) == (1, n_before + 1)


def optimizer_step(model, parameter):
    return int(model.policy.optimizer.state[parameter]["step"])


@pytest.mark.parametrize("policy, name", [(LayerNormPolicy, "PPO"), (LayerNormDQNPolicy, "DQN")])
def test_a_norm_belongs_to_the_layer_before_it(policy, name):
    model = make_model(name, env=make_random_env(), policy=policy)
    layers = network_layers(model.policy)
    assert all(len(layers) == 2 for layers in layers)
    prefix = "q_net.q_net" if name == "DQN" else "mlp_extractor.policy_net"
    assert layers[0][0] == [f"{prefix}.{module}.{kind}" for module in (0, 1) for kind in ("weight", "bias")]


class Spy(BaseCallback):
    """The steps after which the output layer was another one than before."""

    def __init__(self):
        super().__init__()
        self.at = []

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        self._before = self._head()

    def _on_rollout_start(self):
        # With a learning rate of 0, nothing else changes it
        if self.num_timesteps and not th.equal(self._head(), self._before):
            self.at.append(self.num_timesteps)

    def _head(self):
        layers = network_layers(self.model.policy)
        return self.model.policy.get_parameter(layers[0][-1][0]).detach().clone()


def without_learning(name, **kwargs):
    model = make_model(name, **kwargs, **(dict(learning_rate=0.0) if "DQN" in name else {}))
    if "DQN" not in name:
        model.lr_schedule = lambda _: 0.0
    return model


@pytest.mark.parametrize("name", ALGORITHMS)
def test_at_each_switch(name):
    callback, spy = LayerReset(), Spy()
    without_learning(name).learn(3 * STEPS_PER_TASK, callback=[TaskSync(), callback, spy])
    assert spy.at == [STEPS_PER_TASK, 2 * STEPS_PER_TASK] and callback.n_resets == 2


# PPO's rollouts are 16 steps, so 24 and 72 are passed at 32 and 80
@pytest.mark.parametrize("name, at", [("PPO", [32, 48, 80, 96]), ("DQN", [24, 48, 72, 96])])
@pytest.mark.parametrize("stop", [100, 32, 48, 64])
def test_at_an_interval_also_over_several_calls(tmp_path, name, at, stop):
    total = 112
    spy = Spy()
    model = without_learning(name, env=make_random_env())
    model.learn(min(stop, total), callback=[LayerReset(interval=24), spy])
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", env=make_random_env(), device="cpu")
    set_random_seed(7)  # loading seeds again, and the next draw would be the first one
    if isinstance(model, DQN):
        loaded.replay_buffer = model.replay_buffer
    else:
        loaded.lr_schedule = lambda _: 0.0
    spy_after = Spy()
    spy_after.init_callback(loaded)
    spy_after._before = spy_after._head()
    loaded.learn(total - model.num_timesteps, callback=[LayerReset(interval=24), spy_after], reset_num_timesteps=False)
    assert spy.at + spy_after.at == at


def test_c_chain_forgets():
    remembered = []

    class SpyReducer(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_start(self):
            remembered.append(self.model.churn_reducer.reference is not None)

    make_model("CChainPPO", env=make_random_env()).learn(64, callback=[LayerReset(interval=32), SpyReducer()])
    assert remembered == [False, True, False, True]


class Extractor(nn.Module):
    """As SB3's manual shows for networks of one's own, with other names."""

    latent_dim_pi = latent_dim_vf = 8

    def __init__(self, n_features):
        super().__init__()
        self.actor, self.critic = nn.Linear(n_features, 8), nn.Linear(n_features, 8)

    def forward(self, features):
        return self.actor(features), self.critic(features)

    def forward_actor(self, features):
        return self.actor(features)

    def forward_critic(self, features):
        return self.critic(features)


class PolicyWithoutParts(ActorCriticPolicy):
    def _build_mlp_extractor(self):
        self.mlp_extractor = Extractor(self.features_dim)


@pytest.mark.parametrize("name", ["PPO", "CChainDQN"])
def test_before_the_first_reset_nothing_differs(name):
    models = [make_model(name, env=make_env()).learn(48, callback) for callback in (None, LayerReset(interval=10**9))]
    assert all(th.equal(p, q) for p, q in zip(*(model.policy.parameters() for model in models), strict=True))


def test_what_it_refuses():
    for argument, value in [("n_layers", 0), ("n_layers", 1.5), ("interval", 0), ("interval", "8")]:
        with pytest.raises(ValueError, match=f"`{argument}` must be .* got {value!r}"):
            LayerReset(**{argument: value})
    with pytest.raises(ValueError, match=r"`n_layers` must be at most 2, .* got 3"):
        make_model("PPO").learn(10, callback=LayerReset(3))
    with pytest.raises(TypeError, match="the training environment is not one"):
        make_model("PPO", env=CountEnv()).learn(10, callback=LayerReset())
    with pytest.raises(TypeError, match=r"does not know heads for plasticity injection, got InjectionPolicy"):
        make_model("PPO", policy=InjectionPolicy).learn(10, callback=LayerReset())
    with pytest.raises(TypeError, match=r"LayerReset does not know the networks of PolicyWithoutParts: .*policy_net"):
        make_model("PPO", policy=PolicyWithoutParts).learn(10, callback=LayerReset())
    box = RandomEnv(action_space=spaces.Box(-1, 1, (2,)))
    with pytest.raises(TypeError, match=r"LayerReset is for on-policy algorithms and DQN, got SAC"):
        SAC("MlpPolicy", box, buffer_size=10, device="cpu").learn(10, callback=LayerReset())
