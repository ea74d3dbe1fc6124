"""The empirical neural tangent kernel: the matrix, its statistics, and the callback that logs them."""

import math

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import QRDQN
from stable_baselines3 import A2C, DQN, PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_cchain import CChainDQN, CChainPPO
from sb3_cchain.analysis import NTKCallback
from sb3_cchain.analysis.metrics.gradients import minibatch_gradients
from sb3_cchain.analysis.metrics.ntk import diagonal_sum, gram_matrix, ntk_statistics, off_diagonal_sum
from sb3_cchain.analysis.ntk import policy_ntk, q_ntk
from tests.churn_models import NormalisedExtractor
from tests.envs import RandomEnv
from tests.test_family import FAMILY

KEYS = ["condition_number", "diagonal_sum", "effective_rank", "off_diagonal_sum", "srank"]


def test_matrix_and_sums_by_hand():
    # Gradients (1, 2, 0), (0, 1, -1), (0, 0, 3) of two parameters, of one and of two entries
    gradients = [th.tensor([[1.0], [0.0], [0.0]]), th.tensor([[2.0, 0.0], [1.0, -1.0], [0.0, 3.0]])]
    matrix = gram_matrix(gradients)
    assert matrix.tolist() == [[5.0, 2.0, 0.0], [2.0, 2.0, -3.0], [0.0, -3.0, 9.0]]
    assert matrix.dtype == th.float64
    assert off_diagonal_sum(matrix) == 10.0
    assert diagonal_sum(matrix) == 16.0


def test_statistics_by_hand():
    # Eigenvalues 3 and 1
    matrix = th.tensor([[2.0, -1.0], [-1.0, 2.0]], dtype=th.float64)
    statistics = ntk_statistics(matrix)
    assert sorted(statistics) == KEYS
    assert statistics["srank"] == 2
    assert ntk_statistics(matrix, delta=0.3)["srank"] == 1
    assert statistics["effective_rank"] == pytest.approx(math.exp(-0.75 * math.log(0.75) - 0.25 * math.log(0.25)))
    assert statistics["condition_number"] == pytest.approx(3.0)
    assert statistics["off_diagonal_sum"] == 2.0
    assert statistics["diagonal_sum"] == 4.0


class Scale(nn.Module):
    def __init__(self):
        super().__init__()
        self.factor = nn.Parameter(th.tensor([2.0, -1.0]))
        self.unused = nn.Parameter(th.ones(3))
        self.frozen = nn.Parameter(th.ones(2), requires_grad=False)


@pytest.mark.parametrize("vectorize", [True, False])
def test_gradients_by_hand(vectorize):
    network = Scale()

    def objective(minibatch):  # mean of (factor · x)², whose gradient is the mean of 2 (factor · x) x
        return (minibatch["x"] @ network.factor).square().mean() + network.frozen.sum()

    minibatches = {"x": th.tensor([[[1.0, 0.0], [0.0, 1.0]], [[1.0, 1.0], [1.0, 1.0]]])}
    (gradients,) = minibatch_gradients(network, objective, minibatches, vectorize)
    assert gradients.tolist() == [[2.0, -1.0], [2.0, 2.0]]
    assert network.factor.grad is None


class Shared(nn.Module):
    """One module under two names, and its weight in a third module, too."""

    def __init__(self):
        super().__init__()
        self.one = self.two = nn.Linear(3, 2)
        self.three = nn.Linear(2, 3)
        self.back = nn.Linear(3, 2)
        self.back.weight = self.one.weight

    def forward(self, x):
        return self.back(self.three(self.one(x).tanh() + self.two(x)))


def test_modules_and_parameters_of_several_names():
    """As SB3 names a shared features extractor three times. They stay what they are, and get all of their gradient."""
    network, minibatches = Shared(), th.randn(4, 5, 3)
    before = list(network.parameters())
    together = minibatch_gradients(network, lambda x: network(x).square().mean(), minibatches)
    assert all(one is other for one, other in zip(before, network.parameters(), strict=True))
    assert all(isinstance(module.weight, nn.Parameter) for module in (network.one, network.three, network.back))
    for index, minibatch in enumerate(minibatches):
        expected = th.autograd.grad(network(minibatch).square().mean(), before)
        for gradients, one in zip(together, expected, strict=True):
            th.testing.assert_close(gradients[index], one)


def test_one_by_one_where_the_objective_cannot_be_vectorised():
    network, calls = Scale(), []

    def objective(minibatch):
        calls.append(len(minibatch))
        return network.factor.sum() * minibatch.sum() if minibatch.sum() > 0 else -network.factor.sum()

    (gradients,) = minibatch_gradients(network, objective, th.tensor([[1.0], [3.0], [-1.0]]))
    assert gradients.tolist() == [[1.0, 1.0], [3.0, 3.0], [-1.0, -1.0]]
    assert len(calls) > 3


def test_one_by_one_where_a_module_cannot_be_vectorised():
    network = nn.GRU(3, 4, batch_first=True)
    minibatches = th.randn(5, 2, 6, 3)
    together = minibatch_gradients(network, lambda x: network(x)[0].sum(), minibatches)
    for gradients, parameter in zip(together, network.parameters(), strict=True):
        (expected,) = th.autograd.grad(network(minibatches[2])[0].sum(), [parameter])
        th.testing.assert_close(gradients[2], expected)


def test_errors_of_the_objective_are_not_taken_for_a_lack_of_vectorisation():
    network = Scale()
    with pytest.raises(RuntimeError, match="size"):
        minibatch_gradients(network, lambda x: (network.factor * x).sum(), th.ones(3, 5))


def rollout(model):
    """A model with a complete rollout, as it is when the callbacks' ``on_rollout_end`` is called."""
    model.learn(0)
    _, callback = model._setup_learn(model.n_steps)
    model.collect_rollouts(model.env, callback, model.rollout_buffer, n_rollout_steps=model.n_steps)
    return model


IMAGES = spaces.Box(0, 255, (36, 36, 3), np.uint8)
ENVS = {
    "discrete": "CartPole-v1",
    "box": "Pendulum-v1",
    "image": lambda: RandomEnv(IMAGES),
    "dict": lambda: RandomEnv(spaces.Dict({"a": spaces.Box(-1, 1, (3,)), "b": spaces.Discrete(4)})),
    "multi-discrete": lambda: RandomEnv(action_space=spaces.MultiDiscrete([2, 3])),
    "multi-binary": lambda: RandomEnv(action_space=spaces.MultiBinary(3)),
}


def make_ppo(env, algorithm=PPO, **kwargs):
    env = ENVS[env]
    if callable(env):
        env = env()
    space = None if isinstance(env, str) else env.observation_space
    policy = "MultiInputPolicy" if isinstance(space, spaces.Dict) else "CnnPolicy" if space is IMAGES else "MlpPolicy"
    return algorithm(policy, env, n_steps=24, policy_kwargs=dict(net_arch=[8]), seed=0, device="cpu", **kwargs)


@pytest.mark.parametrize("env", list(ENVS))
@pytest.mark.parametrize("algorithm", [PPO, A2C, CChainPPO])
@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
def test_policy_ntk_is_that_of_the_clipped_surrogate(env, algorithm, monkeypatch):
    """Against a loop over the loss as PPO writes it, with the gradients in one vector each."""
    model = rollout(make_ppo(env, algorithm))
    order = np.random.default_rng(0).permutation(24)
    monkeypatch.setattr(np.random, "permutation", lambda n: order)
    matrix = policy_ntk(model, n_minibatches=8)

    buffer, policy = model.rollout_buffer, model.policy
    normalized = (buffer.advantages - buffer.advantages.mean()) / (buffer.advantages.std() + 1e-8)
    vectors = []
    for indices in order.reshape(8, 3):
        if isinstance(buffer.observations, dict):
            observations = {key: th.as_tensor(array[indices, 0]) for key, array in buffer.observations.items()}
        else:
            observations = th.as_tensor(buffer.observations[indices, 0])
        actions = th.as_tensor(buffer.actions[indices, 0]).float()
        if isinstance(model.action_space, spaces.Discrete):
            actions = actions.long().flatten()
        advantages, old = th.as_tensor(normalized[indices, 0]), th.as_tensor(buffer.log_probs[indices, 0])
        ratio = (policy.evaluate_actions(observations, actions)[1] - old).exp()
        loss = -th.min(advantages * ratio, advantages * ratio.clamp(0.8, 1.2)).mean()
        gradients = th.autograd.grad(loss, list(policy.parameters()), allow_unused=True)
        vectors.append(th.cat([g.flatten() for g in gradients if g is not None]).double())
    expected = th.stack([th.stack([a @ b for b in vectors]) for a in vectors])
    assert expected.abs().max() > 0
    th.testing.assert_close(matrix, expected, rtol=1e-5, atol=1e-5 * expected.abs().max().item())


def test_vectorised_and_one_by_one_are_equal(monkeypatch):
    model = rollout(make_ppo("discrete"))
    order = np.random.default_rng(0).permutation(24)
    monkeypatch.setattr(np.random, "permutation", lambda n: order)
    together = policy_ntk(model)
    apart = minibatch_gradients
    monkeypatch.setattr("sb3_cchain.analysis.ntk.minibatch_gradients", lambda n, o, m, vectorize: apart(n, o, m, False))
    one_by_one = policy_ntk(model)
    assert together.shape == (24, 24)  # a rollout of 24 steps has no 100 minibatches
    th.testing.assert_close(together, one_by_one, rtol=1e-5, atol=1e-5 * together.abs().max().item())


def test_small_policies_are_vectorised(monkeypatch):
    model = rollout(make_ppo("discrete"))
    monkeypatch.setattr("sb3_cchain.analysis.metrics.gradients._one_by_one", lambda *args: pytest.fail("not vectorised"))
    policy_ntk(model)
    model.policy.action_dist.distribution.sample()  # not one of vmap's tensors


def test_q_ntk_is_that_of_the_definition():
    model = DQN("MlpPolicy", "CartPole-v1", learning_starts=10, policy_kwargs=dict(net_arch=[8]), seed=0, device="cpu").learn(
        40
    )
    np.random.seed(3)
    matrix = q_ntk(model, 7)
    np.random.seed(3)
    replay = model.replay_buffer._get_samples(np.random.permutation(40)[:7])
    vectors = []
    for observation, action in zip(replay.observations, replay.actions, strict=True):
        value = model.q_net(observation[None])[0, action.item()]
        vectors.append(th.cat([g.flatten() for g in th.autograd.grad(value, list(model.q_net.parameters()))]).double())
    expected = th.stack([th.stack([a @ b for b in vectors]) for a in vectors])
    th.testing.assert_close(matrix, expected, rtol=1e-5, atol=1e-5 * expected.abs().max().item())


def test_q_ntk_draws_no_transition_twice():
    model = DQN("MlpPolicy", "CartPole-v1", learning_starts=10, policy_kwargs=dict(net_arch=[8]), seed=0, device="cpu").learn(
        30
    )
    matrix = q_ntk(model, 100)
    assert len(matrix) == 32
    assert len(matrix.unique(dim=0)) == 32


def test_parameters_that_are_not_finite_end_no_training(tmp_path):
    model = DQN("MlpPolicy", "CartPole-v1", learning_starts=10, policy_kwargs=dict(net_arch=[8]), seed=0, device="cpu")
    with th.no_grad():
        model.q_net.q_net[0].weight[0, 0] = float("nan")
    model.learn(40, callback=NTKCallback(n_minibatches=5, path=tmp_path))
    assert all(math.isnan(model.logger.name_to_value[f"ntk/{key}"]) for key in KEYS)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("algorithm", [PPO, A2C, CChainPPO, DQN, CChainDQN])
def test_callback_logs_and_leaves_training_as_it_is(algorithm, tmp_path):
    off_policy = issubclass(algorithm, DQN)
    settings = dict(learning_starts=20, train_freq=1) if off_policy else dict(n_steps=32)
    if issubclass(algorithm, PPO):
        settings["batch_size"] = 16
    settings.update(policy_kwargs=dict(net_arch=[8]), seed=0, device="cpu")
    model = algorithm("MlpPolicy", "CartPole-v1", **settings)
    model.set_logger(configure(str(tmp_path), ["csv", "tensorboard"]))
    logged = []
    callback = NTKCallback(n_minibatches=6, interval=25 if off_policy else 2, picture_interval=2)
    record = model.logger.record
    model.logger.record = lambda key, value, exclude=None: (logged.append(key), record(key, value, exclude))
    model.learn(128, callback=callback)
    del model.logger.record
    assert [logged.count(f"ntk/{key}") for key in KEYS] == [
        5 if off_policy else 3
    ] * 5  # the first, and multiples of the interval
    pictures = sorted(path.name for path in (tmp_path / "ntk").iterdir())
    assert len(pictures) == logged.count("ntk/matrix") == (3 if off_policy else 2), pictures

    plain = algorithm("MlpPolicy", "CartPole-v1", **settings).learn(128)
    for name, parameter in plain.policy.named_parameters():
        assert th.equal(parameter, model.policy.get_parameter(name)), name
    model.save(tmp_path / "model")


class Encoder(BaseFeaturesExtractor):
    """With weights, and nothing that ``vmap`` does not know."""

    def __init__(self, observation_space):
        super().__init__(observation_space, features_dim=5)
        self.layer = nn.Linear(4, 5)

    def forward(self, observations):
        return self.layer(observations).tanh()


@pytest.mark.parametrize("algorithm", [PPO, A2C])
def test_a_shared_features_extractor_goes_on_learning(algorithm):
    settings = dict(n_steps=32, policy_kwargs=dict(features_extractor_class=Encoder, net_arch=[8]), seed=0, device="cpu")
    plain = algorithm("MlpPolicy", "CartPole-v1", **settings)
    before = plain.policy.features_extractor.layer.weight.detach().clone()
    plain.learn(96)
    watched = algorithm("MlpPolicy", "CartPole-v1", **settings).learn(96, callback=NTKCallback(n_minibatches=4))
    assert not th.equal(before, plain.policy.features_extractor.layer.weight)
    for name, parameter in plain.policy.named_parameters():
        assert th.equal(parameter, watched.policy.get_parameter(name)), name


def test_the_interval_goes_on_when_learn_is_called_in_pieces(tmp_path):
    model, callback = make_ppo("discrete"), NTKCallback(n_minibatches=4, interval=3, picture_interval=2, path=tmp_path)
    matrices = []
    for _ in range(7):
        model.learn(24, callback=callback, reset_num_timesteps=False)
        matrices.append(callback.matrix)
    # As `learn(7 * 24)`: the first, and multiples of the interval
    assert [i + 1 for i, matrix in enumerate(matrices) if i == 0 or matrix is not matrices[i - 1]] == [1, 3, 6]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ntk_144.png", "ntk_24.png"]


def test_no_files_without_a_folder_of_logs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make_ppo("discrete").learn(24, callback=NTKCallback(n_minibatches=4))
    assert not list(tmp_path.iterdir())
    make_ppo("discrete").learn(24, callback=NTKCallback(n_minibatches=4, path="pictures"))
    assert [path.name for path in (tmp_path / "pictures").iterdir()] == ["ntk_24.png"]


def no_space_left(*args, **kwargs):
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("reason", ["No space left on device", "File exists"])
def test_a_picture_that_cannot_be_written_does_not_end_training(tmp_path, monkeypatch, reason):
    folder = tmp_path / "pictures"
    model, callback = make_ppo("discrete"), NTKCallback(n_minibatches=4, picture_interval=1, path=folder)
    if reason == "File exists":
        folder.touch()
    else:
        monkeypatch.setattr("matplotlib.figure.Figure.savefig", no_space_left)
    with pytest.warns(UserWarning, match=rf"could not write .*ntk_24\.png .*{reason}.* Training goes on"):
        model.learn(24, callback=callback, log_interval=100)
    assert {"ntk/matrix", "ntk/srank"} <= set(model.logger.name_to_value)


def test_the_folder_of_pictures_is_no_file(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=r"`path` must be a folder, got '.*file', which is a file"):
        NTKCallback(path=tmp_path / "file")


@pytest.mark.parametrize("argument, value", [("n_minibatches", 1), ("delta", 1.5), ("interval", 0), ("picture_interval", -1)])
def test_bad_arguments(argument, value):
    with pytest.raises(ValueError, match=f"`{argument}` must be .*got {value}"):
        NTKCallback(**{argument: value})


def test_unknown_algorithms():
    with pytest.raises(TypeError, match="on-policy algorithms, DQN and QRDQN, without recurrent networks; got SAC"):
        SAC("MlpPolicy", "Pendulum-v1", device="cpu").learn(10, callback=NTKCallback())


def test_sb3_contrib():
    contrib = pytest.importorskip("sb3_contrib")
    kwargs = dict(policy_kwargs=dict(net_arch=[8]), seed=0, device="cpu")
    model = contrib.QRDQN("MlpPolicy", "CartPole-v1", learning_starts=10, **kwargs)
    model.learn(40, callback=NTKCallback(n_minibatches=5, interval=5))
    assert model.logger.name_to_value["ntk/srank"] >= 1
    model = contrib.TRPO("MlpPolicy", "CartPole-v1", n_steps=32, batch_size=32, **kwargs)
    model.learn(32, callback=NTKCallback(n_minibatches=5))
    env = gym.wrappers.TransformObservation(gym.make("CartPole-v1"), lambda x: x, None)
    env.action_masks = lambda: np.array([True, True])
    model = contrib.MaskablePPO("MlpPolicy", env, n_steps=32, batch_size=16, **kwargs)
    model.learn(32, callback=NTKCallback(n_minibatches=5))
    model = contrib.RecurrentPPO("MlpLstmPolicy", "CartPole-v1", n_steps=32, batch_size=16, seed=0, device="cpu")
    with pytest.raises(TypeError, match="recurrent"):
        model.learn(32, callback=NTKCallback(n_minibatches=5))


def test_delta_of_the_callback_holds():
    callback = NTKCallback(n_minibatches=8, delta=0.5, picture_interval=0)
    model = make_ppo("discrete").learn(24, callback, log_interval=99)
    expected, default = (ntk_statistics(callback.matrix, delta)["srank"] for delta in (0.5, 0.01))
    assert model.logger.name_to_value["ntk/srank"] == expected < default


def test_policy_ntk_of_two_environments(monkeypatch):
    env = make_vec_env(RandomEnv, 2, seed=0)
    model = PPO("MlpPolicy", env, n_steps=4, batch_size=8, policy_kwargs=dict(net_arch=[8]), seed=0, device="cpu").learn(0)
    model.collect_rollouts(model.env, model._setup_learn(8)[1], model.rollout_buffer, 4)
    monkeypatch.setattr(np.random, "permutation", np.arange)
    buffer, policy, vectors = model.rollout_buffer, model.policy, []
    advantages = (buffer.advantages - buffer.advantages.mean()) / (buffer.advantages.std() + 1e-8)
    for step, index in np.ndindex(4, 2):
        observation, action = (th.as_tensor(each[step, index]) for each in (buffer.observations, buffer.actions))
        objective = policy.evaluate_actions(observation[None], action.long())[1].sum() * float(advantages[step, index])
        gradients = th.autograd.grad(objective, list(policy.parameters()), allow_unused=True)
        vectors.append(th.cat([g.flatten() for g in gradients if g is not None]).double())
    expected = th.stack(vectors) @ th.stack(vectors).T
    th.testing.assert_close(policy_ntk(model, 8), expected, rtol=1e-4, atol=1e-5 * expected.abs().max().item())


def test_q_ntk_is_of_normalised_observations():
    env, matrices = VecNormalize(make_vec_env(RandomEnv, 1)), []
    settings = dict(learning_starts=10, policy_kwargs=dict(net_arch=[8]), seed=0, device="cpu")
    model = DQN("MlpPolicy", env, **settings).learn(40)
    for shift in (0, 1):
        env.obs_rms.mean = env.obs_rms.mean + shift
        np.random.seed(3)
        matrices.append(q_ntk(model, 7))
    assert not th.allclose(*matrices)


def test_q_ntk_of_quantiles_is_that_of_their_mean():
    settings = dict(learning_starts=10, policy_kwargs=dict(net_arch=[8], n_quantiles=5), seed=0, device="cpu")
    model = QRDQN("MlpPolicy", "CartPole-v1", **settings).learn(20)
    np.random.seed(3)
    matrix = q_ntk(model, 1)
    np.random.seed(3)
    replay = model.replay_buffer._get_samples(np.random.permutation(20)[:1])
    value = model.quantile_net(replay.observations).mean(dim=1)[0, replay.actions.item()]
    gradients = th.autograd.grad(value, list(model.quantile_net.parameters()))
    assert matrix.item() == pytest.approx(sum(g.double().square().sum().item() for g in gradients), rel=1e-4)


def test_policy_ntk_has_the_masks():
    member, seen = FAMILY["MaskablePPO"], []

    class Look(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_end(self):
            policy = self.model.policy
            evaluate_actions = policy.evaluate_actions
            policy.evaluate_actions = lambda *args: (seen.append(len(args)), evaluate_actions(*args))[1]
            policy_ntk(self.model, 4)
            del policy.evaluate_actions

    member.make(member.stock).learn(32, Look())
    assert set(seen) == {3}  # observations, actions, masks


def test_q_ntk_leaves_batch_norm_alone():
    policy_kwargs = dict(features_extractor_class=NormalisedExtractor)
    model = DQN("MlpPolicy", RandomEnv(), learning_starts=10, policy_kwargs=policy_kwargs, seed=0, device="cpu").learn(30)
    model.policy.set_training_mode(True)
    before = {name: buffer.clone() for name, buffer in model.q_net.named_buffers()}
    q_ntk(model, 4)
    assert before and all(th.equal(buffer, before[name]) for name, buffer in model.q_net.named_buffers())
    assert model.q_net.training
