"""Training on in an environment whose spaces are others."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import A2C, DQN, PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_cchain import CChainCallback, CChainDQN, CChainPPO, ChurnMonitor, ContinualMetrics, DoubleDQN, transfer
from sb3_cchain.analysis import NetworkHealth
from sb3_cchain.methods import TRAC, ContinualBackprop, Oracle
from sb3_cchain.networks import InjectionPolicy, LayerNormPolicy
from tests.envs import RandomEnv

ON_POLICY = dict(n_steps=16, batch_size=8, n_epochs=1)
OFF_POLICY = dict(learning_starts=8, batch_size=8, buffer_size=100, target_update_interval=8)
ARGUMENTS = {
    PPO: ON_POLICY,
    A2C: dict(use_rms_prop=False),
    CChainPPO: dict(ON_POLICY, churn_warmup=0, churn_window=4),
    DQN: OFF_POLICY,
    DoubleDQN: OFF_POLICY,
    CChainDQN: dict(OFF_POLICY, churn_warmup=0, churn_window=4),
}
ALGORITHMS = pytest.mark.parametrize("algorithm", ARGUMENTS)
NET = dict(net_arch=[8, 6])


def trained(algorithm, env="CartPole-v1", policy="MlpPolicy", **kwargs):
    arguments = {**ARGUMENTS[algorithm], "policy_kwargs": dict(NET), "seed": 0, **kwargs}
    return algorithm(policy, env, device="cpu", **arguments).learn(64)


def snapshot(model):
    """Parameters, and the optimiser's state of each, by name."""
    policy = model.policy
    states = {name: policy.optimizer.state.get(parameter, {}) for name, parameter in policy.named_parameters()}
    return (
        {name: value.clone() for name, value in policy.state_dict().items()},
        {name: {key: th.as_tensor(value).clone() for key, value in state.items()} for name, state in states.items()},
    )


# CartPole has 4 observations and 2 actions, Acrobot 6 and 3, MountainCar 2 and 3
KEPT = {
    "ppo": {"mlp_extractor.policy_net.2.weight", "mlp_extractor.policy_net.2.bias"}
    | {"mlp_extractor.value_net.2.weight", "mlp_extractor.value_net.2.bias"},
    "dqn": {f"{net}.q_net.2.{name}" for net in ("q_net", "q_net_target") for name in ("weight", "bias")},
}


def family(algorithm):
    return "dqn" if issubclass(algorithm, DQN) else "ppo"


@ALGORITHMS
def test_the_trunk_and_its_moments_are_kept_and_the_rest_is_fresh(algorithm):
    model = trained(algorithm)
    values, moments = snapshot(model)
    kept, new = transfer(model, gym.make("Acrobot-v1"))
    assert set(kept) == KEPT[family(algorithm)]
    now, moments_now = snapshot(model)
    assert set(kept) | set(new) == set(now) and not set(kept) & set(new)
    for name in kept:
        assert now[name].equal(values[name]), name
        assert moments_now.get(name, {}).keys() == moments.get(name, {}).keys()
        for key, value in moments.get(name, {}).items():
            assert moments_now[name][key].equal(value) and value.abs().sum() > 0, (name, key)
    for name in new:
        assert now[name].shape != values[name].shape or not now[name].equal(values[name]), name
        assert not moments_now.get(name)
    assert now["q_net.q_net.0.weight" if family(algorithm) == "dqn" else "mlp_extractor.policy_net.0.weight"].shape == (8, 6)


@ALGORITHMS
def test_training_goes_on_and_the_model_is_saved(algorithm, tmp_path):
    model = trained(algorithm)
    n_updates = model._n_updates
    transfer(model, gym.make("Acrobot-v1", max_episode_steps=20))
    before, _ = snapshot(model)
    model.learn(64, reset_num_timesteps=False)
    after, _ = snapshot(model)
    assert model.num_timesteps >= 128 and model._n_updates > n_updates
    assert any(not after[name].equal(before[name]) for name in after)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=gym.make("Acrobot-v1"), device="cpu")
    values, moments = snapshot(loaded)
    assert all(values[name].equal(after[name]) for name in after)
    expected = snapshot(model)[1]
    assert {name: state.keys() for name, state in moments.items()} == {name: state.keys() for name, state in expected.items()}
    loaded.learn(32, reset_num_timesteps=False)
    assert model.predict(model.observation_space.sample())[0] in model.action_space


def test_the_same_model_learns_the_same_when_everything_fits():
    """Nothing changes where the spaces are the same and the heads are kept, but for what is said to be new."""
    model = trained(PPO)
    values, moments = snapshot(model)
    kept, new = transfer(model, gym.make("CartPole-v1"), new_heads=False)
    now, moments_now = snapshot(model)
    assert new == [] and all(now[name].equal(values[name]) for name in kept)
    assert all(moments_now[name][key].equal(value) for name, state in moments.items() for key, value in state.items())


def test_heads_are_new_even_where_they_fit():
    model = trained(PPO)
    values, _ = snapshot(model)
    _, new = transfer(model, gym.make("CartPole-v1"))
    now, moments = snapshot(model)
    assert set(new) == {f"{head}.{name}" for head in ("action_net", "value_net") for name in ("weight", "bias")}
    assert not now["action_net.weight"].equal(values["action_net.weight"]) and not moments["action_net.weight"]
    model = trained(DQN)
    _, new = transfer(model, gym.make("CartPole-v1"))
    assert set(new) == {f"{net}.q_net.4.{name}" for net in ("q_net", "q_net_target") for name in ("weight", "bias")}
    assert model.q_net.q_net[4].weight.equal(model.q_net_target.q_net[4].weight)
    assert model.q_net is model.policy.q_net and model.q_net_target is model.policy.q_net_target


def test_an_adam_step_after_it_by_hand():
    """The kept parameters go on with their moments and step count, the new ones begin with theirs."""
    model = trained(PPO)
    transfer(model, gym.make("Acrobot-v1"))
    kept, new = model.policy.mlp_extractor.policy_net[2].weight, model.policy.action_net.weight
    state = {key: value.clone() for key, value in model.policy.optimizer.state[kept].items()}
    before = kept.detach().clone(), new.detach().clone()
    model.policy.optimizer.zero_grad()
    kept.grad, new.grad = th.ones_like(kept), th.ones_like(new)
    model.policy.optimizer.step()
    step = state["step"].item() + 1
    mean = (0.9 * state["exp_avg"] + 0.1) / (1 - 0.9**step)
    square = (0.999 * state["exp_avg_sq"] + 0.001) / (1 - 0.999**step)
    assert th.allclose(before[0] - kept, 3e-4 * mean / (square.sqrt() + 1e-5), rtol=1e-3, atol=1e-7)
    assert th.allclose(before[1] - new, th.full_like(new, 3e-4), rtol=1e-3)


def test_from_discrete_to_continuous_actions_and_back():
    model = trained(PPO)
    kept, new = transfer(model, "Pendulum-v1")
    assert "log_std" in new and set(kept) == KEPT["ppo"]
    model.learn(32, reset_num_timesteps=False)
    _, new = transfer(model, gym.make("CartPole-v1"))
    assert "log_std" not in new
    model.learn(32, reset_num_timesteps=False)


def test_a_seed_makes_it_repeatable():
    outcomes = []
    for _ in range(2):
        model = trained(DQN)
        transfer(model, gym.make("Acrobot-v1"))
        model.learn(64, reset_num_timesteps=False)
        outcomes.append(snapshot(model)[0])
    assert all(outcomes[0][name].equal(outcomes[1][name]) for name in outcomes[0])
    assert model.seed == 0


def test_it_is_a_switch_of_task():
    model = CChainPPO("MlpPolicy", "CartPole-v1", device="cpu", policy_kwargs=NET, **ARGUMENTS[CChainPPO])
    metrics, oracle = ContinualMetrics(), Oracle()
    model.learn(64, callback=[metrics, oracle], reset_num_timesteps=False)
    transfer(model, gym.make("Acrobot-v1", max_episode_steps=10))
    model.learn(64, callback=[metrics, oracle], reset_num_timesteps=False)
    assert {row["task_id"] for row in model.continual_returns} == {0, 1} and oracle.n_resets == 1


def test_c_chain_starts_over():
    model = trained(CChainPPO)
    assert model.churn_reducer.coefficient.n_seen > 0
    transfer(model, gym.make("Acrobot-v1"))
    assert model.churn_reducer.coefficient.n_seen == 0
    model.learn(32, reset_num_timesteps=False)
    assert model.churn_reducer.coefficient.n_seen == 2


def test_with_callbacks_wrappers_and_other_policies():
    optimizer = dict(optimizer_class=TRAC, optimizer_kwargs={})
    model = trained(PPO, policy=LayerNormPolicy, policy_kwargs={**NET, **optimizer})
    model.learn(32, callback=[NetworkHealth(interval=1), CChainCallback()], reset_num_timesteps=False)
    kept, _ = transfer(model, gym.make("Acrobot-v1"))
    assert any("policy_net" in name for name in kept)
    parameter = dict(model.policy.named_parameters())[next(name for name in kept if name.endswith("weight"))]
    assert model.policy.optimizer.state[parameter]["step"] > 0
    model.learn(32, callback=[NetworkHealth(interval=1), CChainCallback()], reset_num_timesteps=False)


@pytest.mark.parametrize("algorithm", [PPO, DQN])
def test_churn_is_monitored_on_observations_of_the_new_environment(algorithm):
    model = trained(algorithm)
    model.learn(32, callback=ChurnMonitor(interval=1, batch_size=8), reset_num_timesteps=False)
    transfer(model, gym.make("Acrobot-v1"))
    model.learn(32, callback=ChurnMonitor(interval=1, batch_size=8), reset_num_timesteps=False)
    assert model.churn_monitor_batch["observations"].shape == (8, 6)


def test_units_that_are_new_have_not_been_used():
    model, recycling = trained(PPO), ContinualBackprop()
    model.learn(32, callback=recycling, reset_num_timesteps=False)
    former = recycling._usefulness
    model.learn(32, callback=recycling, reset_num_timesteps=False)
    assert recycling._usefulness is former
    transfer(model, gym.make("Acrobot-v1"))
    model.learn(32, callback=recycling, reset_num_timesteps=False)
    assert recycling._usefulness is not former


def test_normalised_and_several_environments():
    model = trained(PPO, env=VecNormalize(make_vec_env("CartPole-v1", 1)))
    env = VecNormalize(make_vec_env("Acrobot-v1", 3))
    transfer(model, env)
    assert model.get_vec_normalize_env() is env and model.n_envs == 3
    model.learn(96, reset_num_timesteps=False)


def test_pictures_of_another_number_of_channels():
    def pictures(channels):
        return RandomEnv(spaces.Box(0, 255, (channels, 36, 36), np.uint8))

    model = PPO("CnnPolicy", pictures(1), device="cpu", policy_kwargs=dict(net_arch=[8]), **ON_POLICY).learn(16)
    kept, new = transfer(model, pictures(3))
    assert "features_extractor.cnn.0.weight" in new and "features_extractor.cnn.2.weight" in kept
    assert model.policy.features_extractor.cnn[2].weight in model.policy.optimizer.state
    model.learn(16, reset_num_timesteps=False)


@pytest.mark.parametrize(
    "make_model, env, error, message",
    [
        (
            lambda: SAC("MlpPolicy", "Pendulum-v1", buffer_size=100),
            "CartPole-v1",
            TypeError,
            "`model` must be of PPO, A2C, DQN .* got SAC",
        ),
        (lambda: trained(DQN), "Pendulum-v1", ValueError, r"DQN needs actions that are Discrete, `env` has Box\("),
        (
            lambda: trained(PPO, policy_kwargs=dict(net_arch=[8])),
            "Acrobot-v1",
            ValueError,
            r"No layer before the heads can be kept.*policy_net.0.weight \(8, 4\) and \(8, 6\)",
        ),
        (
            lambda: PPO("MlpPolicy", "Pendulum-v1", use_sde=True, **ON_POLICY),
            "CartPole-v1",
            ValueError,
            "PPO was made with `use_sde=True`, which needs Box actions",
        ),
        (
            lambda: PPO(InjectionPolicy, "CartPole-v1", **ON_POLICY),
            "CartPole-v1",
            TypeError,
            r"transfer\(\) does not know heads for plasticity injection, got InjectionPolicy",
        ),
        (
            lambda: PPO("MlpPolicy", "CartPole-v1", **ON_POLICY),
            RandomEnv(spaces.Dict(a=spaces.Box(0, 1, (2,)))),
            ValueError,
            "A policy is either for a Dict or for a single array",
        ),
        (
            lambda: PPO("CnnPolicy", RandomEnv(spaces.Box(0, 255, (3, 36, 36), np.uint8)), **ON_POLICY),
            "CartPole-v1",
            ValueError,
            "CnnPolicy cannot be made for the observations Box",
        ),
    ],
)
def test_what_does_not_fit_leaves_the_model_as_it_was(make_model, env, error, message):
    model = make_model()
    before, values = dict(vars(model)), {name: value.clone() for name, value in model.policy.state_dict().items()}
    with pytest.raises(error, match=message):
        transfer(model, gym.make(env) if isinstance(env, str) else env)
    assert vars(model).keys() == before.keys() and all(vars(model)[name] is before[name] for name in before)
    assert all(value.equal(values[name]) for name, value in model.policy.state_dict().items())
    model.learn(32, reset_num_timesteps=False)


def test_new_heads_must_be_a_boolean():
    with pytest.raises(TypeError, match="`new_heads` must be True or False, got 'yes'"):
        transfer(trained(PPO), gym.make("CartPole-v1"), new_heads="yes")
