"""CChainPPO runs wherever PPO does, and says what it does."""

import csv
import re
from copy import deepcopy

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize
from torch import nn

from sb3_cchain import CChainCallback, CChainDQN, CChainPPO, ChurnMonitor
from sb3_cchain.networks.policy_outputs import policy_outputs
from tests.envs import RandomEnv

SETTINGS = dict(n_steps=32, batch_size=8, n_epochs=2, seed=0, device="cpu")
DQN_SETTINGS = dict(learning_starts=20, buffer_size=100, batch_size=8, train_freq=1, seed=0, device="cpu")
CHURN_KEYS = {"churn/policy_churn", "churn/value_churn", "churn/loss", "churn/coef", "churn/relative_loss"}

BOX = spaces.Box(-1, 1, (4,), np.float32)
IMAGE = spaces.Box(0, 255, (36, 36, 3), np.uint8)


def learn(env, policy="MlpPolicy", **kwargs):
    """Two iterations; the second has seen churn from its first update on."""
    model = CChainPPO(policy, env, **{**SETTINGS, **kwargs})
    return model.learn(2 * SETTINGS["n_steps"] * model.n_envs)


def assert_churn_was_reduced(model):
    logged = model.logger.name_to_value
    assert CHURN_KEYS <= set(logged)
    assert all(np.isfinite(logged[key]) for key in CHURN_KEYS)
    assert logged["churn/policy_churn"] > 0 and logged["churn/value_churn"] > 0


@pytest.mark.parametrize(
    "action_space",
    [spaces.Discrete(3), spaces.MultiDiscrete([2, 4]), spaces.MultiBinary(3), spaces.Box(-1, 1, (2,), np.float32)],
    ids=lambda space: type(space).__name__,
)
@pytest.mark.parametrize(
    "policy, observation_space",
    [
        ("MlpPolicy", BOX),
        ("MlpPolicy", spaces.Discrete(5)),
        ("CnnPolicy", IMAGE),
        ("MultiInputPolicy", spaces.Dict({"vector": BOX, "image": IMAGE})),
    ],
    ids=["Box", "Discrete", "image", "Dict"],
)
def test_spaces(policy, observation_space, action_space):
    assert_churn_was_reduced(learn(RandomEnv(observation_space, action_space), policy))


@pytest.mark.parametrize("squash", [False, True])
def test_gsde(squash):
    env = RandomEnv(action_space=spaces.Box(-1, 1, (2,), np.float32))
    model = learn(env, use_sde=True, sde_sample_freq=4, policy_kwargs=dict(squash_output=squash))
    assert_churn_was_reduced(model)


@pytest.mark.parametrize("vec_env_cls", [None, SubprocVecEnv])
def test_vectorised_and_normalised(vec_env_cls):
    env = VecNormalize(make_vec_env(RandomEnv, n_envs=2, vec_env_cls=vec_env_cls))
    assert_churn_was_reduced(learn(env))
    env.close()


class NormalisedExtractor(BaseFeaturesExtractor):
    """BatchNorm and dropout, as module and as function."""

    def __init__(self, observation_space):
        super().__init__(observation_space, 8)
        self.net = nn.Sequential(nn.Linear(4, 8), nn.BatchNorm1d(8), nn.Dropout(0.5))

    def forward(self, observations):
        return nn.functional.dropout(self.net(observations), training=self.training)


def test_batch_norm_and_dropout_act_in_the_churn_loss_as_they_do_in_the_environment():
    model = learn(RandomEnv(), policy_kwargs=dict(features_extractor_class=NormalisedExtractor))
    assert_churn_was_reduced(model)
    # Reference batches neither move the running statistics nor draw from the random numbers of dropout, so that a λ
    # too small to matter leaves the parameters as PPO's
    tiny = learn(RandomEnv(), policy_kwargs=dict(features_extractor_class=NormalisedExtractor), churn_coef=1e-30)
    plain = PPO("MlpPolicy", RandomEnv(), policy_kwargs=dict(features_extractor_class=NormalisedExtractor), **SETTINGS)
    plain.learn(64)
    for name, tensor in plain.policy.state_dict().items():
        assert th.equal(tensor, tiny.policy.state_dict()[name]), name


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


def test_positional_arguments_are_those_of_ppo():
    model = CChainPPO("MlpPolicy", RandomEnv(), 1e-3, 32, 8, device="cpu")
    assert (model.learning_rate, model.n_steps, model.batch_size) == (1e-3, 32, 8)


def test_early_stopping_before_the_first_update():
    model = learn(RandomEnv(), target_kl=-1.0)
    assert model.policy.optimizer.state_dict()["state"] == {}  # not one update
    assert not CHURN_KEYS & set(model.logger.name_to_value)
    assert model.churn_reducer.coefficient.n_seen == 0


def test_default_ratio_is_that_of_the_action_space():
    discrete = CChainPPO("MlpPolicy", RandomEnv(), **SETTINGS)
    box = CChainPPO("MlpPolicy", RandomEnv(action_space=spaces.Box(-1, 1, (2,), np.float32)), **SETTINGS)
    assert discrete.churn_reducer.coefficient.target_ratio == 1e4
    assert box.churn_reducer.coefficient.target_ratio == 0.05


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


def test_policy_churn_is_the_kl_divergence():
    """One update per iteration, so that the logged mean is one number that can be computed from two saved policies."""
    model = CChainPPO(
        "MlpPolicy", RandomEnv(), n_steps=32, batch_size=16, n_epochs=1, learning_rate=1e-2, seed=0, device="cpu"
    )
    pairs = []

    def backward(reference, add_gradient, backward=model.churn_reducer.backward):
        reducer = model.churn_reducer
        if reducer.reference is not None:
            with th.no_grad():
                new = model.policy.get_distribution(reducer.reference).distribution
            old = th.distributions.Categorical(probs=reducer.old_outputs)
            pairs.append(th.distributions.kl_divergence(old, new).mean().item())
        backward(reference, add_gradient)

    model.churn_reducer.backward = backward
    model.learn(2 * 32)
    assert model.logger.name_to_value["churn/policy_churn"] == pytest.approx(np.mean(pairs[-2:]), abs=1e-6)


def test_tensorboard_name(tmp_path):
    CChainPPO("MlpPolicy", RandomEnv(), tensorboard_log=str(tmp_path), **SETTINGS).learn(32)
    assert [folder.name for folder in tmp_path.iterdir()] == ["CChainPPO_1"]


def test_logs_to_csv(tmp_path):
    model = CChainPPO("MlpPolicy", RandomEnv(), **SETTINGS)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(3 * 32)
    with open(tmp_path / "progress.csv", newline="") as file:
        assert CHURN_KEYS <= set(next(csv.reader(file)))


def test_not_a_number_raises_and_leaves_the_parameters_finite():
    model = learn(RandomEnv())
    model.churn_reducer.old_outputs.fill_(float("nan"))
    with pytest.raises(ValueError, match="The churn loss is nan"):
        model.learn(32)
    assert all(p.isfinite().all() for p in model.policy.parameters())
    assert "zero_grad" not in vars(model.policy.optimizer) and "get" not in vars(model.rollout_buffer)


@pytest.mark.parametrize(
    "arguments, name",
    [
        ({"churn_coef": -0.5}, "churn_coef"),
        ({"churn_coef": "sometimes"}, "churn_coef"),
        ({"churn_coef": 1e39}, "churn_coef"),
        ({"target_churn_ratio": 1e45}, "target_churn_ratio"),
        ({"target_churn_ratio": 0}, "target_churn_ratio"),
        ({"target_churn_ratio": "big"}, "target_churn_ratio"),
        ({"churn_warmup": 1.5}, "churn_warmup"),
        ({"churn_window": 0}, "churn_window"),
        ({"churn_coef_min": -1}, "churn_coef_min"),
        ({"churn_base_loss": "value"}, "churn_base_loss"),
    ],
)
@pytest.mark.parametrize("make", [lambda **kw: CChainPPO("MlpPolicy", "no environment is made", **kw), CChainCallback])
def test_bad_churn_arguments(make, arguments, name):
    with pytest.raises(ValueError, match=f"`{name}`.*got {re.escape(repr(next(iter(arguments.values()))))}"):
        make(**arguments)


def test_unknown_arguments_are_refused():
    with pytest.raises(TypeError, match="churn_coeff"):
        CChainPPO("MlpPolicy", RandomEnv(), churn_coeff=1.0)


def test_callback_on_stock_ppo_equals_cchain_ppo():
    arguments = dict(target_churn_ratio=1e3, churn_warmup=1, churn_window=3, churn_base_loss="surrogate")
    ours = CChainPPO("MlpPolicy", "CartPole-v1", **arguments, **SETTINGS).learn(4 * 32)
    stock = PPO("MlpPolicy", "CartPole-v1", **SETTINGS).learn(4 * 32, callback=CChainCallback(**arguments))
    assert_churn_was_reduced(stock)
    for name, tensor in ours.policy.state_dict().items():
        assert th.equal(tensor, stock.policy.state_dict()[name]), name
    assert "zero_grad" not in vars(stock.policy.optimizer)


def test_callback_leaves_nothing_behind_when_training_fails():
    callback = CChainCallback()
    model = PPO("MlpPolicy", "CartPole-v1", **SETTINGS).learn(2 * 32, callback=callback)
    callback.churn_reducer.old_outputs.fill_(float("nan"))
    with pytest.raises(ValueError, match="The churn loss is nan"):
        model.learn(32, callback=callback)
    left = {*vars(model), *vars(model.policy.optimizer), *vars(model.rollout_buffer)}
    assert not {"train", "_excluded_save_params", "zero_grad", "get"} & left
    model.learn(32)


def test_a_model_saved_at_the_end_of_a_rollout_learns_when_it_is_loaded(tmp_path):
    class Save(BaseCallback):
        def _on_rollout_end(self):
            self.model.save(tmp_path / "model")

        def _on_step(self):
            return True

    PPO("MlpPolicy", "CartPole-v1", **SETTINGS).learn(32, callback=[CChainCallback(), Save()])
    loaded = PPO.load(tmp_path / "model", env=make_vec_env("CartPole-v1"), device="cpu")
    assert not {"train", "_excluded_save_params"} & set(vars(loaded))
    before = deepcopy(loaded.policy.state_dict())
    loaded.learn(64)
    assert not th.equal(before["action_net.weight"], loaded.policy.action_net.weight)


@pytest.mark.parametrize("another", [False, True])
def test_another_call_of_learn_goes_on_with_the_history(another):
    callback = CChainCallback()
    model = PPO("MlpPolicy", "CartPole-v1", **SETTINGS).learn(2 * 32, callback=callback)
    callback = CChainCallback() if another else callback
    model.learn(2 * 32, callback=callback, reset_num_timesteps=False)
    assert callback.churn_reducer.coefficient.n_seen == 4


def test_training_without_the_callback_in_between_is_no_churn():
    callback, references = CChainCallback(), []
    model = PPO("MlpPolicy", "CartPole-v1", **SETTINGS).learn(32, callback=callback)
    for between in (lambda: None, lambda: model.learn(32)):
        between()
        callback.init_callback(model)
        references.append(callback.churn_reducer.reference)
    assert references[0] is not None and references[1] is None
    assert callback.churn_reducer.coefficient.n_seen == 1


SAME = CChainCallback()


@pytest.mark.parametrize(
    "callbacks",
    [
        [CChainCallback(), CChainCallback()],
        [SAME, SAME],
        [CallbackList([CChainCallback()]), CallbackList([CallbackList([CChainCallback()])])],
    ],
    ids=["two", "the same twice", "nested"],
)
def test_two_callbacks_are_refused(callbacks):
    model = PPO("MlpPolicy", "CartPole-v1", **SETTINGS)
    with pytest.raises(ValueError, match=r"`learn\(\)` was given 2 CChainCallbacks.*give it one"):
        model.learn(32, callback=callbacks)
    assert model.num_timesteps == 0


@pytest.mark.parametrize("argument", ["callback_after_eval", "callback_on_new_best"])
def test_a_callback_held_by_another_is_refused(argument):
    """It would be called at events alone, and reduce no churn."""
    holder = EvalCallback(make_vec_env("CartPole-v1"), **{argument: CChainCallback()})
    with pytest.raises(ValueError, match=r"EvalCallback holds it: give it to `learn\(\)`"):
        PPO("MlpPolicy", "CartPole-v1", **SETTINGS).learn(32, callback=holder)


@pytest.mark.parametrize("again", [False, True])
def test_an_interruption_before_the_update_leaves_nothing_that_reduces_churn(again):
    class Interrupt(BaseCallback):
        def _on_rollout_end(self):
            raise KeyboardInterrupt

        def _on_step(self):
            return True

    models = []
    for callbacks in ([CChainCallback(), Interrupt()], [Interrupt()]):
        models.append(PPO("MlpPolicy", "CartPole-v1", **SETTINGS))
        with pytest.raises(KeyboardInterrupt):
            models[-1].learn(32, callback=callbacks)
        models[-1].learn(64, callback=CChainCallback() if again else None)
        assert "train" not in vars(models[-1])
    for p, q in zip(*(model.policy.parameters() for model in models), strict=True):
        assert th.equal(p, q)


@pytest.mark.parametrize("make", [CChainPPO, CChainDQN, PPO])
@pytest.mark.parametrize("monitor", [False, True])
def test_a_compiled_policy(make, monitor, tmp_path):
    settings = DQN_SETTINGS if make is CChainDQN else SETTINGS
    models = []
    for compiled in (False, True):
        model = make("MlpPolicy", "CartPole-v1", **settings)
        if compiled:
            model.policy = th.compile(model.policy, backend="eager")
        callbacks = [CChainCallback()] * (make is PPO) + [ChurnMonitor(interval=3)] * monitor
        model.learn(96, callback=callbacks)
        model.save(tmp_path / "model")
        models += [model, make.load(tmp_path / "model", device="cpu")]
    for model in models[1:]:
        for p, q in zip(models[0].policy.parameters(), model.policy.parameters(), strict=True):
            assert th.equal(p, q)
    logged = [dict(model.logger.name_to_value) for model in models[::2]]
    assert logged[0] == logged[1]
    assert any(key.startswith("churn/") for key in logged[0])
    assert any(key.startswith("churn_monitor/") for key in logged[0]) == monitor


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


@pytest.mark.parametrize(
    "action_space", [spaces.Discrete(3), spaces.Box(-1, 1, (2,), np.float32)], ids=lambda space: type(space).__name__
)
def test_large_weights_stay_finite(action_space):
    model = CChainPPO("MlpPolicy", RandomEnv(action_space=action_space), **SETTINGS)
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.mul_(1e5)
    model.learn(64)
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())
    assert np.isfinite(model.churn_reducer.coefficient.value)


class TemperedPolicy(ActorCriticPolicy):
    """Acts by other probabilities than those of its last layer."""

    def _get_action_dist_from_latent(self, latent_pi):
        return self.action_dist.proba_distribution(action_logits=50 * self.action_net(latent_pi))


@pytest.mark.parametrize(
    "action_space",
    [spaces.Discrete(3), spaces.MultiDiscrete([2, 4]), spaces.MultiBinary(3), spaces.Box(-1, 1, (2,), np.float32)],
    ids=lambda space: type(space).__name__,
)
def test_outputs_are_those_of_the_distribution(action_space):
    class SamePolicy(ActorCriticPolicy):
        def get_distribution(self, obs):
            return super().get_distribution(obs)

    policies = [CChainPPO(cls, RandomEnv(action_space=action_space), **SETTINGS).policy for cls in ("MlpPolicy", SamePolicy)]
    observations = th.randn(5, 4)
    assert th.allclose(*(policy_outputs(policy, observations) for policy in policies))


def test_a_policy_with_a_distribution_of_its_own():
    model = learn(RandomEnv(), policy=TemperedPolicy)
    assert_churn_was_reduced(model)
    observations = th.randn(5, 4)
    acting = model.policy.get_distribution(observations).distribution.probs
    assert th.allclose(policy_outputs(model.policy, observations), acting)


def test_another_policy_put_in_place():
    model, other = learn(RandomEnv()), learn(RandomEnv(), seed=1)
    model.policy = other.policy
    model.learn(32)
    assert_churn_was_reduced(model)


def test_callback_refuses_other_algorithms():
    with pytest.raises(TypeError, match="CChainCallback trains PPO, got A2C"):
        A2C("MlpPolicy", "CartPole-v1", device="cpu").learn(10, callback=CChainCallback())
    with pytest.raises(TypeError, match="CChainPPO reduces churn by itself"):
        CChainPPO("MlpPolicy", "CartPole-v1", **SETTINGS).learn(10, callback=CChainCallback())


@pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")
def test_cuda():
    assert_churn_was_reduced(learn(RandomEnv(), device="cuda"))
