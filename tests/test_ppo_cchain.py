"""CChainPPO: what is special about churn reduction of PPO's policy."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.distributions import CategoricalDistribution, DiagGaussianDistribution
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_cchain import CChainPPO
from sb3_cchain.networks.joint_evaluation import can_evaluate_jointly
from sb3_cchain.networks.policy_outputs import policy_outputs
from tests.churn_models import ACTION_SPACES, FORMS, NormalisedExtractor, assert_churn_was_reduced, assert_equal, churn_keys
from tests.envs import RandomEnv

SETTINGS = FORMS["CChainPPO"].settings
learn = FORMS["CChainPPO"].learn


@pytest.mark.parametrize("squash", [False, True])
def test_gsde(squash):
    env = RandomEnv(action_space=ACTION_SPACES[-1])
    model = learn(env, use_sde=True, sde_sample_freq=4, policy_kwargs=dict(squash_output=squash))
    assert_churn_was_reduced(model)


def test_batch_norm_and_dropout_act_in_the_churn_loss_as_they_do_in_the_environment():
    model = learn(RandomEnv(), policy_kwargs=dict(features_extractor_class=NormalisedExtractor))
    assert_churn_was_reduced(model)
    # Reference batches neither move the running statistics nor draw from the random numbers of dropout, so that a λ
    # too small to matter leaves the parameters as PPO's
    tiny = learn(RandomEnv(), policy_kwargs=dict(features_extractor_class=NormalisedExtractor), churn_coef=1e-30)
    plain = PPO("MlpPolicy", RandomEnv(), policy_kwargs=dict(features_extractor_class=NormalisedExtractor), **SETTINGS)
    plain.learn(64)
    assert_equal(plain, tiny)


class CountingBuffer(RolloutBuffer):
    n_gets = 0

    def get(self, batch_size=None):
        self.n_gets += 1
        yield from super().get(batch_size)


def test_other_arguments_of_ppo():
    model = learn(
        RandomEnv(),
        rollout_buffer_class=CountingBuffer,
        stats_window_size=3,
        target_kl=1.0,
        clip_range_vf=0.2,
        normalize_advantage=False,
        learning_rate=lambda progress: 1e-3 * (1 + progress),
    )
    assert_churn_was_reduced(model)
    assert model.rollout_buffer.n_gets == 4
    assert "get" not in vars(model.rollout_buffer) and "zero_grad" not in vars(model.policy.optimizer)
    assert model.ep_info_buffer.maxlen == 3


def test_early_stopping_before_the_first_update():
    model = learn(RandomEnv(), target_kl=-1.0)
    assert model.policy.optimizer.state_dict()["state"] == {}  # not one update
    assert not churn_keys(model) & set(model.logger.name_to_value)
    assert model.churn_reducer.coefficient.n_seen == 0


@pytest.mark.parametrize("churn_base_loss, of_entropy", [("actor", 0.01), ("surrogate", 0.0)])
def test_adaptive_coefficient_holds_the_ratio(churn_base_loss, of_entropy):
    # A window of one iteration: λ of an iteration is set by the losses of the one before
    arguments = dict(churn_warmup=1, churn_window=1, churn_base_loss=churn_base_loss)
    model = CChainPPO("MlpPolicy", "CartPole-v1", ent_coef=0.01, **arguments, **SETTINGS)
    model.learn(5 * 32)
    logged = model.logger.name_to_value
    base_loss = abs(logged["train/policy_gradient_loss"] + of_entropy * logged["train/entropy_loss"])
    assert logged["churn/relative_loss"] == pytest.approx(logged["churn/coef"] * logged["churn/loss"] / base_loss, rel=1e-4)
    coefficient = model.churn_reducer.coefficient
    assert coefficient.base_losses.item() == pytest.approx(base_loss)
    assert coefficient.churn_losses.item() == pytest.approx(logged["churn/loss"])
    assert coefficient.value == pytest.approx(1e4 * base_loss / logged["churn/loss"], rel=1e-4)


@pytest.mark.parametrize("component", ["full", "projection"])  # one pass for both losses, and passes of their own
@pytest.mark.parametrize("normalize_advantage", [True, False])
def test_the_losses_of_the_last_minibatch_set_the_coefficient(component, normalize_advantage):
    # SB3 logs the loss of the last minibatch: without entropy and values it is the clipped surrogate
    arguments = dict(churn_warmup=1, churn_window=1, churn_base_loss="last", churn_component=component)
    losses = dict(ent_coef=0.0, vf_coef=0.0, normalize_advantage=normalize_advantage, learning_rate=1e-2)
    model = CChainPPO("MlpPolicy", "CartPole-v1", **arguments, **losses, **{**SETTINGS, "n_epochs": 3})
    churn_losses = []
    record = model.churn_reducer.record
    model.churn_reducer.record = lambda loss: (churn_losses.append(loss.item()), record(loss))[1]
    model.learn(4 * 32)
    logged, coefficient = model.logger.name_to_value, model.churn_reducer.coefficient
    assert coefficient.base_losses.item() == pytest.approx(abs(logged["train/loss"]), rel=1e-5)
    assert logged["train/loss"] != pytest.approx(logged["train/policy_gradient_loss"], rel=1e-3)  # the mean
    assert coefficient.churn_losses.item() == pytest.approx(churn_losses[-1]) == pytest.approx(logged["churn/loss"])
    assert "evaluate_actions" not in vars(model.policy) and "get" not in vars(model.rollout_buffer)


def test_the_last_minibatch_is_that_of_the_last_update():
    """``target_kl`` stops after a minibatch was evaluated: SB3 logs its loss, and no update is made with it."""
    arguments = dict(churn_warmup=1, churn_window=1, churn_base_loss="last", target_kl=0.01, ent_coef=0.0, vf_coef=0.0)
    model = CChainPPO("MlpPolicy", "CartPole-v1", **arguments, **{**SETTINGS, "learning_rate": 1e-2, "n_epochs": 3})
    model.learn(32)
    coefficient, logged = model.churn_reducer.coefficient, model.logger.name_to_value
    assert coefficient.n_seen == 1 and coefficient.base_losses.item() != pytest.approx(abs(logged["train/loss"]), rel=1e-3)


@pytest.mark.parametrize("target", ["value", "both"])
def test_the_last_minibatch_is_for_the_policy_alone(target):
    with pytest.raises(ValueError, match=r"`churn_base_loss` must be .* unless `churn_target` is .*, got 'last'"):
        CChainPPO("MlpPolicy", "CartPole-v1", churn_base_loss="last", churn_target=target)


def test_policy_churn_is_the_kl_divergence():
    """One update per iteration, so that the logged mean is one number that can be computed from two saved policies."""
    model = CChainPPO(
        "MlpPolicy", RandomEnv(), n_steps=32, batch_size=16, n_epochs=1, learning_rate=1e-2, seed=0, device="cpu"
    )
    pairs = []

    def record(churn_loss, record=model.churn_reducer.record):
        reducer = model.churn_reducer
        with th.no_grad():
            new = model.policy.get_distribution(reducer.reference).distribution
        old = th.distributions.Categorical(probs=reducer.old_outputs)
        pairs.append(th.distributions.kl_divergence(old, new).mean().item())
        record(churn_loss)

    model.churn_reducer.record = record
    model.learn(2 * 32)
    assert model.logger.name_to_value["churn/policy_churn"] == pytest.approx(np.mean(pairs[-2:]), abs=1e-6)


@pytest.mark.parametrize(
    "arguments",
    [
        dict(env=RandomEnv(), n_steps=33, batch_size=8),  # the last minibatch has one sample
        dict(env=RandomEnv(), n_steps=8, batch_size=1, n_epochs=1, normalize_advantage=False),
        dict(env=RandomEnv(action_space=spaces.Discrete(1400))),
        dict(env=RandomEnv(action_space=spaces.MultiDiscrete([700, 2]))),
    ],
    ids=["last of one", "one", "many actions", "many sub-actions"],
)
@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
def test_unusual_sizes_stay_finite(arguments):
    model = learn(**arguments)
    assert all(np.isfinite(value) for key, value in model.logger.name_to_value.items() if key.startswith("churn/"))
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())


@pytest.mark.parametrize("action_space", [ACTION_SPACES[0], ACTION_SPACES[-1]], ids=lambda space: type(space).__name__)
def test_large_weights_stay_finite(action_space):
    model = CChainPPO("MlpPolicy", RandomEnv(action_space=action_space), **SETTINGS)
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.mul_(1e5)
    model.learn(64)
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())
    assert np.isfinite(model.churn_reducer.coefficient.value)


@pytest.mark.parametrize("action_space", ACTION_SPACES, ids=lambda space: type(space).__name__)
def test_outputs_are_those_of_the_distribution(action_space):
    class SamePolicy(ActorCriticPolicy):
        def get_distribution(self, obs):
            return super().get_distribution(obs)

    policies = [CChainPPO(cls, RandomEnv(action_space=action_space), **SETTINGS).policy for cls in ("MlpPolicy", SamePolicy)]
    observations = th.randn(5, 4)
    assert th.allclose(*(policy_outputs(policy, observations) for policy in policies))


class TemperedPolicy(ActorCriticPolicy):
    """Acts by other probabilities than those of its last layer."""

    def _get_action_dist_from_latent(self, latent_pi):
        return self.action_dist.proba_distribution(action_logits=50 * self.action_net(latent_pi))


def test_a_policy_with_a_distribution_of_its_own():
    model = learn(RandomEnv(), policy=TemperedPolicy)
    assert_churn_was_reduced(model)
    observations = th.randn(5, 4)
    acting = model.policy.get_distribution(observations).distribution.probs
    assert th.allclose(policy_outputs(model.policy, observations), acting)


class Tempered(CategoricalDistribution):
    def proba_distribution(self, action_logits):
        return super().proba_distribution(50 * action_logits)


class Bounded(DiagGaussianDistribution):
    def proba_distribution(self, mean_actions, log_std):
        return super().proba_distribution((50 * mean_actions).tanh(), log_std)


class NegativePolicy(ActorCriticPolicy):
    """A method of SB3's distribution is replaced on it."""

    def _build(self, lr_schedule):
        super()._build(lr_schedule)
        proba_distribution = self.action_dist.proba_distribution
        self.action_dist.proba_distribution = lambda action_logits: proba_distribution(-50 * action_logits)


class TemperedClassPolicy(ActorCriticPolicy):
    def _build(self, lr_schedule):
        self.action_dist = Tempered(int(self.action_space.n))
        super()._build(lr_schedule)


class BoundedClassPolicy(ActorCriticPolicy):
    def _build(self, lr_schedule):
        self.action_dist = Bounded(self.action_space.shape[0])
        super()._build(lr_schedule)


@pytest.mark.parametrize(
    "policy, action_space",
    [
        (TemperedClassPolicy, spaces.Discrete(3)),
        (NegativePolicy, spaces.Discrete(3)),
        (BoundedClassPolicy, spaces.Box(-1, 1, (2,))),
    ],
)
def test_distributions_of_an_own_class_are_held_still_as_they_act(policy, action_space):
    model = CChainPPO(policy, RandomEnv(action_space=action_space), **SETTINGS).learn(64)
    assert "Lean" not in type(model.policy.action_dist).__name__
    observations = th.randn(5, 4)
    distribution = model.policy.get_distribution(observations).distribution
    acting = distribution.probs if action_space.shape == () else distribution.mean
    assert th.allclose(policy_outputs(model.policy, observations), acting)
    assert not can_evaluate_jointly(model.policy)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("verbose, n_lines", [(0, 0), (1, 1)])
def test_rollout_of_one_minibatch_is_its_own_reference(verbose, n_lines, capsys):
    model = CChainPPO("MlpPolicy", "CartPole-v1", n_steps=32, batch_size=32, n_epochs=2, verbose=verbose, device="cpu")
    model.learn(3 * 32)
    assert capsys.readouterr().out.count("32 steps is a single minibatch of batch_size=32") == n_lines
    assert len(model.churn_reducer.coefficient.churn_losses.nonzero()) == 3


def test_value_churn_is_of_the_first_update_of_each_epoch_on_32_samples():
    settings = dict(n_steps=120, batch_size=40, n_epochs=2, learning_rate=1e-2, seed=0, device="cpu")
    model, before, expected = CChainPPO("MlpPolicy", RandomEnv(), **settings), [], []

    def values(x):
        return model.policy.predict_values(x).detach()

    def note(*_):
        x = model.churn_reducer.reference[:32]
        before.append((x, values(x)))

    def compare(*_):
        if len(before) % 3 == 1:
            x, old = before[-1]
            expected.append((values(x) - old).abs().mean().item())

    model.policy.optimizer.register_step_pre_hook(note)
    model.policy.optimizer.register_step_post_hook(compare)
    model.learn(120)
    assert model.logger.name_to_value["churn/value_churn"] == pytest.approx(np.mean(expected), rel=1e-4)
