"""DoubleDQN and CChainDQN: what is special about them."""

import copy
import weakref
from functools import partial

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TransformReward
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.vec_env import VecNormalize

from sb3_cchain import CChainDQN, ContinualEnv, DoubleDQN
from sb3_cchain.algorithms import dqn_cchain
from sb3_cchain.algorithms.reference_batches import REFERENCES
from sb3_cchain.networks.extractors import MinAtarCNN
from tests.churn_models import (
    DICT,
    FORMS,
    GenerousBuffer,
    NormalisedExtractor,
    assert_churn_was_reduced,
    churn_keys,
    state_of,
)
from tests.envs import CountEnv, RandomEnv

SETTINGS = FORMS["CChainDQN"].settings
learn = FORMS["CChainDQN"].learn
each_reference = pytest.mark.parametrize("churn_reference", REFERENCES)


def test_defaults():
    model = CChainDQN("MlpPolicy", RandomEnv(), device="cpu")
    assert model.double_q and model.loss == "huber"


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
@each_reference
def test_other_arguments_of_dqn(arguments, n_updates, churn_reference):
    model = learn(churn_reference=churn_reference, **arguments)
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


@each_reference
def test_hindsight_experience_replay(churn_reference):
    env = BitFlippingEnv(n_bits=4)
    model = learn(env, "MultiInputPolicy", replay_buffer_class=HerReplayBuffer, churn_reference=churn_reference)
    assert_churn_was_reduced(model)


@pytest.mark.parametrize(
    "cls", [DoubleDQN, CChainDQN, partial(CChainDQN, churn_reference="next")], ids=["DoubleDQN", *REFERENCES]
)
def test_batch_norm_and_dropout_act_as_in_the_environment(cls):
    """Only the observations of a minibatch move the running statistics: not its next observations, nor reference batches."""
    settings = {**SETTINGS, "policy_kwargs": dict(features_extractor_class=NormalisedExtractor)}
    model = cls("MlpPolicy", RandomEnv(), **settings).learn(50, log_interval=10**6)
    batches = []
    norm = model.q_net.features_extractor.net[1]
    model.replay_buffer.next_observations[:] = 0.5
    model.train(gradient_steps=1, batch_size=8)  # with "next", on a minibatch that was drawn before
    norm.register_forward_pre_hook(lambda module, inputs: batches.append((module.training, inputs[0])))
    n_batches = int(norm.num_batches_tracked)
    model.train(gradient_steps=1, batch_size=8)
    assert model.q_net.training and norm.num_batches_tracked == n_batches + 1
    ((_, trained_on),) = [batch for batch in batches if batch[0]]
    assert th.unique(trained_on, dim=0).shape[0] > 1  # next observations are all the same
    if isinstance(model, CChainDQN):
        assert_churn_was_reduced(model)
        # Next observations, and the reference batch twice (before this update, and of the one before)
        assert len(batches) == 4


def other_settings(name):
    return {
        "Box": dict(env=RandomEnv(), policy="MlpPolicy"),
        "Dict": dict(env=RandomEnv(DICT), policy="MultiInputPolicy"),
        "VecNormalize": dict(env=VecNormalize(make_vec_env(RandomEnv, n_envs=2, seed=0)), policy="MlpPolicy", n_steps=3),
        "HER": dict(env=BitFlippingEnv(n_bits=4), policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer),
    }[name]


@pytest.mark.parametrize(
    "name, double_q, churn_reference",
    [  # all pairs of two
        (name, double_q, REFERENCES[double_q ^ number % 2])
        for number, name in enumerate(["Box", "Dict", "VecNormalize", "HER"])
        for double_q in (False, True)
    ],
)
def test_reference_batches_with_the_minibatch_or_on_their_own(name, double_q, churn_reference, monkeypatch):
    models = []
    settings = dict(double_q=double_q, churn_coef=10.0, gradient_steps=2, churn_reference=churn_reference)
    for own_pass in (False, True):
        monkeypatch.setattr(dqn_cchain, "has_training_mode", lambda policy, own_pass=own_pass: own_pass)
        models.append(learn(n_timesteps=50, **settings, **other_settings(name)))
    for p, q in zip(*(model.policy.parameters() for model in models), strict=True):
        assert th.allclose(p, q, rtol=0, atol=1e-5)
    together, alone = (model.logger.name_to_value for model in models)
    assert all(together[key] == pytest.approx(alone[key], rel=1e-2) for key in churn_keys(models[0]))


@pytest.mark.parametrize("double_q", [False, True])
@each_reference
def test_hooks_see_the_batches_of_dqn(double_q, churn_reference):
    """The minibatch alone in training mode, as without churn reduction, and no batch that is joined with another."""

    def sizes(algorithm, instrument, **arguments):
        seen = []
        model = algorithm("MlpPolicy", RandomEnv(), **SETTINGS, double_q=double_q, **arguments)
        instrument(model.q_net, lambda *inputs: seen.append((len(inputs[-1]), model.q_net.training)))
        model.learn(30)
        return seen

    def hook(q_net, look):
        q_net.q_net[0].register_forward_hook(lambda layer, inputs, output: look(*inputs))

    of_dqn = [size for size, training in sizes(DoubleDQN, hook) if training]
    seen = sizes(CChainDQN, hook, churn_reference=churn_reference)
    assert of_dqn and [size for size, training in seen if training] == of_dqn


@pytest.mark.parametrize("double_q", [False, True])
@each_reference
def test_a_custom_replay_buffer(double_q, churn_reference):
    model = learn(replay_buffer_class=GenerousBuffer, double_q=double_q, churn_reference=churn_reference)
    assert_churn_was_reduced(model)
    assert len(model.churn_reducer.reference) == 16


def test_the_reference_batch_is_the_minibatch_of_the_next_update():
    """Also across calls of train(), and after an update that failed."""
    model = learn(churn_reference="next")
    trained_on, measured_on = [], []
    loss, remember = model._td_loss, model.churn_reducer.remember

    def td_loss(replay_data, *args):
        trained_on.append(replay_data.observations)
        return loss(replay_data, *args)

    def remember_reference(reference, outputs):
        measured_on.append(reference)
        remember(reference, outputs)

    model._td_loss, model.churn_reducer.remember = td_loss, remember_reference
    for gradient_steps in (1, 3, 2):
        model.train(gradient_steps, batch_size=8)
    assert len(trained_on) == len(measured_on) == 6
    assert all(reference is minibatch for reference, minibatch in zip(measured_on[:-1], trained_on[1:], strict=True))

    minibatch, rewards = model._next_minibatch, model._next_minibatch.rewards.clone()
    minibatch.rewards[:] = np.nan
    with pytest.raises(ValueError, match="rewards of the minibatch hold nan"):
        model.train(1, batch_size=8)
    minibatch.rewards[:] = rewards
    model.train(1, batch_size=8)
    assert trained_on[-2] is trained_on[-1] is measured_on[5] and len(measured_on) == 7


def test_the_first_minibatch_is_that_of_double_dqn():
    seen = []
    for cls in (DoubleDQN, partial(CChainDQN, churn_reference="next")):
        model = cls("MlpPolicy", RandomEnv(), **SETTINGS).learn(20)
        loss = model._td_loss
        model._td_loss = lambda replay_data, *args, loss=loss: seen.append(replay_data) or loss(replay_data, *args)
        model.train(1, batch_size=8)
    assert all(th.equal(*pair) for pair in zip(*(each[:5] for each in seen), strict=True))


@each_reference
def test_an_interrupted_update_leaves_nothing_behind(churn_reference):
    model = learn(churn_reference=churn_reference)
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


@pytest.mark.parametrize("double_q", [False, True])
@each_reference
def test_what_is_logged(double_q, churn_reference):
    """Two updates in a call, so that the second has churn: computed from the networks before and after the first."""
    settings = {**SETTINGS, "learning_rate": 0.1, "double_q": double_q, "churn_reference": churn_reference}
    model = CChainDQN("MlpPolicy", RandomEnv(), churn_coef=2.0, **settings).learn(20)
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
@each_reference
def test_updates_of_one_call_are_those_of_several_calls(double_q, churn_reference):
    """λ, its warm-up and its window are counted in gradient updates."""
    models = []
    churn = dict(churn_coef="auto_20", churn_warmup=3, churn_window=4, churn_reference=churn_reference)
    for calls in ([6], [1] * 6, [2, 4]):
        settings = dict(double_q=double_q, **churn)
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


@each_reference
def test_no_update_is_held_until_the_call_ends(churn_reference):
    model = learn(churn_reference=churn_reference)
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


def test_continual_environment_brings_its_callbacks():
    env = ContinualEnv([CountEnv, CountEnv], 60)
    model = learn(env, n_timesteps=120, reset_churn_coef=True)
    assert [row["task_id"] for row in model.continual_returns] == [0] * 9 + [1] * 8
    assert [row["mean_return"] for row in model.continual_returns] == [7.0] * 8 + [4.0] + [7.0] * 8
    # λ started over at the switch: the updates of the second task
    assert model.churn_reducer.coefficient.n_seen == 60


@pytest.mark.parametrize("cls", [DoubleDQN, CChainDQN])
@pytest.mark.parametrize(
    "action_space", [spaces.Box(-1, 1, (2,), np.float32), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(2)], ids=str
)
def test_other_actions_are_refused(cls, action_space):
    """With the kind of error that SB3 raises."""
    with pytest.raises(AssertionError, match=f"only supports .*Discrete.* as action spaces but {type(action_space).__name__}"):
        cls("MlpPolicy", RandomEnv(action_space=action_space))


@pytest.mark.parametrize("cls", [DoubleDQN, CChainDQN])
@pytest.mark.parametrize(
    "arguments, error, message",
    [
        ({"loss": "mae"}, ValueError, """`loss` must be one of 'huber', 'mse', got 'mae'"""),
        ({"loss": ["mse"]}, ValueError, r"""`loss` must be one of 'huber', 'mse', got \['mse'\]"""),
        ({"loss": None}, ValueError, """`loss` must be one of 'huber', 'mse', got None"""),
        ({"double_q": "yes"}, TypeError, "`double_q` must be True or False, got 'yes'"),
    ],
)
def test_bad_arguments(cls, arguments, error, message):
    with pytest.raises(error, match=message):
        cls("MlpPolicy", "no environment is made", **arguments)


def test_n_step_returns_of_dict_observations_are_refused():
    with pytest.raises(AssertionError, match="N-step returns are not supported for Dict observation spaces"):
        DoubleDQN("MultiInputPolicy", RandomEnv(DICT), n_steps=3)


def test_observations_stay_small_in_the_replay_buffer():
    env = RandomEnv(spaces.Box(0, 1, (10, 10, 10), np.bool_))
    buffer = learn(env, policy_kwargs=dict(features_extractor_class=MinAtarCNN, net_arch=[])).replay_buffer
    assert buffer.observations.dtype == buffer.next_observations.dtype == np.bool_
    arrays = [array for array in vars(buffer).values() if isinstance(array, np.ndarray)]
    bytes_per_transition = sum(array.nbytes for array in arrays) / buffer.buffer_size
    assert 2000 <= bytes_per_transition and 500_000 * bytes_per_transition <= 1.2e9


class FixedQ(th.nn.Module):
    """A Q-network of two actions, whatever the observation."""

    def __init__(self, *values):
        super().__init__()
        self.values = th.nn.Parameter(th.tensor([values]))

    def forward(self, observations):
        return self.values.repeat(len(observations), 1)


@pytest.mark.parametrize(
    "double_q, loss, expected",
    [
        # r = 0 and γ = 0.5. The online network prefers action 1, which the target network values at 4, and its best at 6.
        (True, "mse", (1 - 0.5 * 4) ** 2),
        (False, "mse", (1 - 0.5 * 6) ** 2),
        (True, "huber", 0.5 * (1 - 0.5 * 4) ** 2),
        (False, "huber", abs(1 - 0.5 * 6) - 0.5),
    ],
)
def test_loss_by_hand(double_q, loss, expected):
    model = DoubleDQN("MlpPolicy", RandomEnv(), double_q=double_q, loss=loss, gamma=0.5, **SETTINGS)
    model.learn(20)  # not more than `learning_starts`
    buffer = model.replay_buffer
    buffer.rewards[:], buffer.actions[:], buffer.dones[:] = 0.0, 0, 0.0
    model.q_net, model.q_net_target = FixedQ(1.0, 2.0), FixedQ(6.0, 4.0)
    model.policy.optimizer = th.optim.SGD(model.q_net.parameters(), lr=0.1)
    model.train(gradient_steps=1, batch_size=8)
    assert model.logger.name_to_value["train/loss"] == pytest.approx(expected)
