"""CChainDQN runs wherever DQN does, and says what it does."""

import copy
import weakref
from functools import partial

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TransformReward
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize
from torch import nn

from sb3_cchain import CChainDQN, ContinualEnv, DoubleDQN
from sb3_cchain.algorithms import dqn_cchain
from sb3_cchain.networks.extractors import MinAtarCNN
from tests.envs import CountEnv, RandomEnv

SETTINGS = dict(learning_starts=20, buffer_size=200, batch_size=8, train_freq=1, learning_rate=1e-3, seed=0, device="cpu")
CHURN_KEYS = {"churn/loss", "churn/coef", "churn/relative_loss", "churn/value_churn", "churn/greedy_action_changes"}

BOX = spaces.Box(-1, 1, (4,), np.float32)
IMAGE = spaces.Box(0, 255, (36, 36, 3), np.uint8)
CELLS = spaces.Box(0, 1, (10, 10, 4), np.bool_)


def learn(env=None, policy="MlpPolicy", n_timesteps=50, **kwargs):
    # Without logs in between, so that the last updates' are there to look at
    return CChainDQN(policy, env or RandomEnv(), **{**SETTINGS, **kwargs}).learn(n_timesteps, log_interval=10**6)


def assert_churn_was_reduced(model):
    logged = model.logger.name_to_value
    assert CHURN_KEYS <= set(logged)
    assert all(np.isfinite(logged[key]) for key in CHURN_KEYS)
    assert logged["churn/value_churn"] > 0


@pytest.mark.parametrize(
    "policy, observation_space",
    [
        ("MlpPolicy", BOX),
        ("MlpPolicy", spaces.Discrete(5)),
        ("MlpPolicy", spaces.MultiBinary(4)),
        ("CnnPolicy", IMAGE),
        ("MultiInputPolicy", spaces.Dict({"vector": BOX, "image": IMAGE})),
    ],
    ids=["Box", "Discrete", "MultiBinary", "image", "Dict"],
)
def test_spaces(policy, observation_space):
    assert_churn_was_reduced(learn(RandomEnv(observation_space), policy))


@pytest.mark.parametrize("vec_env_cls", [None, SubprocVecEnv])
def test_vectorised_and_normalised(vec_env_cls):
    env = VecNormalize(make_vec_env(RandomEnv, n_envs=2, vec_env_cls=vec_env_cls))
    references = []
    model = CChainDQN("MlpPolicy", env, **SETTINGS)
    remember = model.churn_reducer.remember
    model.churn_reducer.remember = lambda reference, outputs: (references.append(reference), remember(reference, outputs))
    model.learn(100, log_interval=10**6)
    assert_churn_was_reduced(model)
    # Reference batches are normalised as minibatches are: the buffer holds the environment's own observations, in [-1, 1]
    assert th.cat(references).abs().max() > 1 >= np.abs(model.replay_buffer.observations).max()
    env.close()


@pytest.mark.parametrize(
    "arguments, n_updates",
    [
        (dict(gradient_steps=3), 90),
        (dict(train_freq=5, gradient_steps=-1), 30),
        (dict(train_freq=(1, "episode"), gradient_steps=2), 6),
        (dict(n_steps=3), 30),
        (dict(optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False)), 30),
        (dict(learning_rate=lambda progress: 1e-3 * (1 + progress), tau=0.5, max_grad_norm=float("inf")), 30),
    ],
    ids=["gradient steps", "as many as steps", "episodes", "n-step", "memory", "schedule"],
)
def test_other_arguments_of_dqn(arguments, n_updates):
    model = learn(**arguments)
    assert model._n_updates == n_updates
    assert_churn_was_reduced(model)
    assert isinstance(model.replay_buffer, NStepReplayBuffer) == ("n_steps" in arguments)


@pytest.mark.parametrize("cls", [DoubleDQN, CChainDQN])
def test_frozen_layers_stay_as_they_are(cls):
    model = cls("MlpPolicy", RandomEnv(), **SETTINGS)
    frozen, trained = model.q_net.q_net[0], model.q_net.q_net[-1]
    frozen.requires_grad_(False)
    before = [layer.weight.clone() for layer in (frozen, trained)]
    model.learn(50, log_interval=10**6)
    assert th.equal(frozen.weight, before[0]) and not th.equal(trained.weight, before[1])
    if cls is CChainDQN:
        assert_churn_was_reduced(model)


def test_hindsight_experience_replay():
    model = learn(BitFlippingEnv(n_bits=4), "MultiInputPolicy", replay_buffer_class=HerReplayBuffer)
    assert_churn_was_reduced(model)


class NormalisedExtractor(BaseFeaturesExtractor):
    """BatchNorm and dropout."""

    def __init__(self, observation_space):
        super().__init__(observation_space, 8)
        self.net = nn.Sequential(nn.Linear(4, 8), nn.BatchNorm1d(8), nn.Dropout(0.5))

    def forward(self, observations):
        return self.net(observations)


@pytest.mark.parametrize("cls", [DoubleDQN, CChainDQN])
def test_batch_norm_and_dropout_act_as_in_the_environment(cls):
    """Only the observations of a minibatch move the running statistics: not its next observations, nor reference batches."""
    settings = {**SETTINGS, "policy_kwargs": dict(features_extractor_class=NormalisedExtractor)}
    model = cls("MlpPolicy", RandomEnv(), **settings).learn(50, log_interval=10**6)
    batches = []
    norm = model.q_net.features_extractor.net[1]
    norm.register_forward_pre_hook(lambda module, inputs: batches.append((module.training, inputs[0])))
    n_batches = int(norm.num_batches_tracked)
    model.replay_buffer.next_observations[:] = 0.5
    model.train(gradient_steps=1, batch_size=8)
    assert model.q_net.training and norm.num_batches_tracked == n_batches + 1
    ((_, trained_on),) = [batch for batch in batches if batch[0]]
    assert th.unique(trained_on, dim=0).shape[0] > 1  # next observations are all the same
    if cls is CChainDQN:
        assert_churn_was_reduced(model)
        # Next observations, and the reference batch twice (before this update, and of the one before)
        assert len(batches) == 4


def other_settings(name):
    return {
        "Box": dict(env=RandomEnv(), policy="MlpPolicy"),
        "Dict": dict(env=RandomEnv(spaces.Dict({"a": BOX, "b": spaces.Discrete(3)})), policy="MultiInputPolicy"),
        "VecNormalize": dict(env=VecNormalize(make_vec_env(RandomEnv, n_envs=2, seed=0)), policy="MlpPolicy", n_steps=3),
        "HER": dict(env=BitFlippingEnv(n_bits=4), policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer),
    }[name]


@pytest.mark.parametrize("double_q", [False, True])
@pytest.mark.parametrize("name", ["Box", "Dict", "VecNormalize", "HER"])
def test_reference_batches_with_the_minibatch_or_on_their_own(name, double_q, monkeypatch):
    models = []
    for own_pass in (False, True):
        monkeypatch.setattr(dqn_cchain, "has_training_mode", lambda policy, own_pass=own_pass: own_pass)
        models.append(learn(n_timesteps=80, double_q=double_q, churn_coef=10.0, gradient_steps=2, **other_settings(name)))
    for p, q in zip(*(model.policy.parameters() for model in models), strict=True):
        assert th.allclose(p, q, rtol=0, atol=1e-5)
    together, alone = (model.logger.name_to_value for model in models)
    assert all(together[key] == pytest.approx(alone[key], rel=1e-2) for key in CHURN_KEYS)


class GenerousBuffer(ReplayBuffer):
    """Twice as many samples as it is asked for."""

    def sample(self, batch_size, env=None):
        return super().sample(2 * batch_size, env)


@pytest.mark.parametrize("double_q", [False, True])
def test_a_custom_replay_buffer(double_q):
    model = learn(replay_buffer_class=GenerousBuffer, double_q=double_q)
    assert_churn_was_reduced(model)
    assert len(model.churn_reducer.reference) == 16


def test_an_interrupted_update_leaves_nothing_behind():
    model = learn()
    step = model.policy.optimizer.step

    def interrupt():
        raise KeyboardInterrupt

    model.policy.optimizer.step = interrupt
    with pytest.raises(KeyboardInterrupt):
        model.train(gradient_steps=1, batch_size=8)
    model.policy.optimizer.step = step
    assert model.churn_reducer.losses == []
    n_seen = int(model.churn_reducer.coefficient.n_seen)
    model.train(gradient_steps=3, batch_size=8)
    assert model.churn_reducer.coefficient.n_seen == n_seen + 3
    assert model.churn_reducer.losses == []


def test_positional_arguments_are_those_of_dqn():
    model = CChainDQN("MlpPolicy", RandomEnv(), 1e-3, 100, 7, 16, device="cpu")
    assert (model.learning_rate, model.buffer_size, model.learning_starts, model.batch_size) == (1e-3, 100, 7, 16)
    assert model.double_q and model.loss == "huber"
    coefficient = model.churn_reducer.coefficient
    assert (coefficient.target_ratio, coefficient.initial, coefficient.warmup) == (0.01, 1, 0)
    assert len(coefficient.base_losses) == 1000


@pytest.mark.parametrize("double_q", [False, True])
def test_what_is_logged(double_q):
    """Two updates in a call, so that the second has churn: computed from the networks before and after the first."""
    settings = {**SETTINGS, "learning_rate": 0.1}
    model = CChainDQN("MlpPolicy", RandomEnv(), churn_coef=2.0, double_q=double_q, **settings).learn(20)
    reducer, seen = model.churn_reducer, []

    def remember(reference, outputs, remember=reducer.remember):
        seen.append((reference, copy.deepcopy(model.policy.q_net)))
        remember(reference, outputs)

    td_losses = []
    reducer.remember, reducer.end_iteration = remember, td_losses.append
    model.logger.name_to_value.clear()
    model.train(gradient_steps=2, batch_size=8)
    (reference, before), (_, after) = seen
    (td_loss,) = td_losses
    with th.no_grad():
        old, new = before(reference), after(reference)
    logged = model.logger.name_to_value
    assert logged["churn/loss"] == pytest.approx(((old - new) ** 2).mean().item())
    assert logged["churn/coef"] == 2.0
    assert logged["churn/relative_loss"] == pytest.approx(2 * logged["churn/loss"] / td_loss, rel=1e-4)
    assert logged["churn/value_churn"] == pytest.approx((old - new).abs().mean().item())
    changes = [int(a.argmax() != b.argmax()) for a, b in zip(old, new, strict=True)]
    assert 0 < sum(changes) < 8
    assert logged["churn/greedy_action_changes"] == pytest.approx(np.mean(changes))


@pytest.mark.parametrize("gradient_steps, n_updates", [(1, 2), (3, 8)])  # with a churn loss, in three calls of train()
def test_logs_are_means_over_the_updates_between_two_logs(gradient_steps, n_updates):
    settings = dict(churn_warmup=1, churn_window=100, target_churn_ratio=0.5, gradient_steps=gradient_steps)
    model = learn(n_timesteps=23, **settings)
    coefficient = model.churn_reducer.coefficient
    assert coefficient.n_seen == n_updates
    assert model.logger.name_to_value["churn/loss"] == pytest.approx(coefficient.churn_losses[:n_updates].mean().item())


@pytest.mark.parametrize("double_q", [False, True])
def test_updates_of_one_call_are_those_of_several_calls(double_q):
    """λ, its warm-up and its window are counted in gradient updates."""
    models = []
    for calls in ([6], [1] * 6, [2, 4]):
        settings = dict(double_q=double_q, churn_coef="auto_20", churn_warmup=3, churn_window=4)
        models.append(CChainDQN("MlpPolicy", RandomEnv(), **SETTINGS, **settings).learn(20))
        np.random.seed(0)
        for gradient_steps in calls:
            models[-1].train(gradient_steps, batch_size=8)
        assert models[-1].churn_reducer.coefficient.n_seen == 5
    first, *others = models
    assert first.churn_reducer.coefficient.value != 20
    for other in others:
        assert all(th.equal(p, q) for p, q in zip(first.policy.parameters(), other.policy.parameters(), strict=True))
        assert first.churn_reducer.coefficient.value == other.churn_reducer.coefficient.value


def test_no_update_is_held_until_the_call_ends():
    model = learn()
    outputs = []

    def remember(reference, old_outputs, remember=model.churn_reducer.remember):
        outputs.append(weakref.ref(old_outputs))
        remember(reference, old_outputs)

    alive = []
    model.churn_reducer.remember = remember
    step = model.policy.optimizer.step

    def count_and_step():
        alive.append(sum(output() is not None for output in outputs))
        step()

    model.policy.optimizer.step = count_and_step
    model.train(gradient_steps=10, batch_size=8)
    assert max(alive) <= 2


def test_adaptive_coefficient_holds_the_ratio():
    model = learn(churn_warmup=1, churn_window=1, target_churn_ratio=0.3)
    coefficient = model.churn_reducer.coefficient
    expected = 0.3 * coefficient.base_losses.item() / (coefficient.churn_losses.item() + 1e-8)
    assert coefficient.value == pytest.approx(expected)
    assert coefficient.base_losses.item() == pytest.approx(model.logger.name_to_value["train/loss"])


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_defaults_hold_the_ratio_at_any_scale_of_the_rewards(scale):
    """From the first updates on."""
    env = TransformReward(RandomEnv(), lambda reward: scale * reward)
    model = learn(env, n_timesteps=60, loss="mse")
    coefficient = model.churn_reducer.coefficient
    base, churn = coefficient.base_losses.sum().item(), coefficient.churn_losses.sum().item()
    assert coefficient.n_seen == 39  # 40 updates, of which the first has no churn loss
    assert coefficient.value == pytest.approx(0.01 * base / (churn + 39e-8))


def test_tensorboard_names(tmp_path):
    for cls in (CChainDQN, DoubleDQN):
        cls("MlpPolicy", RandomEnv(), tensorboard_log=str(tmp_path), **SETTINGS).learn(25)
    assert {folder.name for folder in tmp_path.iterdir()} == {"CChainDQN_1", "DoubleDQN_1"}


def test_another_policy_put_in_place():
    model, other = learn(), learn(seed=1)
    model.policy = other.policy
    model._create_aliases()
    model.learn(50, log_interval=10**6)
    assert_churn_was_reduced(model)


def state_of(model):
    """Parameters, and C-CHAIN's numbers."""
    coefficient = model.churn_reducer.coefficient.state_dict() if isinstance(model, CChainDQN) else {}
    return [tensor.clone() for tensor in (*model.policy.state_dict().values(), *coefficient.values())]


@pytest.mark.parametrize(
    "make",
    [DoubleDQN, partial(CChainDQN, churn_warmup=3), partial(CChainDQN, churn_coef=0.0)],
    ids=["DoubleDQN", "CChainDQN", "CChainDQN with coefficient 0"],
)
@pytest.mark.parametrize("loss", ["huber", "mse"])
@pytest.mark.parametrize(
    "where, value, message",
    [
        ("rewards", np.inf, "the rewards of the minibatch hold inf"),
        ("rewards", -np.inf, "the rewards of the minibatch hold -inf"),
        ("rewards", np.nan, "the rewards of the minibatch hold nan"),
        ("rewards", 3e38, "the network.*finite .the largest reward is 3e.38"),
        ("observations", np.nan, "the observations of the minibatch hold nan"),
        ("next_observations", np.nan, "the next observations of the minibatch hold nan"),
    ],
)
def test_what_is_not_finite_is_named_before_an_update(make, loss, where, value, message):
    """After the warm-up, in which λ would become infinite, too."""
    model = make("MlpPolicy", RandomEnv(), loss=loss, **SETTINGS).learn(40)
    getattr(model.replay_buffer, where)[:40] = value
    before = state_of(model)
    with pytest.raises(ValueError, match=rf"The TD loss is \S+: {message}.*have not been updated"):
        model.train(gradient_steps=2, batch_size=8)
    assert all(th.equal(*pair) for pair in zip(before, state_of(model), strict=True))


def test_huge_rewards_are_no_error():
    model = CChainDQN("MlpPolicy", RandomEnv(), churn_coef=1.0, **SETTINGS).learn(40)
    model.replay_buffer.rewards[:40] *= 1e30
    model.train(gradient_steps=1, batch_size=8)
    assert all(tensor.isfinite().all() for tensor in state_of(model))


def test_an_infinite_churn_loss_is_named_before_an_update():
    model = learn()
    model.churn_reducer.old_outputs.fill_(float("nan"))
    before = state_of(model)
    with pytest.raises(ValueError, match="The churn loss is nan"):
        model.train(gradient_steps=1, batch_size=8)
    assert all(th.equal(*pair) for pair in zip(before, state_of(model), strict=True))


def test_continual_environment_brings_its_callbacks():
    env = ContinualEnv([CountEnv, CountEnv], 60)
    model = learn(env, n_timesteps=120, reset_churn_coef=True)
    assert [row["task_id"] for row in model.continual_returns] == [0] * 9 + [1] * 8
    assert [row["mean_return"] for row in model.continual_returns] == [7.0] * 8 + [4.0] + [7.0] * 8
    # λ started over at the switch: the updates of the second task
    assert model.churn_reducer.coefficient.n_seen == 60


# --- Bad input ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cls", [DoubleDQN, CChainDQN])
@pytest.mark.parametrize(
    "action_space", [spaces.Box(-1, 1, (2,), np.float32), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(2)], ids=str
)
def test_other_actions_are_refused(cls, action_space):
    """With the kind of error that SB3 raises."""
    message = f"{cls.__name__} needs an environment with Discrete actions, got {type(action_space).__name__}"
    with pytest.raises(AssertionError, match=message):
        cls("MlpPolicy", RandomEnv(action_space=action_space))
    with pytest.raises(AssertionError, match="Discrete actions, got Box"):
        cls("MlpPolicy", "Pendulum-v1")


@pytest.mark.parametrize("cls", [DoubleDQN, CChainDQN])
@pytest.mark.parametrize(
    "arguments, error, message",
    [
        ({"loss": "mae"}, ValueError, """`loss` must be "huber" or "mse", got 'mae'"""),
        ({"loss": ["mse"]}, ValueError, r"""`loss` must be "huber" or "mse", got \['mse'\]"""),
        ({"loss": None}, ValueError, """`loss` must be "huber" or "mse", got None"""),
        ({"double_q": "yes"}, TypeError, "`double_q` must be True or False, got 'yes'"),
    ],
)
def test_bad_arguments(cls, arguments, error, message):
    with pytest.raises(error, match=message):
        cls("MlpPolicy", "no environment is made", **arguments)


@pytest.mark.parametrize(
    "arguments, name",
    [
        ({"churn_coef": -0.5}, "churn_coef"),
        ({"target_churn_ratio": "big"}, "target_churn_ratio"),
        ({"churn_window": 0}, "churn_window"),
    ],
)
def test_bad_churn_arguments(arguments, name):
    with pytest.raises(ValueError, match=f"`{name}`.*got {next(iter(arguments.values()))!r}"):
        CChainDQN("MlpPolicy", "no environment is made", **arguments)


def test_n_step_returns_of_dict_observations_are_refused():
    env = RandomEnv(spaces.Dict({"a": BOX}))
    with pytest.raises(ValueError, match="`n_steps=1`, got 3"):
        DoubleDQN("MultiInputPolicy", env, n_steps=3)


# --- The feature extractor ------------------------------------------------------------------------------------------------


def test_observations_stay_small_in_the_replay_buffer():
    env = RandomEnv(spaces.Box(0, 1, (10, 10, 10), np.bool_))
    buffer = learn(env, policy_kwargs=dict(features_extractor_class=MinAtarCNN, net_arch=[])).replay_buffer
    assert buffer.observations.dtype == buffer.next_observations.dtype == np.bool_
    arrays = [array for array in vars(buffer).values() if isinstance(array, np.ndarray)]
    bytes_per_transition = sum(array.nbytes for array in arrays) / buffer.buffer_size
    assert 2000 <= bytes_per_transition and 500_000 * bytes_per_transition <= 1.2e9


@pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")
def test_cuda():
    assert_churn_was_reduced(learn(device="cuda"))
