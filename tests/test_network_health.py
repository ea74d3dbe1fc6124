"""Dormant and active units, ranks of features and norms of parameters, by groups of layers; and their callback."""

import math
from functools import partial

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import ARS, QRDQN, TQC, TRPO, CrossQ, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_cchain import CChainPPO
from sb3_cchain.analysis import NetworkHealth
from sb3_cchain.analysis.health_figures import network_health, remember_initial_parameters, trained_groups
from sb3_cchain.analysis.metrics.norms import group_norms
from sb3_cchain.methods import L2Init, ReDo
from sb3_cchain.networks import CReLU, CReLUPolicy, FourierFeatures, FourierPolicy
from tests.envs import RandomEnv
from tests.method_models import ALGORITHMS, go_on, make_model, make_random_env, parameters

PLANE = spaces.Box(-1, 1, (2,), np.float32)
FRAMES = spaces.Box(0, 255, (36, 36, 1), np.uint8)
DICT = spaces.Dict({"a": spaces.Box(-1, 1, (2,), np.float32), "b": spaces.Discrete(3)})
BOX_ENV = partial(RandomEnv, action_space=spaces.Box(-1, 1, (2,), np.float32))
OFF_POLICY = dict(buffer_size=100, learning_starts=8, batch_size=8)


class Log(BaseCallback):
    """Keeps what was logged under `health/` at the end of each rollout. To stand behind `NetworkHealth`."""

    def _on_training_start(self):
        self.records = []

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        logged = {key: value for key, value in self.logger.name_to_value.items() if key.startswith("health/")}
        if logged:
            self.records.append(logged)
            for key in logged:
                del self.logger.name_to_value[key]


class SpyHealth(NetworkHealth):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.acted_at = []

    def _log(self):
        self.acted_at.append((self.model.num_timesteps, self.model._n_updates))
        super()._log()


def set_weights(policy, **weights):
    """All others become 0."""
    with th.no_grad():
        for name, parameter in policy.named_parameters():
            parameter.copy_(th.tensor(weights.pop(name.replace(".", "_"), 0.0)))
    assert not weights


def make_tiny_model(policy="MlpPolicy", space=PLANE, **policy_kwargs):
    env = RandomEnv(space, spaces.Discrete(2))
    kwargs = dict(net_arch=dict(pi=[3], vf=[2]), activation_fn=nn.ReLU) | policy_kwargs
    return PPO(policy, env, n_steps=16, batch_size=8, seed=0, device="cpu", policy_kwargs=kwargs)


def test_a_network_by_hand():
    model = make_tiny_model()
    set_weights(
        model.policy,
        mlp_extractor_policy_net_0_weight=[[1.0, 0.0], [0.0, 2.0], [0.0, 0.0]],
        mlp_extractor_value_net_0_weight=[[1.0, 1.0], [-1.0, -1.0]],
        action_net_bias=[3.0, -4.0],
        value_net_weight=[[0.0, 2.0]],
    )
    observations = th.eye(2)
    # Activations of the policy's units: (1, 0), (0, 2), (0, 0); of the value's: (1, 1), (0, 0)
    health = network_health(model, observations)
    expected = {
        "dormant_share": 2 / 5,
        "dormant_share/mlp_extractor.policy_net": 1 / 3,
        "dormant_share/mlp_extractor.value_net": 1 / 2,
        "active_share": 4 / 10,
        "active_share/mlp_extractor.policy_net": 2 / 6,
        "active_share/mlp_extractor.value_net": 2 / 4,
        # Singular values 2 and 1; √2
        "feature_srank/mlp_extractor.policy_net": 2,
        "feature_effective_rank/mlp_extractor.policy_net": 1.5 ** (2 / 3) * 3 ** (1 / 3),
        "feature_srank/mlp_extractor.value_net": 1,
        "feature_effective_rank/mlp_extractor.value_net": 1.0,
        "weight_norm": math.sqrt(5 + 4 + 25 + 4),
        "weight_norm/mlp_extractor.policy_net": math.sqrt(5),
        "weight_norm/mlp_extractor.value_net": 2.0,
        "weight_norm/action_net": 5.0,
        "weight_norm/value_net": 2.0,
    }
    assert health == pytest.approx(expected, rel=1e-6)

    remember_initial_parameters(model)
    with th.no_grad():
        model.policy.action_net.bias += th.tensor([3.0, 4.0])
        model.policy.value_net.bias += 12.0
    remember_initial_parameters(model)  # again, in vain
    moved = network_health(model, observations)
    distances = {
        "distance_from_init": 13.0,
        "distance_from_init/mlp_extractor.policy_net": 0.0,
        "distance_from_init/mlp_extractor.value_net": 0.0,
        "distance_from_init/action_net": 5.0,
        "distance_from_init/value_net": 12.0,
    }
    assert {key: value for key, value in moved.items() if "distance" in key} == pytest.approx(distances, rel=1e-6)


@pytest.mark.parametrize("tau, share", [(0.19, 0.0), (0.21, 1 / 3)])
def test_tau_by_hand(tau, share):
    model = make_tiny_model()
    set_weights(model.policy, mlp_extractor_policy_net_0_bias=[1.0, 0.4 / 3, 0.87], mlp_extractor_value_net_0_bias=[1.0, 1.0])
    # The scores of the policy's are 1.5, 0.2 and 1.3
    assert network_health(model, th.zeros(4, 2), tau)["dormant_share/mlp_extractor.policy_net"] == pytest.approx(share)


def test_layers_are_scored_one_by_one_and_counted_together():
    model = make_tiny_model(net_arch=dict(pi=[4, 1], vf=[]))
    set_weights(
        model.policy,
        mlp_extractor_policy_net_0_bias=[100.0, 0.0, 100.0, 0.0],
        mlp_extractor_policy_net_2_bias=[0.01],
    )
    health = network_health(model, th.zeros(3, 2))
    # The unit of the second layer has the score 1, however small beside the first layer's
    assert health["dormant_share"] == health["dormant_share/mlp_extractor.policy_net"] == 2 / 5
    assert health["active_share"] == 3 / 5
    # Features are those of the second layer
    assert health["feature_effective_rank/mlp_extractor.policy_net"] == pytest.approx(1.0)
    assert not any(key.endswith("mlp_extractor.value_net") for key in health)


def test_of_crelu_by_hand():
    model = make_tiny_model(CReLUPolicy, net_arch=dict(pi=[2], vf=[]), activation_fn=CReLU)
    set_weights(model.policy, mlp_extractor_policy_net_0_weight=[[1.0, 0.0], [0.0, 0.0]])
    health = network_health(model, th.tensor([[1.0, 0.0], [-1.0, 0.0]]))
    # One half or the other of the first unit is active, none of the second
    assert health["active_share"] == health["dormant_share"] == 0.5
    # Features (1, 0, 0, 0) and (0, 0, 1, 0)
    assert health["feature_effective_rank/mlp_extractor.policy_net"] == pytest.approx(2.0)


def test_of_fourier_features_by_hand():
    model = make_tiny_model(FourierPolicy, net_arch=dict(pi=[2], vf=[]), activation_fn=FourierFeatures)
    set_weights(model.policy, mlp_extractor_policy_net_0_weight=[[th.pi / 2, 0.0], [0.0, 0.0]])
    health = network_health(model, th.tensor([[1.0, 0.0], [-1.0, 0.0]]))
    # Features (1, 0, 0, 1) and (-1, 0, 0, 1)
    assert health["dormant_share"] == 0.5 and "active_share" not in health
    assert health["feature_effective_rank/mlp_extractor.policy_net"] == pytest.approx(2.0)


class TinyCNN(BaseFeaturesExtractor):
    def __init__(self, observation_space):
        super().__init__(observation_space, features_dim=8)
        self.cnn = nn.Sequential(nn.Conv2d(1, 2, 1), nn.ReLU(), nn.Flatten())

    def forward(self, observations):
        return self.cnn(observations)


def test_of_filters_by_hand():
    space = spaces.Box(-1, 1, (1, 2, 2), np.float32)
    model = make_tiny_model(space=space, net_arch=[], features_extractor_class=TinyCNN)
    set_weights(model.policy, features_extractor_cnn_0_weight=[[[[1.0]]], [[[0.0]]]])
    images = th.tensor([[[[1.0, -1.0], [-1.0, -1.0]]], [[[1.0, 1.0], [-1.0, -1.0]]]])
    health = network_health(model, images)
    group = "features_extractor.cnn"
    assert health["dormant_share"] == health[f"dormant_share/{group}"] == 1 / 2
    assert health["active_share"] == health[f"active_share/{group}"] == 3 / 16  # of two images, filters and 4 positions
    # Features (1, 0, 0, 0, …) and (1, 1, 0, 0, …)
    sigma = np.linalg.svd([[1.0, 0.0], [1.0, 1.0]], compute_uv=False)
    shares = sigma / sigma.sum()
    assert health[f"feature_effective_rank/{group}"] == pytest.approx(np.exp(-(shares * np.log(shares)).sum()), rel=1e-9)


def test_of_tanh_there_is_no_active_share():
    health = network_health(make_tiny_model(activation_fn=nn.Tanh), th.eye(2))
    assert "dormant_share/mlp_extractor.value_net" in health
    assert not any(key.startswith("active_share") for key in health)


def test_without_hidden_units():
    assert set(network_health(make_tiny_model(net_arch=[]), th.eye(2))) == {
        "weight_norm",
        "weight_norm/action_net",
        "weight_norm/value_net",
    }


def test_features_that_are_not_finite():
    """Of a diverged network, of which SB3 itself does not complain."""
    model = make_model("DQN", env=make_random_env())
    with th.no_grad():
        model.q_net.q_net[0].bias[0] = math.inf
    health = network_health(model, th.zeros(3, 4))
    assert math.isnan(health["feature_srank/q_net.q_net"]) and math.isnan(health["feature_effective_rank/q_net.q_net"])
    assert health["weight_norm"] == math.inf


def test_group_norms_by_hand():
    tensors = {"a": [th.tensor([[1.0, 2.0]]), th.tensor(2.0)], "b": [th.tensor([4.0])], "c": []}
    expected = {"norm": 5.0, "norm/a": 3.0, "norm/b": 4.0, "norm/c": 0.0}
    assert group_norms("norm", tensors) == pytest.approx(expected, rel=1e-6)


def test_the_mode_is_left_as_it_is():
    model = make_tiny_model()
    model.policy.mlp_extractor.policy_net.append(nn.Dropout(0.5))
    for mode in [True, False]:
        model.policy.set_training_mode(mode)
        th.manual_seed(0)
        before = th.get_rng_state()
        one, other = (network_health(model, th.eye(2)) for _ in range(2))
        assert one == other and th.equal(th.get_rng_state(), before)
        assert all(module.training == mode for module in model.policy.modules())


def off_policy_groups(critics, *layers):
    return [f"critic.{critic}" for critic in critics] + [f"actor.{layer}" for layer in layers]


SMALL = dict(features_extractor_kwargs=dict(features_dim=8))
CNN = ["features_extractor.cnn", "features_extractor.linear"]
MLP = ["mlp_extractor.policy_net", "mlp_extractor.value_net"]
HEADS = ["action_net", "value_net"]


@pytest.mark.parametrize(
    "algorithm, policy, env, policy_kwargs, trained, active",
    [
        (PPO, "MlpPolicy", RandomEnv, {}, [*MLP, *HEADS], MLP),
        (PPO, "MlpPolicy", BOX_ENV, {}, ["log_std", *MLP, *HEADS], MLP),
        (PPO, "CnnPolicy", partial(RandomEnv, FRAMES), dict(SMALL, net_arch=[]), [*CNN, *HEADS], CNN),
        (
            PPO,
            "CnnPolicy",
            partial(RandomEnv, FRAMES),
            dict(SMALL, share_features_extractor=False),
            [*CNN, *(f"vf_{group}" for group in CNN), *MLP, *HEADS],
            [*CNN, *(f"vf_{group}" for group in CNN), *MLP],
        ),
        (PPO, "MultiInputPolicy", partial(RandomEnv, DICT), {}, [*MLP, *HEADS], MLP),
        (MaskablePPO, "MlpPolicy", RandomEnv, {}, [*MLP, *HEADS], MLP),
        (RecurrentPPO, "MlpLstmPolicy", RandomEnv, {}, ["lstm_actor", "lstm_critic", *MLP, *HEADS], MLP),
        (RecurrentPPO, "MultiInputLstmPolicy", partial(RandomEnv, DICT), {}, ["lstm_actor", "lstm_critic", *MLP, *HEADS], MLP),
        (DQN, "MlpPolicy", RandomEnv, {}, ["q_net.q_net"], ["q_net.q_net"]),
        (QRDQN, "MlpPolicy", RandomEnv, {}, ["quantile_net.quantile_net"], ["quantile_net.quantile_net"]),
        (
            SAC,
            "MlpPolicy",
            BOX_ENV,
            {},
            off_policy_groups(["qf0", "qf1"], "latent_pi", "mu", "log_std"),
            off_policy_groups(["qf0", "qf1"], "latent_pi"),
        ),
        (
            SAC,
            "CnnPolicy",
            partial(BOX_ENV, FRAMES),
            dict(SMALL, share_features_extractor=True),
            off_policy_groups(["qf0", "qf1"], "features_extractor", "latent_pi", "mu", "log_std"),
            off_policy_groups(["qf0", "qf1"], "features_extractor", "latent_pi"),
        ),
        # The last Tanh of TD3's actor is its action
        (TD3, "MlpPolicy", BOX_ENV, {}, off_policy_groups(["qf0", "qf1"], "mu"), off_policy_groups(["qf0", "qf1"], "mu")),
        (TD3, "MlpPolicy", BOX_ENV, dict(net_arch=dict(pi=[], qf=[8])), off_policy_groups(["qf0", "qf1"], "mu"), None),
        (
            TQC,
            "MlpPolicy",
            BOX_ENV,
            {},
            off_policy_groups(["qf0", "qf1"], "latent_pi", "mu", "log_std"),
            off_policy_groups(["qf0", "qf1"], "latent_pi"),
        ),
    ],
)
def test_groups(algorithm, policy, env, policy_kwargs, trained, active):
    settings = dict(buffer_size=10) if algorithm in (DQN, QRDQN, SAC, TD3, TQC) else dict(n_steps=16, batch_size=16)
    policy_kwargs = dict(net_arch=[8], **policy_kwargs) if "net_arch" not in policy_kwargs else policy_kwargs
    model = algorithm(policy, env(), device="cpu", seed=0, policy_kwargs=policy_kwargs, **settings)
    assert sorted(trained_groups(model)) == sorted(trained)
    # Each is in one group, once
    counted = [parameter for group in trained_groups(model).values() for parameter in group.values()]
    frozen = {p for name, p in model.policy.named_parameters() if "target" in name}
    assert len(counted) == len(set(counted)) and set(counted) == set(model.policy.parameters()) - frozen

    observations, _ = model.policy.obs_to_tensor(make_vec_env(env, 5).reset())
    health = network_health(model, observations)
    for name in ("dormant_share", "feature_srank", "feature_effective_rank"):
        groups = sorted(key.split("/")[1] for key in health if key.startswith(f"{name}/"))
        assert groups == sorted(active or ["critic.qf0", "critic.qf1"])
    assert not any(module._forward_hooks for module in model.policy.modules())


def test_what_is_shared_is_counted_once():
    """Actor and critic of SAC both run the features extractor."""
    settings = dict(buffer_size=10, device="cpu", seed=0)
    space = spaces.Box(-1, 1, (1, 2, 2), np.float32)
    model = SAC(
        "MlpPolicy",
        BOX_ENV(space),
        policy_kwargs=dict(net_arch=[1], features_extractor_class=TinyCNN, share_features_extractor=True),
        **settings,
    )
    with th.no_grad():
        for name, parameter in model.policy.named_parameters():
            parameter.fill_(float(name.endswith("bias")))
        model.actor.features_extractor.cnn[0].bias[1] = -1.0
    # Two filters; a unit of the actor's and of each critic's
    assert network_health(model, th.zeros(3, 1, 2, 2))["dormant_share"] == 1 / 5


class Reused(BaseFeaturesExtractor):
    """One activation function behind two layers."""

    def __init__(self, observation_space):
        super().__init__(observation_space, features_dim=2)
        self.first, self.second, self.relu = nn.Linear(2, 4), nn.Linear(4, 2), nn.ReLU()

    def forward(self, observations):
        return self.relu(self.second(self.relu(self.first(observations))))


def test_a_function_used_twice_has_two_layers():
    model = make_tiny_model(net_arch=[], features_extractor_class=Reused)
    set_weights(model.policy, features_extractor_first_bias=[1.0, 0.0, 1.0, 1.0], features_extractor_second_bias=[0.0, 1.0])
    health = network_health(model, th.zeros(3, 2))
    assert health["dormant_share"] == 2 / 6
    assert health["feature_srank/features_extractor.relu"] == 1


def everything(model):
    """Parameters, moments, and the state of all random numbers."""
    tensors = list(parameters(model).values())
    owners = [model.policy, getattr(model.policy, "actor", None), getattr(model.policy, "critic", None)]
    for optimizer in [owner.optimizer for owner in owners if getattr(owner, "optimizer", None) is not None]:
        tensors += [value for state in optimizer.state.values() for value in state.values()]
    _, keys, position, *_ = np.random.get_state()
    return [*tensors, th.get_rng_state(), th.as_tensor(keys.astype(np.int64)), th.tensor(position)]


@pytest.mark.parametrize("name", [*ALGORITHMS, "SAC", "gSDE"])
def test_training_is_not_changed(name):
    def trained(callback):
        if name == "SAC":
            model = SAC("MlpPolicy", BOX_ENV(), seed=0, device="cpu", policy_kwargs=dict(net_arch=[8]), **OFF_POLICY)
        elif name == "gSDE":
            model = PPO("MlpPolicy", BOX_ENV(), use_sde=True, n_steps=16, batch_size=8, seed=0, device="cpu")
        else:
            model = make_model(name, env=make_random_env())
        return everything(model.learn(48, callback=callback))

    with_health, without = trained(health := SpyHealth(interval=1)), trained(None)
    assert len(health.acted_at) > 2
    assert all(th.equal(x, y) for x, y in zip(with_health, without, strict=True))


@pytest.mark.parametrize(
    "algorithm, env, settings",
    [
        (A2C, RandomEnv, dict(n_steps=16)),
        (TRPO, RandomEnv, dict(n_steps=16, batch_size=8)),
        (MaskablePPO, RandomEnv, dict(n_steps=16, batch_size=8)),
        (RecurrentPPO, RandomEnv, dict(n_steps=16, batch_size=8)),
        (QRDQN, RandomEnv, OFF_POLICY),
        (DDPG, BOX_ENV, OFF_POLICY),
        (TD3, BOX_ENV, OFF_POLICY),
        (TQC, BOX_ENV, OFF_POLICY),
        (CrossQ, BOX_ENV, OFF_POLICY),
    ],
)
def test_algorithms(algorithm, env, settings):
    policy, log = "MlpLstmPolicy" if algorithm is RecurrentPPO else "MlpPolicy", Log()
    model = algorithm(policy, env(), seed=0, device="cpu", policy_kwargs=dict(net_arch=[8]), **settings)
    masking = dict(use_masking=False) if algorithm is MaskablePPO else {}
    model.learn(48, callback=[NetworkHealth(interval=1), log], **masking)
    first, *_, last = log.records
    assert first["health/distance_from_init"] == 0 and "health/gradient_norm" not in first
    assert last["health/distance_from_init"] > 0 and last["health/gradient_norm"] > 0
    for name in ("weight_norm", "distance_from_init", "gradient_norm"):
        groups = set(trained_groups(model))
        if algorithm is TRPO and name == "gradient_norm":  # whose policy has no optimiser
            groups = {"mlp_extractor.value_net", "value_net"}
        assert {key.split("/")[2] for key in last if key.startswith(f"health/{name}/")} == groups
        of_groups = [value for key, value in last.items() if key.startswith(f"health/{name}/")]
        assert last[f"health/{name}"] == pytest.approx(math.hypot(*of_groups))


class SpyAdam(th.optim.Adam):
    """Knows the gradient's norm of its last step."""

    def step(self, closure=None):
        gradients = [p.grad for group in self.param_groups for p in group["params"] if p.grad is not None]
        self.gradient_norm = math.sqrt(sum(gradient.square().sum().item() for gradient in gradients))
        return super().step(closure)


def test_gradient_norm_is_that_of_the_last_update():
    policy_kwargs = dict(net_arch=[8], optimizer_class=SpyAdam)
    model, log = SAC("MlpPolicy", BOX_ENV(), seed=0, device="cpu", policy_kwargs=policy_kwargs, **OFF_POLICY), Log()

    class Expected(BaseCallback):
        norms = []  # noqa: RUF012

        def _on_step(self):
            return True

        def _on_rollout_end(self):
            if model._n_updates:
                self.norms.append([model.actor.optimizer.gradient_norm, model.critic.optimizer.gradient_norm])

    expected = Expected()
    model.learn(14, callback=[NetworkHealth(interval=1), log, expected])
    logged = [
        [
            math.hypot(*(v for key, v in record.items() if key.startswith(f"health/gradient_norm/{of}.")))
            for of in ("actor", "critic")
        ]
        for record in log.records[1:]
    ]
    assert len(logged) == 5 and np.allclose(logged, expected.norms, rtol=1e-5)
    # What SB3 leaves in the critic is not that any more
    left = math.sqrt(sum(p.grad.square().sum().item() for p in model.critic.parameters()))
    assert left != pytest.approx(model.critic.optimizer.gradient_norm, rel=1e-2)


def test_gradient_norm_is_after_clipping():
    model, log = make_model("CChainPPO", env=make_random_env(), max_grad_norm=1e-3, churn_coef=10.0), Log()
    model.learn(32, callback=[NetworkHealth(interval=1), log])
    assert log.records[1]["health/gradient_norm"] == pytest.approx(1e-3, rel=1e-2)


def test_gradient_norm_with_a_wrapped_optimizer():
    policy_kwargs = dict(net_arch=[8], optimizer_class=L2Init, optimizer_kwargs=dict(base_class=SpyAdam))
    model, log = make_model("PPO", env=make_random_env(), policy_kwargs=policy_kwargs), Log()
    norms = []

    class Expected(Log):
        def _on_rollout_end(self):
            norms.append(getattr(model.policy.optimizer.base, "gradient_norm", None))

    model.learn(48, callback=[NetworkHealth(interval=1), log, Expected()])
    assert [record.get("health/gradient_norm") for record in log.records] == [None, *(pytest.approx(n) for n in norms[1:])]


@pytest.mark.parametrize(
    "name, interval, acted_at",
    [
        # After rollouts of 16 steps, with 4 updates (of both epochs) each
        ("PPO", 3, [(16, 0), (48, 4), (96, 10)]),
        ("DQN", 16, [(9, 0), (25, 16), (41, 32)]),
    ],
)
def test_interval(name, interval, acted_at):
    """At the first rollout that is learned from, then at multiples of the interval."""
    health, model = SpyHealth(interval=interval), make_model(name)
    model.learn(112 if name == "PPO" else 42, callback=health)
    assert health.acted_at == acted_at
    # Again when training goes on
    again = SpyHealth(interval=interval)
    model.learn(16 if name == "PPO" else 1, callback=again, reset_num_timesteps=False)
    assert len(again.acted_at) == 1


def test_the_interval_counts_calls_of_train_with_several_environments_too():
    health = SpyHealth(interval=3)
    make_model("PPO", make_vec_env(make_random_env, 2)).learn(192, callback=health)
    assert [step for step, _ in health.acted_at] == [32, 96, 192]


@pytest.mark.parametrize("name, interval", [("PPO", 10), ("DQN", 1000)])
def test_default_interval(name, interval):
    health = NetworkHealth()
    make_model(name).learn(16, callback=health)
    assert health._interval == interval


@pytest.mark.parametrize("name", ALGORITHMS)
def test_initial_parameters_stay_with_the_model(tmp_path, name):
    model = make_model(name, env=make_random_env())
    initial = parameters(model)
    model.learn(32, callback=NetworkHealth()).save(tmp_path / "model")
    assert not any(name in model.initial_parameters for name in initial if "target" in name)

    loaded, log = type(model).load(tmp_path / "model", env=make_random_env(), device="cpu"), Log()
    expected = {n: p - initial[n] for n, p in parameters(loaded).items() if "target" not in n}
    distance = math.sqrt(sum(d.square().sum().item() for d in expected.values()))
    assert network_health(loaded, th.zeros(2, 4))["distance_from_init"] == pytest.approx(distance) and distance > 0
    loaded.learning_starts = loaded.num_timesteps  # the replay buffer is empty
    go_on(loaded, [NetworkHealth(interval=1), log])
    assert log.records[0]["health/distance_from_init"] == pytest.approx(distance)
    for parameter, array in loaded.initial_parameters.items():
        assert isinstance(array, np.ndarray) and np.array_equal(array, initial[parameter].numpy())


def test_nothing_stays_hooked():
    class Stop(BaseCallback):
        def _on_step(self):
            raise KeyboardInterrupt

    model = make_model("PPO")
    hooks = model.policy.optimizer._optimizer_step_pre_hooks
    health = NetworkHealth()
    with pytest.raises(KeyboardInterrupt):
        model.learn(32, callback=[health, Stop()])
    assert len(hooks) == 1
    model.learn(32, callback=[health])
    assert not hooks


@pytest.mark.parametrize("n_envs", [1, 2])
def test_observations_are_of_the_rollout(monkeypatch, n_envs):
    seen = []

    def spy(model, observations, tau):
        rollout = model.rollout_buffer.observations.reshape(-1, 4).tolist()
        seen.append((len(observations), all(row in rollout for row in observations.tolist()), tau))
        return {}

    monkeypatch.setattr("sb3_cchain.analysis.network_health.network_health", spy)
    env = make_vec_env(make_random_env, n_envs=n_envs)
    make_model("PPO", env=env).learn(16 * n_envs, callback=NetworkHealth(batch_size=5, tau=0.1))
    assert seen == [(5, True, 0.1)]


def test_beside_c_chain_and_redo():
    model, log, redo = make_model("CChainPPO", env=make_random_env()), Log(), ReDo(tau=0.5, interval=1)
    assert isinstance(model, CChainPPO)
    model.learn(64, callback=[redo, NetworkHealth(interval=1, tau=0.5), log])
    assert redo.n_recycled > 0 and len(log.records) == 4
    assert all(math.isfinite(value) for record in log.records for value in record.values())
    assert "churn/loss" in model.logger.name_to_value


def test_the_table_on_the_screen(capsys):
    """SB3's refuses keys that are alike in their first 36 characters."""
    make_model("PPO", verbose=1).learn(48, callback=NetworkHealth(interval=1))
    out = capsys.readouterr().out
    assert "dormant_share" in out and "gradient_norm" in out and "policy_net" not in out


def test_by_name_from_yaml():
    """As the stock RL Zoo reads `callback:`."""
    utils = pytest.importorskip("rl_zoo3.utils")
    entry = {"sb3_cchain.analysis.NetworkHealth": {"interval": 5, "batch_size": 32, "tau": 0.1}}
    (made,) = utils.get_callback_list({"callback": [entry]})
    assert isinstance(made, NetworkHealth) and (made.interval, made.batch_size, made.tau) == (5, 32, 0.1)


def test_what_it_refuses():
    for argument, value in [("tau", -1), ("interval", 0), ("batch_size", 0), ("batch_size", 1.5)]:
        with pytest.raises(ValueError, match=f"`{argument}` must be .* got {value}"):
            NetworkHealth(**{argument: value})
    with pytest.raises(TypeError, match="NetworkHealth is for on-policy and off-policy algorithms, got ARS"):
        ARS("LinearPolicy", BOX_ENV(), n_delta=1, device="cpu").learn(10, callback=NetworkHealth())


def test_of_crelu_with_three_units():
    model = make_tiny_model(CReLUPolicy, net_arch=dict(pi=[3], vf=[]), activation_fn=CReLU)
    set_weights(model.policy, mlp_extractor_policy_net_0_weight=[[1.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    health = network_health(model, th.tensor([[1.0, 0.0], [-1.0, 0.0]]))
    assert (health["active_share"], health["dormant_share"]) == (pytest.approx(1 / 3), pytest.approx(2 / 3))
