"""Where CChainPPO's reference batches come from, and that they go through the policy with the minibatches."""

import copy
from contextlib import nullcontext
from itertools import pairwise
from types import MethodType
from unittest.mock import patch

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from torch import nn

from sb3_cchain import CChainPPO
from sb3_cchain.algorithms import epochs, on_policy
from sb3_cchain.algorithms.reference_batches import ReferenceBatches
from sb3_cchain.networks.joint_evaluation import can_evaluate_jointly
from tests.churn_models import (
    ACTION_SPACES,
    DICT,
    IMAGE,
    assert_churn_was_reduced,
    assert_close,
    assert_equal,
    churn_keys,
    learn_in_double_precision,
    spied,
)
from tests.envs import RandomEnv

# Of the arguments that the reference batches depend on: more samples than the minibatch has, and fewer
REFERENCES = [("independent", 1.0), ("independent", 0.5), ("independent", 3.0), ("next", 1.0), ("next", 0.5), ("next", 2.5)]
each_reference = pytest.mark.parametrize("kind, size", REFERENCES)


# --- Which samples -----------------------------------------------------------------------------------------------------------


def filled_buffer(n_samples):
    """A rollout whose observations are 0, 1, 2, …"""
    buffer = RolloutBuffer(n_samples, spaces.Box(0, 1000, (1,)), spaces.Discrete(2))
    for index in range(n_samples):
        buffer.add(np.array([[index]]), np.zeros((1, 1)), np.zeros(1), np.zeros(1), th.zeros(1), th.zeros(1))
    return buffer


def epoch(n_samples, batch_size, kind, size):
    """Of each minibatch: its samples, those of its reference batch, and how many it shares with the reference batch before."""
    buffer = filled_buffer(n_samples)
    np.random.seed(0)
    references = ReferenceBatches(buffer, kind, size)
    return [
        (minibatch.observations.flatten().tolist(), references.current.flatten().tolist(), references.n_shared)
        for minibatch in references.get(batch_size)
    ]


@pytest.mark.parametrize("n_samples, batch_size", [(64, 16), (64, 32), (60, 20), (70, 32), (64, 8), (33, 8), (5, 1)])
@each_reference
def test_reference_batch_shares_nothing_with_its_minibatch(n_samples, batch_size, kind, size):
    batches = epoch(n_samples, batch_size, kind, size)
    assert sorted(sample for minibatch, *_ in batches for sample in minibatch) == list(range(n_samples))
    for minibatch, reference, _ in batches:
        assert not set(minibatch) & set(reference)
        assert len(set(reference)) == len(reference) == min(max(round(size * batch_size), 1), n_samples - len(minibatch))


@pytest.mark.parametrize("n_samples, batch_size", [(64, 16), (70, 32), (33, 8)])
@each_reference
def test_samples_shared_with_the_next_minibatch(n_samples, batch_size, kind, size):
    batches = epoch(n_samples, batch_size, kind, size)
    assert batches[0][2] == 0
    for (_, reference, _), (minibatch, _, n_shared) in pairwise(batches):
        if kind == "independent":
            assert n_shared == 0
        else:
            assert n_shared == min(len(reference), len(minibatch)) > 0
        assert reference[:n_shared] == minibatch[:n_shared]


@pytest.mark.parametrize("size, n_expected", [(0.5, 8), (1.0, 16), (2.0, 16)])
@pytest.mark.parametrize("kind", ["independent", "next"])
def test_single_minibatch_is_its_own_reference_batch(kind, size, n_expected):
    [(minibatch, reference, n_shared)] = epoch(16, 16, kind, size)
    assert len(reference) == n_expected and set(reference) <= set(minibatch)
    assert n_shared == 0


def test_random_numbers_and_minibatches_are_those_of_the_buffer():
    buffers = [filled_buffer(70) for _ in range(2)]
    np.random.seed(0)
    stock = [minibatch.observations.tolist() for _ in range(2) for minibatch in buffers[0].get(32)]
    np.random.seed(0)
    references = ReferenceBatches(buffers[1], "independent", 2.0)
    assert [minibatch.observations.tolist() for _ in range(2) for minibatch in references.get(32)] == stock


class OwnBuffer(RolloutBuffer):
    """Makes its minibatches in its own way."""

    def get(self, batch_size=None):
        for minibatch in super().get(batch_size):
            yield minibatch._replace(observations=-minibatch.observations)


class OwnDictBuffer(DictRolloutBuffer):
    def get(self, batch_size=None):
        yield from super().get(batch_size)


@each_reference
def test_buffers_are_read_in_the_same_order(kind, size, monkeypatch):
    held = epoch(70, 32, kind, size)
    monkeypatch.setattr(epochs, "HELD_AT_MOST", 0)
    gathered = epoch(70, 32, kind, size)
    monkeypatch.setattr("tests.test_reference_batches.RolloutBuffer", OwnBuffer)
    own = epoch(70, 32, kind, size)
    assert gathered == held
    assert own == [([-x for x in minibatch], [-x for x in reference], n) for minibatch, reference, n in held]


@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
@pytest.mark.parametrize("buffer_class, limit", [(DictRolloutBuffer, 0), (OwnDictBuffer, 2**24)])
def test_dict_observations(buffer_class, limit, monkeypatch):
    env = RandomEnv(observation_space=DICT)
    models = [
        CChainPPO(
            "MultiInputPolicy", env, rollout_buffer_class=each, n_steps=36, batch_size=8, n_epochs=2, seed=0, device="cpu"
        )
        for each in (None, buffer_class)
    ]
    for model, held_at_most in zip(models, (2**24, limit), strict=True):
        monkeypatch.setattr(epochs, "HELD_AT_MOST", held_at_most)
        model.set_random_seed(0)
        model.learn(72, log_interval=10**6)
        assert_churn_was_reduced(model)
    assert_equal(*models)


class CentringBuffer(RolloutBuffer):
    """Gathers its minibatches in its own way."""

    def _get_samples(self, batch_inds, env=None):
        samples = super()._get_samples(batch_inds, env)
        return samples._replace(advantages=samples.advantages - samples.advantages.mean())


def test_minibatches_are_gathered_as_the_buffer_does():
    model = CChainPPO("MlpPolicy", RandomEnv(), rollout_buffer_class=CentringBuffer, n_steps=32, batch_size=8, device="cpu")
    model.learn(32)
    minibatches = list(ReferenceBatches(model.rollout_buffer).get(8))
    assert len(minibatches) == 4
    assert all(abs(minibatch.advantages.mean()) < 1e-6 for minibatch in minibatches)


# --- How they go through the policy ------------------------------------------------------------------------------------------

SETTINGS = dict(n_steps=64, batch_size=16, n_epochs=5, learning_rate=3e-3, ent_coef=0.01, seed=0, device="cpu")
N_ITERATIONS = 3  # 60 updates; λ adapts in the last of them


FORMS_OF_POLICY = {
    "Discrete": dict(env=lambda: RandomEnv()),
    "MultiDiscrete": dict(env=lambda: RandomEnv(action_space=ACTION_SPACES[1])),
    "MultiBinary": dict(env=lambda: RandomEnv(action_space=ACTION_SPACES[2])),
    "Box": dict(env=lambda: RandomEnv(action_space=ACTION_SPACES[3])),
    "gSDE": dict(env=lambda: RandomEnv(action_space=ACTION_SPACES[3]), use_sde=True),
    "Dict": dict(env=lambda: RandomEnv(observation_space=DICT), policy="MultiInputPolicy"),
    "own extractors": dict(env=lambda: RandomEnv(), policy_kwargs=dict(share_features_extractor=False)),
}


def learn(env, jointly, **arguments):
    with spied(on_policy, "joint_passes") as joint:
        with nullcontext() if jointly else patch.object(on_policy, "can_evaluate_jointly", lambda policy: False):
            model = learn_in_double_precision(CChainPPO, 64 * N_ITERATIONS, env(), **{**SETTINGS, **arguments})
    assert joint.call_count == (N_ITERATIONS if jointly else 0)
    return model


@pytest.mark.parametrize(
    "form, kind, size",
    [
        *(("Discrete", *reference) for reference in REFERENCES),
        *((form, *reference) for form in FORMS_OF_POLICY if form != "Discrete" for reference in REFERENCES[::3]),
    ],
)
def test_joint_passes_make_the_same_updates(form, kind, size):
    arguments = dict(FORMS_OF_POLICY[form], churn_reference=kind, churn_batch_size=size, churn_warmup=2)
    joint, separate = (learn(jointly=jointly, **arguments) for jointly in (True, False))
    assert joint.policy.optimizer.state_dict()["state"][0]["step"] == 60
    assert_close(joint, separate, atol=1e-12)
    assert_churn_was_reduced(joint)
    for key in churn_keys(joint):
        assert joint.logger.name_to_value[key] == pytest.approx(separate.logger.name_to_value[key], rel=1e-6), key


@pytest.mark.parametrize("kind, jointly", [("independent", False), ("next", True)])
def test_convolutions_see_one_batch_after_the_other(kind, jointly):
    settings = dict(n_steps=16, batch_size=8, n_epochs=1, seed=0, device="cpu")
    model = CChainPPO("CnnPolicy", RandomEnv(observation_space=IMAGE), churn_reference=kind, **settings)
    with spied(on_policy, "joint_passes") as joint:
        assert_churn_was_reduced(model.learn(32))
    assert joint.called == jointly


@pytest.mark.parametrize("register", ["register_forward_hook", "register_forward_pre_hook", "register_full_backward_hook"])
def test_hooks_see_what_they_see_in_ppo(register):
    """Minibatches alone, and each backward pass of PPO's loss."""

    def sizes(algorithm, **arguments):
        seen = []
        settings = dict(n_steps=16, batch_size=8, n_epochs=1, seed=0, device="cpu")
        model = algorithm("MlpPolicy", RandomEnv(), **settings, **arguments).learn(16)
        getattr(model.policy.action_net, register)(lambda *_: seen.append(th.is_grad_enabled()))
        model.train()
        return len(seen)

    # With C-CHAIN, the reference batch before, and the outputs of the one after, come to each update
    n_passes = {"register_full_backward_hook": 2}.get(register, 3)
    assert sizes(CChainPPO) == n_passes * sizes(PPO)


def test_hooks_see_training_mode_in_the_updates_alone():
    """What they do there, such as moving statistics, they do not do on reference batches."""

    def n_training(algorithm):
        seen = []
        settings = dict(n_steps=16, batch_size=8, n_epochs=1, seed=0, device="cpu")
        model = algorithm("MlpPolicy", RandomEnv(), **settings)
        model.policy.action_net.register_forward_pre_hook(lambda layer, inputs: seen.append(layer.training))
        model.learn(32)
        return sum(seen)

    assert n_training(CChainPPO) == n_training(PPO) == 4


def forbid_action_0(policy):
    def masked(self, latent):
        logits = self.action_net(latent).clone()
        logits[:, 0] = -1e9
        return self.action_dist.proba_distribution(logits)

    policy._get_action_dist_from_latent = MethodType(masked, policy)


def double_outputs(policy):
    forward = policy.action_net.forward
    policy.action_net.forward = lambda latent: 2 * forward(latent)


def shift_features(policy):
    extract = policy.extract_features
    policy.extract_features = lambda obs, *args: 1 + extract(obs, *args)


def squash_features(policy):
    """Of the shared extractor alone: SB3 also has the former one under the actor's and the critic's names."""
    policy.features_extractor = copy.deepcopy(policy.features_extractor)
    policy.features_extractor.flatten = nn.Sequential(nn.Flatten(), nn.Tanh())


def take_the_critics_units(policy):
    policy.mlp_extractor.forward_actor = policy.mlp_extractor.forward_critic


def put_in_one_layer(policy):
    policy.mlp_extractor.policy_net = nn.Sequential(nn.Linear(4, 64), nn.ReLU())


def hook_outputs(policy):
    policy.action_net.register_forward_hook(lambda _, inputs, outputs: 2 * outputs)


CHANGES = (
    forbid_action_0,
    double_outputs,
    shift_features,
    squash_features,
    take_the_critics_units,
    put_in_one_layer,
    hook_outputs,
)


@pytest.mark.parametrize("churn_coef", [0.0, 1e-6])
@pytest.mark.parametrize("change", CHANGES)
def test_changes_of_a_policy_count_in_rollouts_and_updates_as_in_ppo(change, churn_coef):
    def learned(algorithm, change, **arguments):
        settings = dict(n_steps=32, batch_size=8, n_epochs=2, seed=0, device="cpu")
        model = algorithm("MlpPolicy", RandomEnv(), **settings, **arguments)
        change(model.policy)
        policy = model.learn(64).policy
        return [*policy.action_net.parameters(), *policy.value_net.parameters()]

    def close(ones, others):
        return all(th.allclose(one, other, rtol=1e-3, atol=1e-5) for one, other in zip(ones, others, strict=True))

    changed = learned(CChainPPO, change, churn_coef=churn_coef)
    assert close(changed, learned(PPO, change))
    assert not close(changed, learned(CChainPPO, lambda policy: None, churn_coef=churn_coef))


def test_a_compiled_part_is_no_replaced_method():
    policy = CChainPPO("MlpPolicy", RandomEnv(), device="cpu").policy
    policy.mlp_extractor.policy_net = th.compile(policy.mlp_extractor.policy_net, backend="eager")
    assert can_evaluate_jointly(policy)
