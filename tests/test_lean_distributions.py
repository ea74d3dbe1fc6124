"""Lean distributions are SB3's, to the bit."""

import copy

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.distributions import kl_divergence, make_proba_distribution
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_cchain import CChainCallback, CChainPPO, make_lean
from sb3_cchain.networks import lean_distributions
from tests.churn_models import ACTION_SPACES, PPO_SETTINGS, assert_equal
from tests.envs import RandomEnv

LEAN = {
    spaces.Discrete: lean_distributions.LeanCategorical,
    spaces.MultiDiscrete: lean_distributions.LeanMultiCategorical,
    spaces.MultiBinary: lean_distributions.LeanBernoulli,
    spaces.Box: lean_distributions.LeanDiagGaussian,
}
SPACES = [*ACTION_SPACES, spaces.Discrete(1), spaces.Discrete(300), spaces.MultiDiscrete([1, 7, 3]), spaces.Box(-1, 1, (1,))]
each_space = pytest.mark.parametrize("action_space", SPACES, ids=str)
SCALES = (1e-30, 1e-3, 1.0, 20.0, 1e3, 1e30)


def pair(action_space):
    """SB3's distribution and the lean one."""
    model = make_lean(PPO("MlpPolicy", RandomEnv(action_space=action_space), device="cpu"))
    assert type(model.policy.action_dist) is LEAN[type(action_space)]
    return make_proba_distribution(action_space), model.policy.action_dist


def n_outputs(action_space):
    if isinstance(action_space, spaces.MultiDiscrete):
        return sum(action_space.nvec)
    return action_space.n if not isinstance(action_space, spaces.Box) else action_space.shape[0]


def results(distribution, outputs, log_std, deterministic):
    """All that a policy asks of a distribution, the gradients, and the state of the random numbers."""
    outputs = outputs.clone().requires_grad_()
    parameters = [outputs] if log_std is None else [outputs, log_std.clone().requires_grad_()]
    th.manual_seed(3)
    distribution.proba_distribution(*parameters)
    actions = distribution.get_actions(deterministic)
    log_prob, entropy = distribution.log_prob(actions.detach()), distribution.entropy()
    gradients = th.autograd.grad((log_prob + 0.3 * entropy).sum(), parameters)
    return [actions, log_prob, entropy, *gradients, th.get_rng_state()]


@pytest.mark.parametrize("dtype", [th.float32, th.float64])
@pytest.mark.parametrize("deterministic", [False, True])
@each_space
def test_same_results_to_the_bit(action_space, deterministic, dtype):
    stock, lean = pair(action_space)
    generator = th.Generator().manual_seed(0)
    for scale in SCALES:
        for n_samples in (1, 1000):
            outputs = scale * th.randn(n_samples, n_outputs(action_space), generator=generator, dtype=dtype)
            log_std = None
            if isinstance(action_space, spaces.Box):
                log_std = 3 * th.randn(action_space.shape[0], generator=generator, dtype=dtype)
            expected = results(stock, outputs, log_std, deterministic)
            for one, other in zip(expected, results(lean, outputs, log_std, deterministic), strict=True):
                assert one.shape == other.shape and one.dtype == other.dtype
                assert one.numpy(force=True).tobytes() == other.numpy(force=True).tobytes(), scale


def test_excluded_actions():
    """Logits of minus infinity, as of a mask."""
    stock, lean = pair(spaces.Discrete(3))
    logits = th.tensor([[0.0, -np.inf, 1.0]])
    for one, other in zip(results(stock, logits, None, False), results(lean, logits, None, False), strict=True):
        assert th.equal(one.nan_to_num(), other.nan_to_num())


@each_space
def test_distribution_of_torch(action_space):
    stock, lean = pair(action_space)
    outputs = th.randn(5, n_outputs(action_space))
    parameters = [outputs] if not isinstance(action_space, spaces.Box) else [outputs, th.zeros(action_space.shape[0])]
    for distribution in (stock, lean):
        distribution.proba_distribution(*parameters)
    one, other = stock.distribution, lean.distribution
    assert type(one) is type(other)
    for mine, others in zip(one, other, strict=True) if isinstance(one, list) else [(one, other)]:
        assert type(mine) is type(others)
        assert th.equal(mine.entropy(), others.entropy())
    assert th.equal(kl_divergence(lean, lean), kl_divergence(stock, stock))


def in_place(distribution):
    for each in distribution if isinstance(distribution, list) else [distribution]:
        if isinstance(each, th.distributions.Normal):
            each.scale = 0.01 * each.scale
        else:
            each.logits[..., 0] = -50.0
    return distribution


def another(distribution):
    if isinstance(distribution, list):
        return [another(each) for each in distribution]
    if isinstance(distribution, th.distributions.Normal):
        return th.distributions.Normal(distribution.loc + 1, 0.01 * distribution.scale)
    return type(distribution)(logits=-3 * distribution.logits)


@each_space
@pytest.mark.parametrize("changed", [in_place, another])
def test_changes_of_torchs_distribution_count(action_space, changed):
    outputs = 3 * th.randn(100, n_outputs(action_space))
    results = []
    for distribution in pair(action_space):
        distribution.proba_distribution(*([outputs, th.ones(1)] if isinstance(action_space, spaces.Box) else [outputs]))
        distribution.distribution = changed(distribution.distribution)
        th.manual_seed(0)
        actions = distribution.sample()
        results.append([actions, distribution.log_prob(actions), distribution.entropy(), distribution.mode()])
    assert all(map(th.equal, *results))


# --- Whole trainings -------------------------------------------------------------------------------------------------------


def assert_same_training(lean, stock):
    assert_equal(lean, stock)
    for name in ("actions", "values", "log_probs", "returns"):
        assert np.array_equal(getattr(lean.rollout_buffer, name), getattr(stock.rollout_buffer, name)), name
    logged = [
        {name: value for name, value in model.logger.name_to_value.items() if not name.startswith("time/")}
        for model in (lean, stock)
    ]
    assert logged[0] == logged[1]


TRAININGS = {
    "PPO": (PPO, "MlpPolicy", dict(batch_size=8, n_epochs=2)),
    "A2C": (A2C, "MlpPolicy", {}),
    "RecurrentPPO": (RecurrentPPO, "MlpLstmPolicy", dict(batch_size=8, n_epochs=2)),
}


@pytest.mark.parametrize(
    "name, action_space",
    # RecurrentPPO itself cannot train on MultiBinary actions
    [(name, space) for name in TRAININGS for space in SPACES if (name, type(space)) != ("RecurrentPPO", spaces.MultiBinary)],
    ids=str,
)
def test_same_training(name, action_space):
    algorithm, policy, settings = TRAININGS[name]
    settings = dict(n_steps=32, ent_coef=0.01, seed=0, device="cpu", **settings)
    stock = algorithm(policy, RandomEnv(action_space=action_space), **settings).learn(96, log_interval=10**6)
    lean = make_lean(algorithm(policy, RandomEnv(action_space=action_space), **settings))
    assert type(lean.policy.action_dist) is LEAN[type(action_space)]
    lean.learn(96, log_interval=10**6)
    assert_same_training(lean, stock)
    assert np.array_equal(*(model.predict(np.ones((1, 4), np.float32), deterministic=True)[0] for model in (lean, stock)))


@each_space
def test_same_training_with_churn_reduction(action_space):
    lean, plain = (
        CChainPPO("MlpPolicy", RandomEnv(action_space=action_space), lean=lean, **PPO_SETTINGS).learn(96, log_interval=10**6)
        for lean in (True, False)
    )
    assert type(lean.policy.action_dist) is LEAN[type(action_space)]
    assert type(plain.policy.action_dist) is type(make_proba_distribution(action_space))
    assert_same_training(lean, plain)


# --- Where nothing changes -------------------------------------------------------------------------------------------------


class AssigningPolicy(ActorCriticPolicy):
    def get_distribution(self, obs):
        distribution = super().get_distribution(obs)
        distribution.distribution = th.distributions.Categorical(logits=2 * distribution.distribution.logits)
        return distribution


class MaskingPolicy(ActorCriticPolicy):
    def _predict(self, observation, deterministic=False):
        distribution = self.get_distribution(observation)
        distribution.distribution.logits[:, 0] = -1e9
        return distribution.get_actions(deterministic)


class OwnDistributionPolicy(ActorCriticPolicy):
    def _get_action_dist_from_latent(self, latent_pi):
        return self.action_dist.proba_distribution(2 * self.action_net(latent_pi))


@pytest.mark.parametrize(
    "algorithm, policy, arguments",
    [
        (PPO, OwnDistributionPolicy, {}),
        (PPO, AssigningPolicy, {}),
        (PPO, MaskingPolicy, {}),
        (PPO, "MlpPolicy", dict(use_sde=True, env=RandomEnv(action_space=ACTION_SPACES[3]))),
        (MaskablePPO, "MlpPolicy", {}),
    ],
    ids=["own distribution", "assigned distribution", "own prediction", "gSDE", "maskable"],
)
def test_other_distributions_stay(algorithm, policy, arguments):
    model = algorithm(policy, **{"env": RandomEnv(), "device": "cpu", **arguments})
    distribution = model.policy.action_dist
    assert make_lean(model).policy.action_dist is distribution


def test_masks_of_a_policy_count_in_rollouts_and_predictions():
    model = CChainPPO("MlpPolicy", RandomEnv(), **PPO_SETTINGS)
    own = model.policy.get_distribution(th.zeros(1000, 4))
    own.distribution.logits[:, 0] = -1e9
    assert (own.get_actions() > 0).all()
    assert (CChainPPO(MaskingPolicy, RandomEnv(), **PPO_SETTINGS).predict(np.zeros((1000, 4), np.float32))[0] > 0).all()


# --- The model around them -------------------------------------------------------------------------------------------------


def test_save_load_and_copies(tmp_path):
    model = CChainPPO("MlpPolicy", RandomEnv(), **PPO_SETTINGS).learn(64)
    model.save(tmp_path / "model")
    loaded, stock = CChainPPO.load(tmp_path / "model"), PPO.load(tmp_path / "model")
    assert type(loaded.policy.action_dist) is type(copy.deepcopy(loaded).policy.action_dist) is LEAN[spaces.Discrete]
    assert type(stock.policy.action_dist) is not LEAN[spaces.Discrete]
    off = CChainPPO("MlpPolicy", RandomEnv(), lean=False, **PPO_SETTINGS)
    off.save(tmp_path / "off")
    assert CChainPPO.load(tmp_path / "off").lean is False


def test_compiled_policy():
    model = PPO("MlpPolicy", RandomEnv(), **PPO_SETTINGS)
    model.policy = th.compile(model.policy, backend="eager")
    assert type(make_lean(model).policy.action_dist) is LEAN[spaces.Discrete]
    model.learn(32)


@pytest.mark.parametrize("lean", [True, False])
def test_callback(lean):
    model = PPO("MlpPolicy", RandomEnv(), **PPO_SETTINGS).learn(32, CChainCallback(lean=lean))
    assert (type(model.policy.action_dist) is LEAN[spaces.Discrete]) == lean


@pytest.mark.parametrize("make", [CChainPPO, CChainCallback])
def test_bad_argument(make):
    arguments = () if make is CChainCallback else ("MlpPolicy", RandomEnv())
    with pytest.raises(TypeError, match="`lean` must be True or False, got 'yes'"):
        make(*arguments, lean="yes")
