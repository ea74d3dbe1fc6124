"""C-CHAIN runs wherever the algorithm without it does, and logs what it does."""

import csv
import re

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize

from sb3_cchain import CChainDQN, CChainPPO, DoubleDQN
from tests.churn_models import (
    ACTION_SPACES,
    ALGORITHMS,
    BOX,
    DQN_SETTINGS,
    FORMS,
    IMAGE,
    assert_churn_was_reduced,
    churn_keys,
    each_algorithm,
    each_form,
    state_of,
)
from tests.envs import RandomEnv


@pytest.mark.parametrize(
    "form, action_space",
    [
        pytest.param(form, space, id=f"{name}-{type(space).__name__}")
        for name, form in ALGORITHMS.items()
        for space in form.action_spaces
    ],
)
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
def test_spaces(form, action_space, policy, observation_space):
    assert_churn_was_reduced(form.learn(RandomEnv(observation_space, action_space), policy))


@pytest.fixture(scope="module", params=[None, SubprocVecEnv])
def vec_env(request):
    env = make_vec_env(RandomEnv, n_envs=2, vec_env_cls=request.param)
    yield env
    env.close()


@each_algorithm
def test_vectorised_and_normalised(form, vec_env):
    references = []
    model, _ = form.make(VecNormalize(vec_env))
    remember = model.churn_reducer.remember
    model.churn_reducer.remember = lambda reference, *args: (references.append(reference), remember(reference, *args))
    model.learn(2 * form.n_timesteps, log_interval=10**6)
    assert_churn_was_reduced(model)
    # Reference batches are normalised as minibatches are: the environment's own observations are in [-1, 1]
    assert th.cat(references).abs().max() > 1
    if hasattr(model, "replay_buffer"):  # which holds the environment's own observations
        assert np.abs(model.replay_buffer.observations).max() <= 1


@pytest.mark.parametrize(
    "algorithm, arguments",
    [
        (CChainPPO, dict(learning_rate=1e-3, n_steps=32, batch_size=8)),
        (CChainDQN, dict(learning_rate=1e-3, buffer_size=100, learning_starts=7, batch_size=16)),
    ],
)
def test_positional_arguments_are_those_of_the_stock_algorithm(algorithm, arguments):
    model = algorithm("MlpPolicy", RandomEnv(), *arguments.values(), device="cpu")
    assert {name: getattr(model, name) for name in arguments} == arguments


@pytest.mark.parametrize(
    "algorithm, action_space, target_ratio, warmup, window",
    [
        (CChainPPO, ACTION_SPACES[0], 1e4, 10, 50),
        (CChainPPO, ACTION_SPACES[-1], 0.05, 10, 50),
        (CChainDQN, ACTION_SPACES[0], 0.01, 0, 1000),
    ],
)
def test_default_coefficient(algorithm, action_space, target_ratio, warmup, window):
    coefficient = algorithm("MlpPolicy", RandomEnv(action_space=action_space), device="cpu").churn_reducer.coefficient
    assert (coefficient.target_ratio, coefficient.initial, coefficient.warmup) == (target_ratio, 1, warmup)
    assert len(coefficient.base_losses) == window


@pytest.mark.parametrize(
    "algorithm, settings",
    [*((form.algorithm, form.settings) for form in ALGORITHMS.values()), (DoubleDQN, DQN_SETTINGS)],
)
def test_tensorboard_name(algorithm, settings, tmp_path):
    algorithm("MlpPolicy", RandomEnv(), tensorboard_log=str(tmp_path), **settings).learn(25)
    assert [folder.name for folder in tmp_path.iterdir()] == [f"{algorithm.__name__}_1"]


@each_algorithm
def test_logs_to_csv(form, tmp_path):
    model, _ = form.make()
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(96)
    with open(tmp_path / "progress.csv", newline="") as file:
        assert churn_keys(model) <= set(next(csv.reader(file)))


@each_form
def test_an_infinite_churn_loss_is_named_before_an_update(form):
    model, callback = form.make()
    model.learn(form.n_timesteps, callback)
    model.churn_state.reducers.first.old_outputs.fill_(float("nan"))
    before = state_of(model)
    with pytest.raises(ValueError, match="The churn loss is nan"):
        model.learn(form.n_timesteps, callback)
    assert all(th.equal(*pair) for pair in zip(before, state_of(model), strict=True))
    # Nothing that was put in place for the update is left
    buffer = getattr(model, "rollout_buffer", None) or model.replay_buffer
    left = {*vars(model), *vars(model.policy.optimizer), *vars(buffer)}
    assert not {"train", "_excluded_save_params", "zero_grad", "get"} & left
    model.churn_state.reducers.first.forget_reference()
    model.learn(form.n_timesteps)


BAD_CHURN_ARGUMENTS = [
    ("churn_coef", -0.5),
    ("churn_coef", "sometimes"),
    ("churn_coef", 1e39),
    ("target_churn_ratio", 1e45),
    ("target_churn_ratio", 0),
    ("target_churn_ratio", "big"),
    ("churn_warmup", 1.5),
    ("churn_window", 0),
    ("churn_coef_min", -1),
    ("churn_reference", "previous"),
]
BAD_POLICY_ARGUMENTS = [
    ("churn_base_loss", "value"),
    ("churn_batch_size", 0),
    ("churn_batch_size", "half"),
]


@pytest.mark.parametrize(
    "name, argument, value",
    [
        *((name, *bad) for name in FORMS for bad in BAD_CHURN_ARGUMENTS),
        *((name, *bad) for name in ("CChainPPO", "CChainCallback") for bad in BAD_POLICY_ARGUMENTS),
    ],
)
def test_bad_churn_arguments(name, argument, value):
    with pytest.raises(ValueError, match=f"`{argument}`.*got {re.escape(repr(value))}"):
        FORMS[name].make("no environment is made", **{argument: value})


@each_form
def test_unknown_arguments_are_refused(form):
    with pytest.raises(TypeError, match="churn_coeff"):
        form.make(churn_coeff=1.0)


@each_algorithm
def test_another_policy_put_in_place(form):
    model, other = form.learn(), form.learn(seed=1)
    model.policy = other.policy
    if hasattr(model, "_create_aliases"):
        model._create_aliases()
    model.learn(form.n_timesteps, log_interval=10**6)
    assert_churn_was_reduced(model)


@pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")
@each_algorithm
def test_cuda(form):
    assert_churn_was_reduced(form.learn(device="cuda"))
