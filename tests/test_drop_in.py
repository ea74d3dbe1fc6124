"""What Stable-Baselines3 allows besides the usual, and what these classes must allow, too."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.distributions import CategoricalDistribution, Distribution
from stable_baselines3.common.logger import HumanOutputFormat, Logger, TensorBoardOutputFormat
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

from sb3_cchain import CChainA2C, CChainDQN, CChainPPO, CChainSAC
from tests.envs import RandomEnv

BOX = spaces.Box(-1, 1, (2,), np.float32)
ON_POLICY = dict(n_steps=8, device="cpu", seed=0)
OFF_POLICY = dict(learning_starts=4, batch_size=4, buffer_size=50, device="cpu", seed=0)
ALGORITHMS = [
    (CChainPPO, dict(ON_POLICY, batch_size=4, n_epochs=1)),
    (CChainA2C, ON_POLICY),
    (CChainDQN, OFF_POLICY),
    (CChainSAC, OFF_POLICY),
]
IDS = [algorithm.__name__ for algorithm, _ in ALGORITHMS]
EACH = pytest.mark.parametrize("algorithm, kwargs", ALGORITHMS, ids=IDS)
EACH_ON_POLICY = pytest.mark.parametrize("algorithm, kwargs", ALGORITHMS[:2], ids=IDS[:2])


def environment(algorithm):
    return RandomEnv(action_space=BOX if algorithm is CChainSAC else spaces.Discrete(2))


class Count(BaseCallback):
    def _on_step(self):
        return True


class AddsAnother(Count):
    """Adds a callback to its list during training."""

    def __init__(self, group):
        super().__init__()
        self.group, self.another = group, Count()

    def _on_step(self):
        if self.n_calls == 5:
            self.another.init_callback(self.model)
            self.group.callbacks.append(self.another)
        return True


@EACH
def test_a_list_of_callbacks_stays_as_it_is(algorithm, kwargs):
    group = CallbackList([])
    adds = AddsAnother(group)
    group.callbacks.append(adds)
    model = algorithm("MlpPolicy", environment(algorithm), **kwargs).learn(16, callback=group)
    assert group.model is model and group.n_calls == 16 and "new_obs" in group.locals
    assert adds.another.n_calls == 12


class Closed(DummyVecEnv):
    """Gives one attribute, for which Stable-Baselines3 asks."""

    given = None

    def get_attr(self, attr_name, indices=None):
        if attr_name == "render_mode":
            return [None] * self.num_envs
        if isinstance(self.given, Exception):
            raise self.given
        return self.given


@EACH
@pytest.mark.parametrize("given", [NotImplementedError(), RuntimeError("closed"), [], None], ids=repr)
def test_vectorised_environments_without_attributes(algorithm, kwargs, given):
    env = Closed([lambda: environment(algorithm)])
    env.given = given
    assert algorithm("MlpPolicy", env, **kwargs).learn(16).num_timesteps == 16


class NaNReward(RandomEnv):
    def step(self, action):
        observation, _, terminated, truncated, info = super().step(action)
        return observation, float("nan"), terminated, truncated, info


def test_what_is_wrong_is_said_without_attributes():
    env = Closed([NaNReward])
    env.given = NotImplementedError()
    with pytest.raises(ValueError, match="Environment 0 gave a NaN or infinite reward at step 1 of training"):
        CChainPPO("MlpPolicy", env, **ALGORITHMS[0][1]).learn(16)


class LazyExtractor(BaseFeaturesExtractor):
    """Has parameters without a shape before its first forward pass, and some that are infinite on purpose."""

    def __init__(self, observation_space):
        super().__init__(observation_space, features_dim=3)
        self.layer = nn.LazyLinear(3)
        self.mask = nn.Parameter(th.tensor([0.0, 0.0, -th.inf]), requires_grad=False)

    def forward(self, observations):
        return (self.layer(observations) + self.mask).softmax(dim=1)


@EACH_ON_POLICY
def test_lazy_and_infinite_parameters(algorithm, kwargs):
    policy_kwargs = dict(features_extractor_class=LazyExtractor, ortho_init=False)
    model = algorithm("MlpPolicy", environment(algorithm), policy_kwargs=policy_kwargs, **kwargs)
    assert model.learn(16).num_timesteps == 16


class LinearPolicy(BasePolicy):
    """Has what PPO and A2C call, and none of the networks of Stable-Baselines3's policies."""

    def _build(self, lr_schedule):
        (n_observations,) = self.observation_space.shape
        self.actor, self.critic = nn.Linear(n_observations, int(self.action_space.n)), nn.Linear(n_observations, 1)
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1))

    def forward(self, obs, deterministic=False):
        categorical = self._categorical(obs)
        actions = categorical.sample()
        return actions, self.critic(obs), categorical.log_prob(actions)

    def evaluate_actions(self, obs, actions):
        categorical = self._categorical(obs)
        return self.critic(obs), categorical.log_prob(actions), categorical.entropy()

    def predict_values(self, obs):
        return self.critic(obs)

    def _predict(self, observation, deterministic=False):
        return self.forward(observation)[0]


class WholePolicy(LinearPolicy, ActorCriticPolicy):
    """Does not say what its distribution is."""

    def _categorical(self, obs):
        return th.distributions.Categorical(logits=self.actor(obs))


class LaplaceDistribution(Distribution):
    """Of a kind of which churn reduction knows no divergence."""

    def proba_distribution_net(self, latent_dim):
        return nn.Linear(latent_dim, 2)

    def proba_distribution(self, outputs):
        self.distribution = th.distributions.Laplace(outputs, 1.0)
        return self

    def log_prob(self, actions):
        return self.distribution.log_prob(actions).sum(dim=1)

    def entropy(self):
        return self.distribution.entropy().sum(dim=1)

    def sample(self):
        return self.distribution.sample()

    def mode(self):
        return self.distribution.mean

    def actions_from_params(self, outputs, deterministic=False):
        return self.proba_distribution(outputs).get_actions(deterministic)

    def log_prob_from_params(self, outputs):
        actions = self.actions_from_params(outputs)
        return actions, self.log_prob(actions)


class LaplacePolicy(ActorCriticPolicy):
    def _build(self, lr_schedule):
        super()._build(lr_schedule)
        self.action_dist = LaplaceDistribution()

    def _get_action_dist_from_latent(self, latent_pi):
        return self.action_dist.proba_distribution(self.action_net(latent_pi))


@EACH_ON_POLICY
@pytest.mark.parametrize("policy, action_space", [(WholePolicy, spaces.Discrete(2)), (LaplacePolicy, BOX)])
def test_policies_of_another_kind_are_those_of_the_base_without_churn_reduction(algorithm, kwargs, policy, action_space):
    base = next(each for each in algorithm.__mro__ if each.__module__.startswith("stable_baselines3"))
    mine = algorithm(policy, RandomEnv(action_space=action_space), churn_coef=0.0, **kwargs).learn(16)
    stock = base(policy, RandomEnv(action_space=action_space), **kwargs).learn(16)
    assert all(th.equal(a, b) for a, b in zip(mine.policy.parameters(), stock.policy.parameters(), strict=True))


@EACH_ON_POLICY
def test_policies_of_another_kind_hold_their_values_still(algorithm, kwargs):
    model = algorithm(WholePolicy, RandomEnv(), churn_target="value", **kwargs).learn(24)
    assert model.logger.name_to_value["churn/value_churn"] > 0


class OwnPolicy(LinearPolicy):
    """Of SB3's, it has the base class of all policies alone, and a distribution."""

    def __init__(self, observation_space, action_space, lr_schedule, use_sde=False, **kwargs):
        super().__init__(observation_space, action_space, **kwargs)
        self.action_dist = CategoricalDistribution(int(action_space.n))
        self._build(lr_schedule)

    def get_distribution(self, obs):
        return self.action_dist.proba_distribution(self.actor(obs))

    _categorical = get_distribution


@EACH_ON_POLICY
def test_policies_without_a_class_of_sb3s_are_held_still(algorithm, kwargs):
    model = algorithm(OwnPolicy, RandomEnv(), **kwargs).learn(24)
    assert model.logger.name_to_value["churn/loss"] > 0


@EACH_ON_POLICY
def test_policies_whose_distribution_is_not_known_are_refused_at_once(algorithm, kwargs):
    with pytest.raises(TypeError, match=r"distribution of WholePolicy, .* define `get_distribution\(observations\)`"):
        algorithm(WholePolicy, RandomEnv(), **kwargs)
    with pytest.raises(TypeError, match="does not know the outputs of LaplaceDistribution"):
        algorithm(LaplacePolicy, RandomEnv(action_space=BOX), **kwargs)


@EACH
@pytest.mark.parametrize("kind", [list, tuple])
def test_the_outputs_of_a_logger_stay_the_users(algorithm, kwargs, kind, tmp_path):
    outputs = kind([TensorBoardOutputFormat(str(tmp_path)), HumanOutputFormat(str(tmp_path / "log.txt"))])
    model = algorithm("MlpPolicy", environment(algorithm), **kwargs)
    model.set_logger(Logger(None, outputs))
    model.learn(16)
    assert len(outputs) == 2 and len(model.logger.output_formats) == 4
    model.logger.close()
