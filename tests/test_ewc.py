"""Elastic weight consolidation: the penalty, the Fisher information, and what happens at a switch."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import A2C, DQN, PPO, SAC, TD3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_cchain import CChainDQN, CChainPPO, TaskSync
from sb3_cchain.methods import EWC, EWCConsolidation, L2Init
from tests.envs import RandomEnv
from tests.method_models import OFF_POLICY, ON_POLICY, STEPS_PER_TASK, go_on, make_env, make_model, parameters

STATES = np.array([[1.0, 2.0, -1.0, 0.0], [3.0, 0.0, -1.0, 0.0]], dtype=np.float32)
SQUARES = [5, 2, 1, 0]  # their mean


def policy_kwargs(net_arch=(8,), **kwargs):
    return dict(net_arch=list(net_arch), optimizer_class=EWC, optimizer_kwargs=kwargs)


def test_the_penalty_by_hand():
    parameter, frozen = nn.Parameter(th.tensor([1.0, 2.0])), nn.Parameter(th.ones(1), requires_grad=False)
    optimizer = EWC([parameter, frozen], lr=0.1, coef=3.0, decay=0.5, base_class=th.optim.SGD)
    optimizer.zero_grad()
    assert parameter.grad is None and optimizer.metrics() == {"ewc/loss": 0}
    optimizer.consolidate([th.tensor([2.0, 0.5]), th.zeros(1)])
    with th.no_grad():
        parameter.add_(th.tensor([1.0, 2.0]))
    optimizer.zero_grad()
    assert parameter.grad.tolist() == [6, 3]  # 3 F (θ - θ*)
    assert frozen.grad is None
    assert optimizer.metrics() == {"ewc/loss": 6}  # 3/2 · (2 · 1² + 0.5 · 2²)
    optimizer.step()
    assert parameter.tolist() == pytest.approx([1.4, 3.7])
    optimizer.consolidate([th.tensor([1.0, 1.0]), th.zeros(1)])
    optimizer.zero_grad()
    assert parameter.grad.tolist() == [0, 0]
    assert optimizer.own_state["fisher"][0].tolist() == [2, 1.25]


def consolidate(model, states, **kwargs):
    """The Fisher information by name."""
    callback = EWCConsolidation(**kwargs)
    callback.init_callback(model)
    callback._consolidate(states)
    found = {}
    for optimizer in callback._optimizers():
        found |= dict(zip(map(id, optimizer.parameters()), optimizer.own_state["fisher"], strict=True))
    return {name: found[id(p)] for name, p in model.policy.named_parameters() if id(p) in found}


@pytest.mark.parametrize("algorithm", [DQN, CChainDQN])
def test_of_a_linear_q_network_by_hand(algorithm):
    model = algorithm("MlpPolicy", RandomEnv(), device="cpu", **{**OFF_POLICY, "policy_kwargs": policy_kwargs([])})
    fisher = consolidate(model, STATES)
    assert fisher["q_net.q_net.0.weight"].tolist() == [SQUARES] * 3
    assert fisher["q_net.q_net.0.bias"].tolist() == [1, 1, 1]
    assert not any("target" in name for name in fisher)


@pytest.mark.parametrize("values", [True, False])
@pytest.mark.parametrize("algorithm", [PPO, CChainPPO])
def test_of_a_linear_policy_by_hand(algorithm, values):
    env = RandomEnv(action_space=spaces.Discrete(2))
    model = algorithm("MlpPolicy", env, device="cpu", **{**ON_POLICY, "policy_kwargs": policy_kwargs([])})
    for parameter in model.policy.action_net.parameters():
        nn.init.zeros_(parameter)
    fisher = consolidate(model, STATES, values=values)
    # Of two actions of probability 1/2: (1 - 1/2)² for the one drawn, (0 - 1/2)² for the other
    assert fisher["action_net.weight"].tolist() == [[square / 4 for square in SQUARES]] * 2
    assert fisher["action_net.bias"].tolist() == [0.25, 0.25]
    assert fisher["value_net.weight"].tolist() == [SQUARES if values else [0, 0, 0, 0]]
    assert fisher["value_net.bias"].tolist() == [float(values)]


def test_of_a_gaussian_policy():
    """1 / σ² for the mean, 2 for log σ."""
    env = RandomEnv(action_space=spaces.Box(-1, 1, (1,)))
    kwargs = dict(**policy_kwargs([]), log_std_init=np.log(0.5))
    model = A2C("MlpPolicy", env, device="cpu", seed=0, policy_kwargs=kwargs)
    fisher = consolidate(model, STATES[[0] * 1000])
    assert fisher["action_net.bias"].item() == pytest.approx(4, rel=0.15)
    assert fisher["log_std"].item() == pytest.approx(2, rel=0.3)


def test_of_sac():
    env = RandomEnv(action_space=spaces.Box(-1, 1, (1,)))
    model = SAC("MlpPolicy", env, device="cpu", seed=0, **{**OFF_POLICY, "policy_kwargs": policy_kwargs([])})
    nn.init.zeros_(model.actor.log_std.weight)
    nn.init.constant_(model.actor.log_std.bias, np.log(0.5))
    fisher = consolidate(model, STATES[[0] * 1000], n_samples=1000)
    assert fisher["actor.mu.bias"].item() == pytest.approx(4, rel=0.2)
    assert fisher["actor.log_std.bias"].item() == pytest.approx(2, rel=0.3)
    for critic in ("qf0", "qf1"):
        assert fisher[f"critic.{critic}.0.weight"][0, :4].tolist() == [1, 4, 1, 0]
        assert fisher[f"critic.{critic}.0.bias"].tolist() == [1]


def test_of_sac_with_gsde():
    """The distribution of the actions: its variance is 2 σ² for two features of 1."""
    env = RandomEnv(action_space=spaces.Box(-1, 1, (1,)))
    kwargs = dict(**policy_kwargs([2]), log_std_init=np.log(0.5))
    model = SAC("MlpPolicy", env, device="cpu", seed=0, use_sde=True, **{**OFF_POLICY, "policy_kwargs": kwargs})
    nn.init.zeros_(model.actor.latent_pi[0].weight)
    nn.init.ones_(model.actor.latent_pi[0].bias)
    nn.init.zeros_(model.actor.mu[0].weight)
    fisher = consolidate(model, STATES[[0] * 1000], n_samples=1000)
    assert fisher["actor.mu.0.bias"].item() == pytest.approx(1 / (2 * 0.5**2), rel=0.2)


class Spy(EWCConsolidation):
    def _consolidate(self, observations):
        self.seen = [*getattr(self, "seen", []), observations]
        super()._consolidate(observations)


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("algorithm", [PPO, CChainPPO, DQN, CChainDQN])
def test_at_each_switch_with_observations_of_the_task_that_ended(algorithm, n_envs):
    settings = OFF_POLICY if issubclass(algorithm, DQN) else ON_POLICY
    settings = {**settings, "policy_kwargs": policy_kwargs(coef=10.0)}
    env = make_vec_env(make_env, n_envs)
    model = algorithm("MlpPolicy", env, device="cpu", seed=0, **settings)
    spy = Spy(n_samples=10)
    model.learn(3 * STEPS_PER_TASK, callback=[TaskSync(), spy], log_interval=1000)
    assert spy.n_tasks == 2 and model.logger.name_to_value["ewc/n_tasks"] == 2
    for task, observations in enumerate(spy.seen):
        # CountEnv observes the task, and up to 0.1 more
        assert len(observations) == 10 and ((observations >= task) & (observations <= task + 0.1)).mean() >= 0.9
    assert model.policy.optimizer.metrics()["ewc/loss"] > 0
    assert model.ewc_task_start == 2 * STEPS_PER_TASK


@pytest.mark.parametrize("algorithm", ["PPO", "DQN", "CChainPPO", "CChainDQN"])
def test_without_coefficient_it_is_plain_training(algorithm):
    ends = []
    eps = {} if "DQN" in algorithm else dict(eps=1e-5)
    with_ewc = policy_kwargs(coef=0, base_kwargs=eps)
    for arguments, callback in ((dict(policy_kwargs=with_ewc), [TaskSync(), EWCConsolidation()]), ({}, [TaskSync()])):
        ends.append(parameters(make_model(algorithm, **arguments).learn(2 * STEPS_PER_TASK + 16, callback=callback)))
    assert all(th.equal(p, ends[1][name]) for name, p in ends[0].items())


@pytest.mark.parametrize("algorithm", ["PPO", "DQN", "CChainPPO", "CChainDQN"])
def test_saved_and_loaded_goes_on_with_the_penalty(tmp_path, algorithm):
    inside = dict(coef=0.1, base_class=EWC, base_kwargs=dict(coef=50.0))  # it is found inside another one, too
    model = make_model(algorithm, policy_kwargs=dict(net_arch=[8], optimizer_class=L2Init, optimizer_kwargs=inside))
    model.learn(STEPS_PER_TASK + 16, callback=[TaskSync(), callback := EWCConsolidation()])
    assert callback.n_tasks == 1
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", env=make_env(), device="cpu")
    if isinstance(model, DQN):
        model.save_replay_buffer(tmp_path / "buffer")
        loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.policy.optimizer.metrics() == model.policy.optimizer.metrics() != {"ewc/loss": 0}
    for each in (model, loaded):
        each.env.env_method("set_clock", 1, 1)
        go_on(each, [TaskSync(), EWCConsolidation()])
    assert all(map(th.equal, model.policy.parameters(), loaded.policy.parameters()))
    assert model.ewc_task_start == loaded.ewc_task_start


def test_it_keeps_what_mattered():
    """The stronger, the nearer the parameters stay to those at the last switch."""
    distances = []
    for coef in (0.0, 100.0, 10_000.0):
        model = make_model("PPO", policy_kwargs=policy_kwargs(coef=coef), learning_rate=0.01, n_epochs=20)
        model.learn(2 * STEPS_PER_TASK, callback=[TaskSync(), EWCConsolidation()])
        model.policy.optimizer.coef = 1.0
        distances.append(model.policy.optimizer.metrics()["ewc/loss"])
    assert distances[0] > 2 * distances[1] > 4 * distances[2]


def test_without_observations_the_log_says_so(capsys):
    model = make_model("PPO", policy_kwargs=policy_kwargs()).learn(STEPS_PER_TASK, callback=TaskSync())
    model.trained_task_id = 0
    model.verbose = 1
    callback = EWCConsolidation()
    model.learn(16, callback=[TaskSync(), callback], reset_num_timesteps=False)
    assert callback.n_tasks == 0
    assert "EWCConsolidation has no observation of the task that ended" in capsys.readouterr().out


def test_what_it_refuses():
    for cls, argument, value in [(EWC, "coef", -1), (EWC, "decay", 1.5), (EWCConsolidation, "n_samples", 0)]:
        arguments = [[nn.Parameter(th.ones(2))]] if cls is EWC else []
        with pytest.raises(ValueError, match=f"`{argument}` must be .* got {value!r}"):
            cls(*arguments, **{argument: value})
    with pytest.raises(TypeError, match="`values` must be True or False, got 1"):
        EWCConsolidation(values=1)
    with pytest.raises(TypeError, match=r"needs the optimiser EWC, .* got Adam"):
        make_model("PPO").learn(10, callback=EWCConsolidation())
    with pytest.raises(ValueError, match="`values` must be True for DQN, got False"):
        make_model("DQN", policy_kwargs=policy_kwargs()).learn(10, callback=EWCConsolidation(values=False))
    with pytest.raises(TypeError, match=r"EWCConsolidation is for PPO, A2C, DQN and SAC, got TD3"):
        TD3("MlpPolicy", RandomEnv(action_space=spaces.Box(-1, 1, (1,))), buffer_size=10).learn(
            10, callback=EWCConsolidation()
        )
    with pytest.raises(TypeError, match="the training environment is not one"):
        PPO("MlpPolicy", RandomEnv(), policy_kwargs=policy_kwargs(), device="cpu").learn(10, callback=EWCConsolidation())


def test_replayed_observations_are_normalised():
    env, seen = VecNormalize(make_vec_env(make_env, 1)), []

    class Look(Spy):
        def _consolidate(self, observations):
            raw = self.model.replay_buffer.observations[self.num_timesteps - 1, 0]
            seen.append((observations[-1], env.normalize_obs(raw)))

    model = DQN("MlpPolicy", env, device="cpu", seed=0, **{**OFF_POLICY, "policy_kwargs": policy_kwargs()})
    model.learn(STEPS_PER_TASK + 8, callback=[TaskSync(), Look(n_samples=4)])
    assert len(seen) == 1 and np.allclose(*seen[0])
