"""Churn is logged, and looking at it changes nothing."""

from copy import deepcopy
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from rl_zoo3.utils import get_class_by_name
from sb3_contrib import ARS, QRDQN, TQC, TRPO, CrossQ, MaskablePPO, RecurrentPPO
from sb3_contrib.common.wrappers import ActionMasker
from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_cchain import CChainDQN, CChainPPO, ChurnMonitor
from sb3_cchain.networks.model_optimizers import model_optimizers
from tests.envs import RandomEnv

BOX = spaces.Box(-2, 2, (2,), np.float32)
DICT = spaces.Dict({"a": spaces.Box(-1, 1, (2,), np.float32), "b": spaces.Discrete(3)})
POLICY, VALUE, GREEDY = "policy_churn", "value_churn", "greedy_action_changes"


def make(algorithm, env=None, policy="MlpPolicy", **settings):
    env = env or RandomEnv(None, None if algorithm in DISCRETE else BOX)
    settings = dict(
        OFF_POLICY if algorithm in (*CONTINUOUS, DQN, QRDQN, CChainDQN) else ON_POLICY.get(algorithm, {}), **settings
    )
    settings = {"seed": 0, "device": "cpu", "policy_kwargs": dict(net_arch=[8]), **settings}
    return algorithm(policy, env, **settings)


CONTINUOUS = (SAC, TD3, DDPG, TQC, CrossQ)
DISCRETE = (PPO, CChainPPO, A2C, DQN, CChainDQN, QRDQN, TRPO, MaskablePPO, RecurrentPPO)
OFF_POLICY = dict(learning_starts=8, buffer_size=100, batch_size=8, train_freq=1)
PPO_SETTINGS = dict(n_steps=16, batch_size=4, n_epochs=2)
ON_POLICY = {
    **dict.fromkeys([PPO, CChainPPO, MaskablePPO, RecurrentPPO], PPO_SETTINGS),
    TRPO: dict(n_steps=16, batch_size=8),
    A2C: dict(n_steps=16),
    ARS: dict(n_delta=2),
}


def masked(env):
    return ActionMasker(env, lambda env: np.array([True, False, True]))


# With what each shall log
MODELS = {
    "PPO": (lambda: make(PPO), {POLICY, VALUE, GREEDY}),
    "PPO continuous": (lambda: make(PPO, RandomEnv(None, BOX), use_sde=True), {POLICY, VALUE}),
    "PPO multi-discrete": (lambda: make(PPO, RandomEnv(None, spaces.MultiDiscrete([2, 3]))), {POLICY, VALUE, GREEDY}),
    "PPO dict": (lambda: make(PPO, RandomEnv(DICT), "MultiInputPolicy"), {POLICY, VALUE, GREEDY}),
    "CChainPPO": (lambda: make(CChainPPO), {POLICY, VALUE, GREEDY}),
    "A2C": (lambda: make(A2C), {POLICY, VALUE, GREEDY}),
    "TRPO": (lambda: make(TRPO), {POLICY, VALUE, GREEDY}),
    "TRPO continuous": (lambda: make(TRPO, RandomEnv(None, BOX)), {POLICY, VALUE}),
    "MaskablePPO": (lambda: make(MaskablePPO, masked(RandomEnv())), {POLICY, VALUE, GREEDY}),
    "RecurrentPPO": (
        lambda: make(RecurrentPPO, policy="MlpLstmPolicy", policy_kwargs=dict(lstm_hidden_size=8)),
        {POLICY, VALUE, GREEDY},
    ),
    "DQN": (lambda: make(DQN), {VALUE, GREEDY}),
    "DQN dict": (lambda: make(DQN, RandomEnv(DICT), "MultiInputPolicy"), {VALUE, GREEDY}),
    "CChainDQN": (lambda: make(CChainDQN), {VALUE, GREEDY}),
    "QRDQN": (lambda: make(QRDQN), {VALUE, GREEDY}),
    **{algorithm.__name__: (lambda algorithm=algorithm: make(algorithm), {POLICY, VALUE}) for algorithm in CONTINUOUS},
    "ARS": (lambda: make(ARS), {POLICY}),
    "ARS discrete": (lambda: make(ARS, RandomEnv()), {GREEDY}),
}


class Idle(BaseCallback):
    def _on_step(self):
        return True


class Spy(Idle):
    """What was logged, before it is written."""

    def _on_training_end(self):
        self.logged = {name: value for name, value in self.logger.name_to_value.items() if name.startswith("churn_monitor/")}


def logged(model, n_steps, *callbacks):
    """Of a training that writes no log."""
    spy = Spy()
    model.learn(n_steps, callback=[*callbacks, spy], log_interval=None, reset_num_timesteps=False)
    return spy.logged


@pytest.mark.parametrize("name", MODELS)
def test_every_algorithm_logs_what_it_has_and_trains_as_without(name):
    make_it, names = MODELS[name]
    n_steps = 120 if name.startswith("ARS") else 40
    states = []
    for callbacks in ([], [ChurnMonitor(interval=4, n_updates=3, batch_size=32)]):
        model = make_it()
        values = logged(model, n_steps, *callbacks)
        random_numbers = np.random.random(), th.rand(()).item()
        states.append((model.policy.state_dict(), random_numbers, model._last_obs))
        # Nothing stays behind
        assert not any(optimizer._optimizer_step_pre_hooks for optimizer in model_optimizers(model).values())
        assert "step_wait" not in vars(model.env)
    assert set(values) == {f"churn_monitor/{batch}/{name}" for batch in ("fixed", "fresh") for name in names}
    assert all(value > 0 for key, value in values.items() if GREEDY not in key), values
    (without, numbers_without, last_without), (with_monitor, numbers, last) = states
    assert without.keys() == with_monitor.keys() and all(th.equal(without[key], with_monitor[key]) for key in without)
    assert numbers == numbers_without
    assert str(last) == str(last_without)


class Snapshots(Idle):
    """The policy before each update, and after the last of each train()."""

    def _on_training_start(self):
        self.trained = []

    def _on_rollout_end(self):
        self.policies = []
        self.buffer, self.template = deepcopy((self.model.rollout_buffer, self.model.policy))
        self.hook = self.model.policy.optimizer.register_step_pre_hook(self.keep)

    def keep(self, *_):
        self.policies.append(deepcopy(self.template))
        self.policies[-1].load_state_dict(self.model.policy.state_dict())

    def _on_rollout_start(self):
        if hasattr(self, "hook"):
            self.hook.remove()
            self.keep()
            self.trained.append((self.policies, self.buffer))

    def _on_training_end(self):
        self._on_rollout_start()


def expected_churn(old, new, observations):
    observations = th.as_tensor(observations)
    with th.no_grad():
        (p, v), (q, w) = (
            (policy.get_distribution(observations).distribution, policy.predict_values(observations)) for policy in (old, new)
        )
    return {
        POLICY: (p.probs.double() * (p.probs.double().log() - q.probs.double().log())).sum(dim=1).mean().item(),
        VALUE: (v - w).abs().mean().item(),
        GREEDY: (p.probs.argmax(dim=1) != q.probs.argmax(dim=1)).float().mean().item(),
    }


# Of 8 updates: from where to where a window goes
@pytest.mark.parametrize(
    "interval, n_updates, windows",
    [
        (1, 1, [(i, i + 1) for i in range(8)]),
        (3, 1, [(0, 1), (3, 4), (6, 7)]),
        (4, 3, [(0, 3), (4, 7)]),
        (4, 4, [(0, 4), (4, 8)]),
        (7, 1, [(0, 1), (7, 8)]),
    ],
)
def test_the_values_are_those_of_copies_of_the_network(interval, n_updates, windows):
    model, snapshots = make(PPO, learning_rate=0.05), Snapshots()
    # The fresh batch is the whole rollout
    values = logged(model, 16, ChurnMonitor(interval, n_updates, batch_size=16), snapshots)
    ((policies, buffer),) = snapshots.trained
    assert len(policies) == 9
    batches = {"fixed": model.churn_monitor_batch["observations"], "fresh": buffer.observations[:, 0]}
    assert np.array_equal(*(np.sort(batch, axis=0) for batch in batches.values()))
    for name, batch in batches.items():
        expected = [expected_churn(policies[old], policies[new], batch) for old, new in windows]
        for churn in (POLICY, VALUE, GREEDY):
            mean = np.mean([window[churn] for window in expected])
            assert values[f"churn_monitor/{name}/{churn}"] == pytest.approx(mean, rel=1e-3, abs=1e-8), (name, churn)
        assert expected[0][POLICY] > 1e-5


def test_the_fresh_batch_is_of_the_rollout_and_the_fixed_one_of_the_first():
    model, monitor, snapshots = make(PPO, learning_rate=0.05), ChurnMonitor(interval=8, batch_size=64), Snapshots()
    values = logged(model, 32, monitor, snapshots)
    first, second = (buffer.observations[:, 0] for _, buffer in snapshots.trained)
    changes = [[expected_churn(*policies[:2], batch) for policies, _ in snapshots.trained] for batch in (first, second)]
    assert values["churn_monitor/fixed/value_churn"] == pytest.approx(np.mean([c[VALUE] for c in changes[0]]), rel=1e-4)
    fresh = np.mean([changes[0][0][VALUE], changes[1][1][VALUE]])
    assert values["churn_monitor/fresh/value_churn"] == pytest.approx(fresh, rel=1e-4)


def test_the_phase_goes_on_over_trainings():
    """Of 8 updates each: windows begin at 0, 5 and 10."""
    model, monitor, snapshots = make(PPO, learning_rate=0.05), ChurnMonitor(interval=5), Snapshots()
    for windows in ([(0, 1), (5, 6)], [(2, 3), (7, 8)]):
        values = logged(model, 16, monitor, snapshots)
        policies, _ = snapshots.trained[-1]
        expected = [expected_churn(policies[i], policies[j], model.churn_monitor_batch["observations"]) for i, j in windows]
        assert values["churn_monitor/fixed/value_churn"] == pytest.approx(np.mean([e[VALUE] for e in expected]), rel=1e-4)


class Shake(Idle):
    """Changes the network between two calls of train()."""

    def _on_rollout_start(self):
        with th.no_grad():
            for parameter in self.model.policy.parameters():
                parameter.add_(0.1)


@pytest.mark.parametrize("algorithm", [PPO, DQN, SAC])
def test_what_others_do_between_two_trainings_is_no_churn(algorithm):
    model = make(algorithm, learning_rate=0.0)
    values = logged(model, 40, ChurnMonitor(interval=1), Shake())
    assert values and not any(values.values())


def test_an_update_of_actor_and_critic_is_of_both():
    model = make(TD3, policy_delay=2, learning_rate=0.01)
    monitor = ChurnMonitor(interval=2)
    # The actor follows in the second of two updates, whose windows are left out
    values = logged(model, 40, monitor)
    assert values["churn_monitor/fixed/policy_churn"] == 0 and values["churn_monitor/fixed/value_churn"] > 0
    model = make(TD3, policy_delay=2, learning_rate=0.01)
    assert logged(model, 40, ChurnMonitor(interval=2, n_updates=2))["churn_monitor/fixed/policy_churn"] > 0


def test_windows_over_several_trainings():
    """One update per train(): windows of 3 of 12 updates, in DQN."""
    model, policies = make(DQN, learning_rate=0.01), []

    class Keep(Idle):
        def _on_rollout_start(self):
            if not policies or self.model._n_updates == len(policies):
                policies.append(deepcopy(self.model.q_net))

    values = logged(model, 20, ChurnMonitor(interval=5, n_updates=3), Keep())
    assert model._n_updates == 12 and len(policies) == 12
    policies.append(model.q_net)
    observations = th.as_tensor(model.churn_monitor_batch["observations"])
    with th.no_grad():
        outputs = [q_net(observations) for q_net in policies]
    # The third begins before the eleventh update and is not over
    expected = np.mean([(outputs[j] - outputs[i]).abs().mean() for i, j in ((0, 3), (5, 8))])
    assert values["churn_monitor/fixed/value_churn"] == pytest.approx(expected, rel=1e-4)


def test_trpo_is_measured_over_all_of_its_training():
    """The policy's step, which no optimiser makes, and those of the value function."""
    model, snapshots = make(TRPO, learning_rate=0.05), Snapshots()
    before = deepcopy(model.policy)
    values = logged(model, 16, ChurnMonitor(batch_size=16), snapshots)
    expected = expected_churn(before, model.policy, model.churn_monitor_batch["observations"])
    for name, value in expected.items():
        assert values[f"churn_monitor/fixed/{name}"] == pytest.approx(value, rel=1e-3), name


def test_ars_is_measured_on_the_observations_of_its_candidates():
    model, seen = make(ARS), []
    step_wait = model.env.step_wait

    def keep_step_wait():
        step = step_wait()
        seen.append(step[0][0].copy())
        return step

    model.env.step_wait = keep_step_wait
    before = deepcopy(model.policy)
    values = logged(model, 30, ChurnMonitor(batch_size=16))
    assert len(seen) == 40  # one iteration: 2 · 2 candidates with an episode each
    assert np.array_equal(model.churn_monitor_batch["observations"], seen[-16:])
    observations = th.as_tensor(np.array(seen[-16:]))
    with th.no_grad():
        expected = (before(observations) - model.policy(observations)).square().mean().item()
    assert values == {f"churn_monitor/{batch}/policy_churn": pytest.approx(expected, rel=1e-4) for batch in ("fixed", "fresh")}


def test_ars_elsewhere_is_not_seen():
    with pytest.raises(ValueError, match="async_eval"):
        make(ARS).learn(30, callback=ChurnMonitor(), async_eval=SimpleNamespace())


@pytest.mark.parametrize("algorithm", [PPO, CChainPPO, SAC, DQN])
def test_training_that_is_resumed_has_the_same_fixed_batch(algorithm, tmp_path):
    class Save(Idle):
        def _on_rollout_end(self):  # where the optimiser has its hook
            if self.num_timesteps == 32:
                self.model.save(tmp_path / "model")
                deepcopy(self.model.policy)

    model = make(algorithm)
    model.learn(48, callback=[ChurnMonitor(interval=3, batch_size=12), Save()])
    batch = model.churn_monitor_batch
    assert len(batch["observations"]) == 12 and ("actions" in batch) == (algorithm in (SAC, DQN))
    resumed = algorithm.load(tmp_path / "model", env=model.env)
    assert not any(optimizer._optimizer_step_pre_hooks for optimizer in model_optimizers(resumed).values())
    resumed.learn(32, callback=ChurnMonitor(interval=3, batch_size=32), reset_num_timesteps=False)
    assert resumed.churn_monitor_batch.keys() == batch.keys()
    assert all(np.array_equal(resumed.churn_monitor_batch[name], batch[name]) for name in batch)


def test_a_hook_is_there_in_train_alone():
    model, monitor, n_hooks = make(PPO), ChurnMonitor(), []

    class Look(Idle):
        def _on_rollout_start(self):
            n_hooks.append(len(self.model.policy.optimizer._optimizer_step_pre_hooks))

        def _on_step(self):
            n_hooks.append(len(self.model.policy.optimizer._optimizer_step_pre_hooks))
            return self.num_timesteps < 20

    model.learn(32, callback=[monitor, Look()])
    assert len(n_hooks) == 22 and not any(n_hooks)

    def fail(*_):
        raise RuntimeError("no update")

    hook = model.policy.optimizer.register_step_pre_hook(fail)
    with pytest.raises(RuntimeError, match="no update"):
        model.learn(16, callback=monitor)
    hook.remove()
    model.learn(16, callback=monitor)
    assert not model.policy.optimizer._optimizer_step_pre_hooks


@pytest.mark.parametrize("algorithm", [PPO, DQN])
def test_observations_are_normalised_as_the_networks_get_them(algorithm):
    far = spaces.Box(100, 102, (4,), np.float32)
    env = VecNormalize(make_vec_env(lambda: RandomEnv(far), n_envs=2))
    model = make(algorithm, env)
    model.learn(64, callback=ChurnMonitor())
    assert np.abs(model.churn_monitor_batch["observations"]).max() < 5


def test_dropout_is_no_churn():
    class Dropout(nn.Sequential):
        def __init__(self):
            super().__init__(nn.Tanh(), nn.Dropout(0.5))

    model = make(PPO, learning_rate=0.0, policy_kwargs=dict(net_arch=[8], activation_fn=Dropout))
    values = logged(model, 16, ChurnMonitor(interval=1))
    assert values and not any(values.values())


def test_the_fresh_batch_is_not_the_next_minibatch():
    model, samples = make(DQN), []

    class Watch(Idle):
        def _on_training_start(self):
            sample = self.model.replay_buffer.sample

            def sample_and_keep(batch_size, env=None):
                samples.append(sample(batch_size, env=env))
                return samples[-1]

            self.model.replay_buffer.sample = sample_and_keep

    model.learn(40, callback=[ChurnMonitor(interval=3, batch_size=16), Watch()])
    sizes = [len(sample.observations) for sample in samples]
    assert sizes[:6] == [8, 16, 16, 8, 8, 8]  # with the fixed batch at first
    for fresh, minibatch in pairwise(samples):
        if (len(fresh.observations), len(minibatch.observations)) == (16, 8):
            assert not th.equal(fresh.observations[:8], minibatch.observations)
    assert not th.equal(samples[1].observations, samples[2].observations)


def test_it_is_reached_from_yaml():
    assert get_class_by_name("sb3_cchain.ChurnMonitor") is ChurnMonitor


@pytest.mark.parametrize(
    "arguments, message",
    [
        (dict(interval=0), "`interval` must be an integer greater than or equal to 1, got 0"),
        (dict(n_updates=0), "`n_updates` must be an integer between 1 and 101, got 0"),
        (dict(interval=3, n_updates=4), "`n_updates` must be an integer between 1 and 3, got 4"),
        (dict(batch_size=0.5), "`batch_size` must be an integer greater than or equal to 1, got 0.5"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        ChurnMonitor(**arguments)


def test_of_an_unknown_algorithm():
    model = make(PPO)
    model.policy = nn.Identity()
    with pytest.raises(TypeError, match="outputs of PPO with Identity are not known"):
        ChurnMonitor().init_callback(model)
