"""In rollouts the layers of a plain MLP policy are called directly, with the same results."""

import copy
import pickle
from types import MethodType

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn
from torch.nn.modules.module import register_module_forward_hook

from sb3_cchain import CChainPPO
from sb3_cchain.networks.impala_policy import ImpalaPolicy
from sb3_cchain.networks.joint_evaluation import can_evaluate_jointly, evaluate_jointly
from sb3_cchain.networks.lean_forward import LeanForward, has_plain_forward, lean_forward
from sb3_cchain.networks.policy_networks import PolicyNetworks
from tests.churn_models import ACTION_SPACES, DICT, IMAGE, PPO_SETTINGS, NormalisedExtractor
from tests.envs import RandomEnv

MATRIX = spaces.Box(-1, 1, (2, 3), np.float32)
INTEGERS = spaces.Box(0, 9, (4,), np.int64)

PLAIN = {
    **{type(space).__name__: dict(env=RandomEnv(action_space=space)) for space in ACTION_SPACES},
    "gSDE": dict(env=RandomEnv(action_space=ACTION_SPACES[3]), use_sde=True),
    "matrix": dict(env=RandomEnv(observation_space=MATRIX)),
    "integers": dict(env=RandomEnv(observation_space=INTEGERS)),
    "own extractors": dict(policy_kwargs=dict(share_features_extractor=False)),
    "no layers": dict(policy_kwargs=dict(net_arch=[])),
    "different layers": dict(policy_kwargs=dict(net_arch=dict(pi=[8], vf=[4, 4]), activation_fn=nn.ReLU)),
}


class OwnForwardPolicy(ActorCriticPolicy):
    def forward(self, obs, deterministic=False):
        return super().forward(obs, deterministic)


OTHERS = {
    "images": dict(policy="CnnPolicy", env=RandomEnv(observation_space=IMAGE)),
    "images as vectors": dict(env=RandomEnv(observation_space=IMAGE)),
    "Dict": dict(policy="MultiInputPolicy", env=RandomEnv(observation_space=DICT)),
    "Discrete": dict(env=RandomEnv(observation_space=spaces.Discrete(5))),
    "own forward": dict(policy=OwnForwardPolicy),
    "own extractor": dict(policy_kwargs=dict(features_extractor_class=NormalisedExtractor)),
    "IMPALA": dict(policy=ImpalaPolicy, env=RandomEnv(observation_space=spaces.Box(0, 255, (64, 64, 3), np.uint8))),
}


def make(policy="MlpPolicy", env=None, algorithm=PPO, **arguments):
    return algorithm(policy, env or RandomEnv(), **{**PPO_SETTINGS, **arguments})


def _forbid_action_0(policy):
    def masked(self, latent):
        logits = self.action_net(latent).clone()
        logits[:, 0] = -1e9
        return self.action_dist.proba_distribution(logits)

    policy._get_action_dist_from_latent = MethodType(masked, policy)


def _double_outputs(policy):
    forward = policy.action_net.forward
    policy.action_net.forward = lambda latent: 2 * forward(latent)


def _shift_features(policy):
    extract = policy.extract_features
    policy.extract_features = lambda obs, *args: 1 + extract(obs, *args)


def _swap_hidden(policy):
    policy.mlp_extractor.forward_actor = policy.mlp_extractor.forward_critic


@pytest.mark.parametrize("churn_coef", [0.0, 1e-6])
@pytest.mark.parametrize("change", [_forbid_action_0, _double_outputs, _shift_features, _swap_hidden])
def test_methods_replaced_on_the_policy_are_called(change, churn_coef):
    def learned(change, **arguments):
        model = make(**arguments)
        change(model.policy)
        return list(model.learn(128).policy.parameters())

    arguments = dict(algorithm=CChainPPO, churn_coef=churn_coef)
    plain, changed, unchanged = learned(change), learned(change, **arguments), learned(lambda policy: None, **arguments)
    # With λ near 0, to rounding
    assert all(th.allclose(a, b, rtol=1e-3, atol=1e-5) for a, b in zip(plain, changed, strict=True))
    assert not all(th.allclose(a, b, rtol=1e-3, atol=1e-5) for a, b in zip(plain, unchanged, strict=True))


def test_hooks_of_all_modules_are_called():
    calls = {}
    for algorithm in (PPO, CChainPPO):
        seen = []
        hook = register_module_forward_hook(lambda *_, seen=seen: seen.append(None))
        try:
            make(algorithm=algorithm, **({} if algorithm is PPO else {"churn_coef": 0.0})).learn(64)
        finally:
            hook.remove()
        calls[algorithm] = len(seen)
    assert calls[CChainPPO] == calls[PPO] > 64


@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("arguments", PLAIN.values(), ids=PLAIN)
def test_same_results_to_the_bit(arguments, deterministic):
    model = make(**arguments)
    assert has_plain_forward(model.policy)
    for n_envs in (1, 5):
        space = model.observation_space
        obs = th.as_tensor(np.stack([space.sample() for _ in range(n_envs)]))
        results = []
        for forward in (model.policy.forward, LeanForward(model.policy)):
            th.manual_seed(0)
            if model.use_sde:
                model.policy.reset_noise(n_envs)
            with th.no_grad():
                results.append([*forward(obs, deterministic=deterministic), th.get_rng_state()])
        for one, other in zip(*results, strict=True):
            assert one.shape == other.shape and th.equal(one, other)


@pytest.mark.parametrize("arguments", OTHERS.values(), ids=OTHERS)
def test_other_policies_stay(arguments):
    assert not has_plain_forward(make(**arguments).policy)


def test_compiled_and_changed_policies_stay():
    model = make()
    assert not has_plain_forward(th.compile(model.policy, backend="eager"))
    model.policy.compile(backend="eager")
    compiled = model.policy._compiled_call_impl
    with lean_forward(model.policy):
        assert model.policy._compiled_call_impl is compiled
    model = make()
    own = model.policy.forward = lambda *args: ActorCriticPolicy.forward(model.policy, *args)
    assert not has_plain_forward(model.policy)
    with lean_forward(model.policy):
        assert model.policy.forward is own


class InRollouts(BaseCallback):
    def __init__(self, function):
        super().__init__()
        self.function = function

    def _on_step(self):
        self.function(self.model)
        return True


@pytest.mark.parametrize("lean", [True, False])
def test_rollouts_of_cchain_ppo(lean):
    seen = []
    model = make(algorithm=CChainPPO, lean=lean)
    model.learn(64, InRollouts(lambda model: seen.append(isinstance(model.policy._compiled_call_impl, LeanForward))))
    assert seen == [lean] * 64
    assert model.policy._compiled_call_impl is None


def test_nothing_stays_when_training_is_interrupted():
    def interrupt(model):
        raise KeyboardInterrupt

    model = make(algorithm=CChainPPO)
    with pytest.raises(KeyboardInterrupt):
        model.learn(64, InRollouts(interrupt))
    assert model.policy._compiled_call_impl is None


def test_hooks_that_are_registered_in_a_rollout_are_called():
    n_calls = []
    model = make(algorithm=CChainPPO)

    def register(model):
        if model.num_timesteps == 10:
            assert isinstance(model.policy._compiled_call_impl, LeanForward)
            model.policy.action_net.register_forward_hook(lambda *_: n_calls.append(model.num_timesteps))

    model.learn(32, InRollouts(register))
    assert n_calls[:22] == list(range(10, 32))


def test_layer_put_in_place_in_a_rollout():
    class Always2(nn.Module):
        def forward(self, latent):
            return latent.new_tensor([[-50.0, -50.0, 50.0]])

    def replace(model):
        if model.num_timesteps == 10:
            model.policy.action_net = Always2()

    model = make(algorithm=CChainPPO, n_epochs=1)
    model.train = lambda: None
    model.learn(32, InRollouts(replace))
    assert (model.rollout_buffer.actions[10:] == 2).all() and not (model.rollout_buffer.actions[:10] == 2).all()


class Scaled(nn.Flatten):
    """A features extractor."""

    def __init__(self):
        super().__init__()
        self.features_dim = 4
        self.scale = nn.Parameter(th.tensor(5.0))

    def forward(self, observations):
        return super().forward(observations) * self.scale


class Adapter(nn.Module):
    """Its children are not called one after the other."""

    def __init__(self, base):
        super().__init__()
        self.base, self.down, self.up = base, nn.Linear(4, 2), nn.Linear(2, 64)

    def forward(self, features):
        return self.base(features) + self.up(self.down(features))


def _frozen(policy):
    layer = policy.mlp_extractor.policy_net[0]
    weight = layer.weight.detach().clone()
    del layer.weight
    layer.register_buffer("weight", weight)


def _plain_tensor(policy):
    layer = policy.action_net
    bias = layer.bias.detach().clone()
    del layer.bias
    layer.bias = bias


CHANGES = {
    "adapter": lambda policy: setattr(policy.mlp_extractor, "policy_net", Adapter(policy.mlp_extractor.policy_net)),
    "extractor": lambda policy: setattr(policy, "features_extractor", Scaled()),
    "extractor of the policy": lambda policy: setattr(policy, "pi_features_extractor", Scaled()),
    "extractor of the values": lambda policy: setattr(policy, "vf_features_extractor", Scaled()),
    "in the extractor": lambda policy: setattr(policy.features_extractor, "flatten", Scaled()),
    "method of a layer": lambda policy: setattr(policy.action_net, "forward", lambda latent: latent[:, :3]),
    "own latent": lambda policy: setattr(policy.mlp_extractor, "forward_critic", policy.mlp_extractor.forward_actor),
    "hook": lambda policy: policy.mlp_extractor.policy_net.register_forward_hook(lambda _, inputs, output: 2 * output),
    "buffer": _frozen,
    "plain tensor": _plain_tensor,
}


class AtRolloutStart(BaseCallback):
    def __init__(self, change):
        super().__init__()
        self.change = change

    def _on_rollout_start(self):
        self.change(self.model.policy)

    def _on_step(self):
        return True


@pytest.mark.parametrize("share", [True, False])
@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_changes_at_the_start_of_a_rollout_count_in_it(change, share):
    model = make(algorithm=CChainPPO, churn_coef=1.0, policy_kwargs=dict(share_features_extractor=share))
    train, model.train = model.train, lambda: None
    model.learn(32, AtRolloutStart(change))
    samples = next(model.rollout_buffer.get(32))
    values, log_prob, _ = model.policy.evaluate_actions(samples.observations, samples.actions.long().flatten())
    assert th.allclose(values.flatten(), samples.old_values, atol=1e-5)
    assert th.allclose(log_prob, samples.old_log_prob, atol=1e-5)
    model.policy.optimizer = th.optim.Adam(model.policy.parameters())
    train()


def test_forward_set_at_the_start_of_a_rollout_stays():
    n_calls = []

    def count(policy):
        forward = policy.forward
        policy.forward = lambda *args: n_calls.append(None) or forward(*args)

    model = make(algorithm=CChainPPO).learn(32, AtRolloutStart(count))
    assert len(n_calls) == 32 and "forward" in vars(model.policy)


@pytest.mark.parametrize("share", [True, False])
def test_joint_evaluation_takes_the_extractor_that_evaluation_takes(share):
    policy = make(
        "MultiInputPolicy", RandomEnv(observation_space=DICT), policy_kwargs=dict(share_features_extractor=share)
    ).policy
    extractor = policy.features_extractor = copy.deepcopy(policy.features_extractor)
    extractor.register_forward_hook(lambda _, inputs, output: 5 * output)
    obs, _ = policy.obs_to_tensor({name: np.stack([space.sample()] * 3) for name, space in DICT.items()})
    expected = policy.evaluate_actions(obs, th.tensor([0, 1, 2]))
    assert all(map(th.allclose, evaluate_jointly(PolicyNetworks(policy), obs, th.tensor([0, 1, 2])), expected))


class OwnNetwork(nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(4, 64)

    def forward(self, features):
        return self.layer(features)


class OwnNetworkPolicy(ActorCriticPolicy):
    def _build_mlp_extractor(self):
        super()._build_mlp_extractor()
        self.mlp_extractor.policy_net = OwnNetwork()


def test_policies_with_other_networks_train():
    assert not has_plain_forward(make(OwnNetworkPolicy).policy)
    make(OwnNetworkPolicy, algorithm=CChainPPO).learn(64)
    model = make(algorithm=CChainPPO)
    model.policy.mlp_extractor.policy_net = th.compile(model.policy.mlp_extractor.policy_net, backend="eager")
    model.learn(64)


def test_layers_put_in_place_between_rollouts():
    model = make(algorithm=CChainPPO).learn(32)
    with th.no_grad():
        model.policy.mlp_extractor.policy_net = nn.Sequential(nn.Linear(4, 64), nn.ReLU())
    obs = th.randn(3, 4)
    with lean_forward(model.policy), th.no_grad():
        assert th.equal(model.policy(obs, deterministic=True)[1], model.policy.predict_values(obs))
        lean = model.policy(obs, deterministic=True)[2]
    assert th.equal(lean, model.policy(obs, deterministic=True)[2])


def test_copy_of_a_model_in_a_rollout_acts_by_itself():
    copies = []
    model = make(algorithm=CChainPPO)
    model.learn(32, InRollouts(lambda model: copies.append(copy.deepcopy(model.policy)) if not copies else None))
    (policy,) = copies
    before = [parameter.clone() for parameter in model.policy.parameters()]
    with th.no_grad():
        for parameter in policy.parameters():
            parameter.zero_()
        assert policy(th.ones(1, 4))[1] == 0
    assert all(map(th.equal, before, model.policy.parameters()))


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda policy: pickle.loads(pickle.dumps(policy))])
def test_nothing_is_replaced_on_a_copy_made_in_a_rollout(copied):
    policies = []
    make(algorithm=CChainPPO, n_epochs=1).learn(4, InRollouts(lambda model: policies.append(copied(model.policy))))
    assert all(policy._compiled_call_impl is None and "forward" not in vars(policy) for policy in policies)


def test_a_compiled_part_is_no_replaced_method():
    model = make(algorithm=CChainPPO)
    assert can_evaluate_jointly(model.policy)
    model.policy.mlp_extractor.policy_net = th.compile(model.policy.mlp_extractor.policy_net, backend="eager")
    assert can_evaluate_jointly(model.policy)
