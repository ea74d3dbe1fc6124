"""Plasticity injection: the same outputs, other parameters that are trained."""

import pytest
import torch as th
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import polyak_update
from torch import nn

from sb3_cchain import TaskSync
from sb3_cchain.methods import Oracle, PlasticityInjection
from sb3_cchain.methods.fresh_policy import fresh_policy
from sb3_cchain.methods.plasticity_injection import inject
from sb3_cchain.networks import CReLU, InjectionDQNPolicy, InjectionPolicy
from sb3_cchain.networks.injection_policies import InjectableHidden, InjectableOutput
from tests.envs import CountEnv
from tests.method_models import ALGORITHMS, STEPS_PER_TASK, go_on, make_env, make_model, make_random_env, parameters

NAMES = ["PPO", "DQN", "CChainPPO", "CChainDQN"]


def make(name, **kwargs):
    policy = InjectionDQNPolicy if "DQN" in name else InjectionPolicy
    return make_model(name, policy=policy, **{"env": make_random_env(), "policy_kwargs": dict(net_arch=[8, 8]), **kwargs})


def outputs(model, observations):
    policy = model.policy
    with th.no_grad():
        if isinstance(model, DQN):
            return [policy.q_net(observations), policy.q_net_target(observations)]
        return [policy.get_distribution(observations).distribution.logits, policy.predict_values(observations)]


def test_by_hand():
    """A head w · relu(v x): old v = 1, w = 2; new v = -1, w = 3."""

    def linear(weight):
        layer = nn.Linear(1, 1, bias=False)
        layer.weight.data.fill_(weight)
        return layer

    hidden, output = InjectableHidden(nn.Sequential(linear(1.0), nn.ReLU())), InjectableOutput(linear(2.0))
    head, inputs = nn.Sequential(hidden, output), th.tensor([[4.0], [-5.0]])
    assert head(inputs).flatten().tolist() == [8, 0]
    hidden.inject(nn.Sequential(linear(-1.0), nn.ReLU()))
    output.inject(linear(3.0))
    assert head(inputs).flatten().tolist() == [8, 0]
    head(inputs).sum().backward()
    # Of w relu(v x): the hidden unit is 5 for x = -5 alone, where d/dw = 5 and d/dv = w x = -15
    assert (output.new.weight.grad.item(), hidden.new[0].weight.grad.item()) == (5, -15)
    assert all(p.grad is None for p in head.parameters() if p is not output.new.weight and p is not hidden.new[0].weight)
    with th.no_grad():
        output.new.weight.add_(0.5)
    assert head(inputs).flatten().tolist() == [8, 2.5]  # + 0.5 · 5


@pytest.mark.parametrize("name", NAMES)
def test_until_then_it_is_the_stock_policy(name):
    model = make(name).learn(48, callback=PlasticityInjection(10**9))
    stock = make_model(name, env=make_random_env(), policy_kwargs=dict(net_arch=[8, 8])).learn(48)
    observations = th.randn(5, 4)
    for one, other in zip(outputs(model, observations), outputs(stock, observations), strict=True):
        assert th.equal(one, other)
    assert model.logger.name_to_value.get("plasticity_injection/is_injected", 0) == 0


@pytest.mark.parametrize("name", NAMES)
def test_keeps_the_outputs_and_trains_the_new_heads(name):
    model = make(name).learn(48)
    policy, observations = model.policy, th.randn(64, 4)
    before, optimizer = outputs(model, observations), policy.optimizer
    states = {id(p): {key: value.clone() for key, value in state.items()} for p, state in optimizer.state.items()}
    held = [p for group in optimizer.param_groups for p in group["params"]]
    inject(policy, fresh_policy(model))

    for one, other in zip(outputs(model, observations), before, strict=True):
        assert (one - other).abs().max() <= 1e-6
    online = {key: p for key, p in policy.named_parameters() if "target" not in key}
    assert {id(p) for p in held} == {id(p) for p in online.values()}
    assert {id(p) for group in optimizer.param_groups for p in group["params"]} == {id(p) for p in held}
    trained = {key for key, p in online.items() if p.requires_grad}
    assert trained == {key for key in online if ".new." in key}
    # Fresh parameters without moments; what is known of the others stays
    assert not any(online[key] in optimizer.state for key in trained)
    for p, state in optimizer.state.items():
        assert all(th.equal(value, states[id(p)][key]) for key, value in state.items())

    old = parameters(model)
    model.learn(32, reset_num_timesteps=False)
    for key, parameter in policy.named_parameters():
        if "target" not in key:
            assert th.equal(parameter, old[key]) != (key in trained), key
            assert key in trained or parameter.grad is None, key
    assert all(not th.equal(old[key.replace(".new.", ".old.")], old[key]) for key in trained if "weight" in key)
    assert (outputs(model, observations)[0] - before[0]).abs().max() > 1e-6


class Spy(BaseCallback):
    """Whether it was done, by step."""

    def __init__(self):
        super().__init__()
        self.seen = {}

    def _on_step(self):
        return True

    def _on_rollout_start(self):
        self.seen[self.num_timesteps] = [bool(m.is_injected) for m in self.model.policy.modules() if hasattr(m, "is_injected")]


@pytest.mark.parametrize("name", ALGORITHMS)
@pytest.mark.parametrize("timestep, at", [(None, STEPS_PER_TASK), (10, 16), (48, 48)])
def test_when(name, timestep, at):
    spy, model = Spy(), make(name, env=make_env(), **({} if "DQN" not in name else dict(train_freq=16)))
    model.learn(3 * STEPS_PER_TASK, callback=[TaskSync(), PlasticityInjection(timestep), spy])
    for timesteps, done in spy.seen.items():
        assert done == [timesteps >= at] * 4, timesteps
    assert model.logger.name_to_value.get("plasticity_injection/is_injected", 1) == 1


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("n_steps", [32, 64])  # before and after
def test_saved_and_loaded_goes_on_as_if_never_stopped(tmp_path, name, n_steps):
    model = make(name)
    model.learn(n_steps, callback=PlasticityInjection(48))
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", env=make_random_env(), device="cpu")
    if isinstance(model, DQN):
        model.save_replay_buffer(tmp_path / "buffer")
        loaded.load_replay_buffer(tmp_path / "buffer")
    for each in (model, loaded):
        go_on(each, PlasticityInjection(48))
    assert loaded.num_timesteps == n_steps + 32
    for (key, one), (_, other) in zip(model.policy.named_parameters(), loaded.policy.named_parameters(), strict=True):
        assert th.equal(one, other) and one.requires_grad == other.requires_grad, key
    assert all(th.equal(one, other) for one, other in zip(*(outputs(m, th.ones(3, 4)) for m in (model, loaded)), strict=True))


def test_oracle_undoes_it():
    model = make("PPO", env=make_env())
    model.learn(STEPS_PER_TASK + 16, callback=[TaskSync(), PlasticityInjection(16), Oracle()])
    # At step 48 it would be done again
    assert not any(module.is_injected for module in model.policy.modules() if hasattr(module, "is_injected"))
    assert {key for key, p in model.policy.named_parameters() if p.requires_grad} == {
        key for key, _ in model.policy.named_parameters() if ".copy." not in key
    }


def test_the_target_network_follows():
    model = make("DQN", target_update_interval=1)
    model.learn(64, callback=PlasticityInjection(16))
    polyak_update(model.q_net.parameters(), model.q_net_target.parameters(), 1.0)
    assert th.equal(*outputs(model, th.randn(5, 4)))


def test_what_it_refuses():
    for value in (0, 1.5, "8"):
        with pytest.raises(ValueError, match=f"`timestep` must be .* got {value!r}"):
            PlasticityInjection(value)
    with pytest.raises(TypeError, match=r"needs the policy InjectionPolicy .*, got ActorCriticPolicy"):
        make_model("PPO").learn(10, callback=PlasticityInjection())
    with pytest.raises(TypeError, match="the training environment is not one"):
        make("PPO", env=CountEnv()).learn(10, callback=PlasticityInjection())
    with pytest.raises(ValueError, match="`use_sde` must be False"):
        PPO(InjectionPolicy, "Pendulum-v1", use_sde=True, device="cpu")
    for name, policy in (("PPO", InjectionPolicy), ("DQN", InjectionDQNPolicy)):
        with pytest.raises(ValueError, match=f"`activation_fn` must keep .* for {policy.__name__}, got CReLU"):
            make_model(name, policy=policy, policy_kwargs=dict(activation_fn=CReLU))
