"""Shrink-and-perturb."""

from functools import partial

import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cchain import ContinualEnv, TaskSync
from sb3_cchain.methods import ShrinkAndPerturb
from sb3_cchain.methods import shrink_and_perturb as module
from tests.envs import CountEnv, RandomEnv
from tests.method_models import ALGORITHMS, STEPS_PER_TASK, make_model, make_random_env, parameters


class Spy(BaseCallback):
    def __init__(self):
        super().__init__()
        self.seen = {}

    def _on_step(self):
        return True

    def _on_rollout_start(self):
        self.seen[self.model.num_timesteps] = parameters(self.model)


@pytest.fixture
def draws(monkeypatch):
    """The fresh policies that were built."""
    built = []
    fresh_policy = module.fresh_policy
    monkeypatch.setattr(module, "fresh_policy", lambda model: built.append(fresh_policy(model)) or built[-1])
    return built


@pytest.mark.parametrize("name", ALGORITHMS)
def test_by_hand_at_a_switch(name, draws):
    """With a learning rate of 0 nothing else moves the parameters."""
    spy = Spy()
    model = make_model(name, learning_rate=0.0, target_update_interval=10_000) if "DQN" in name else make_model(name)
    if "DQN" not in name:
        model.lr_schedule = lambda _: 0.0
    model.learn(3 * STEPS_PER_TASK, callback=[ShrinkAndPerturb(shrink=0.75, interval=None), spy])
    assert len(draws) == 2
    theta = spy.seen[0]
    for task, draw in enumerate(draws, start=1):
        phi = dict(draw.named_parameters())
        for key, tensor in spy.seen[task * STEPS_PER_TASK].items():
            expected = theta[key] if "target" in key else 0.75 * theta[key] + 0.25 * phi[key]
            assert th.allclose(tensor, expected, rtol=1e-6, atol=1e-7), key
            assert th.equal(tensor, spy.seen[task * STEPS_PER_TASK + 16][key])
        theta = spy.seen[task * STEPS_PER_TASK]
    key = "q_net.q_net.0.weight" if "DQN" in name else "action_net.weight"
    first, second = (draw.get_parameter(key) for draw in draws)
    assert not th.equal(first, second)


@pytest.mark.parametrize("name, n_steps, n_updates", [("PPO", 48, 3 * 4), ("CChainPPO", 48, 3 * 4), ("CChainDQN", 20, 12)])
@pytest.mark.parametrize("interval", [1, 5])
def test_counts_updates(name, n_steps, n_updates, interval, draws):
    callback = ShrinkAndPerturb(interval=interval)
    model = make_model(name, env=make_random_env())
    model.learn(n_steps, callback=callback)
    assert callback.n_steps == len(draws) == n_updates // interval
    # Nothing stays hooked
    model.learn(n_steps)
    assert callback.n_steps == n_updates // interval


def test_the_interval_goes_on_in_further_calls_of_learn(draws):
    callback, model = ShrinkAndPerturb(interval=5), make_model("PPO", env=make_random_env())
    for _ in range(3):  # of 4 updates each
        model.learn(16, callback=callback, reset_num_timesteps=False)
    assert len(draws) == 12 // 5
    model.learn(48, callback=callback)  # a training of its own
    assert len(draws) == 2 * (12 // 5)


def test_after_each_update_by_hand(draws):
    model = make_model("PPO", env=make_random_env(), n_epochs=1)
    model.lr_schedule = lambda _: 0.0
    expected = parameters(model)
    model.learn(32, callback=ShrinkAndPerturb(shrink=0.5, interval=1))
    assert len(draws) == 4
    for draw in draws:
        expected = {key: 0.5 * expected[key] + 0.5 * phi for key, phi in draw.named_parameters()}
    for key, parameter in model.policy.named_parameters():
        assert th.allclose(parameter, expected[key], rtol=1e-5, atol=1e-7), key


def test_interrupted_training_leaves_one_hook():
    callback = ShrinkAndPerturb(interval=1)
    model = make_model("PPO", env=make_random_env())

    class Interrupt(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 20:
                raise KeyboardInterrupt
            return True

    with pytest.raises(KeyboardInterrupt):
        model.learn(48, callback=[callback, Interrupt()])
    model.learn(16, callback=callback)
    assert callback.n_steps == 4


def test_c_chain_forgets_at_a_switch():
    remembered = []

    class SpyReducer(Spy):
        def _on_rollout_start(self):
            remembered.append(self.model.churn_reducer.reference is not None)

    callback = ShrinkAndPerturb(shrink=0.5, interval=None)
    make_model("CChainPPO").learn(3 * STEPS_PER_TASK, callback=[callback, SpyReducer()])
    assert remembered == [False, True] + [False, True] * 2
    remembered.clear()
    make_model("CChainPPO").learn(3 * STEPS_PER_TASK, callback=[ShrinkAndPerturb(interval=4), SpyReducer()])
    assert remembered == [False] + [True] * 5


def test_what_it_refuses():
    for argument, value in [("shrink", 1.5), ("shrink", -0.1), ("interval", 0), ("interval", 2.5)]:
        with pytest.raises(ValueError, match=f"`{argument}` must be .* got {value}"):
            ShrinkAndPerturb(**{argument: value})
    with pytest.raises(TypeError, match="the training environment is not one"):
        make_model("PPO", env=CountEnv()).learn(10, callback=ShrinkAndPerturb(interval=None))
    box = RandomEnv(action_space=spaces.Box(-1, 1, (2,)))
    with pytest.raises(TypeError, match=r"ShrinkAndPerturb is for algorithms with a single optimiser .*, got SAC"):
        SAC("MlpPolicy", box, buffer_size=10, device="cpu").learn(10, callback=ShrinkAndPerturb())


def test_the_noise_of_a_rollout_is_that_of_its_probabilities():
    """With gSDE, the noise of a rollout is drawn before the callbacks' turn."""
    seen = []

    class Watch(BaseCallback):
        def _on_step(self):
            policy = self.model.policy
            distribution = policy.action_dist
            expected = distribution.get_std(policy.log_std)
            seen.append((distribution.exploration_mat.abs() / expected).max().item())
            return True

    env = ContinualEnv([partial(RandomEnv, action_space=spaces.Box(-1, 1, (2,)))] * 2, 32)
    model = make_model("PPO", env, use_sde=True, policy_kwargs=dict(net_arch=[8], log_std_init=-6))
    draws = ShrinkAndPerturb(shrink=0.01, interval=None)
    log_std = model.policy.log_std

    class Grow(BaseCallback):
        """What training would do in a long time."""

        def _on_step(self):
            return True

        def _on_rollout_end(self):
            with th.no_grad():
                log_std.fill_(2.0)

    model.learn(64, callback=[TaskSync(), draws, Watch(), Grow()])
    assert draws.n_steps == 1
    assert max(seen) < 6  # standard deviations
