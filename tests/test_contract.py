"""
Churn reduction through the optimiser seam equals churn reduction written into the training loop. An SB3 release that moves
the seam turns these tests red, not the results wrong.
"""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO

from benchmarks.speed.deepcopy_ppo import DeepCopyPPO
from sb3_cchain import CChainPPO
from sb3_cchain.churn import cross_entropy, mean_squared_difference
from sb3_cchain.networks.policy_outputs import policy_outputs
from tests.sb3_source import COEF, NUMBERED_MINIBATCHES, PPO_SETTINGS, rewritten

N_ITERATIONS = 8


class WrittenOutPPO(PPO):
    """SB3's, with the churn term in its loss."""

    train = rewritten(
        PPO.train,
        NUMBERED_MINIBATCHES,
        (
            "loss = policy_loss + self.ent_coef * entropy_loss + self.vf_coef * value_loss",
            "loss = policy_loss + self.ent_coef * entropy_loss + self.vf_coef * value_loss + self.churn_term()",
        ),
        (
            "self.policy.optimizer.zero_grad()",
            "self.remember(minibatches, position)\nself.policy.optimizer.zero_grad()",
        ),
    )
    pending = None
    n_optimizer_steps = 0

    def churn_term(self):
        if self.pending is None:
            return 0.0
        reference, old = self.pending
        divergence = cross_entropy if hasattr(self.action_space, "n") else mean_squared_difference
        return COEF * divergence(old, policy_outputs(self.policy, reference))

    def remember(self, minibatches, position):
        reference = minibatches[(position + (len(minibatches) + 1) // 2) % len(minibatches)].observations
        with th.no_grad():
            self.pending = reference, policy_outputs(self.policy, reference)
        self.n_optimizer_steps += 1


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
@pytest.mark.parametrize("max_grad_norm", [0.5, 0.05])
@pytest.mark.parametrize("target_kl", [None, 0.0005])
def test_equals_sb3_source_with_the_term_in_its_loss(env_id, max_grad_norm, target_kl):
    settings = dict(PPO_SETTINGS, max_grad_norm=max_grad_norm, target_kl=target_kl)
    written_out = WrittenOutPPO("MlpPolicy", env_id, **settings).learn(64 * N_ITERATIONS)
    seam = CChainPPO("MlpPolicy", env_id, churn_coef=COEF, **settings).learn(64 * N_ITERATIONS)
    plain = PPO("MlpPolicy", env_id, **settings).learn(64 * N_ITERATIONS)

    assert written_out.n_optimizer_steps >= 100, written_out.n_optimizer_steps
    stopped_early = written_out.n_optimizer_steps < 16 * N_ITERATIONS
    assert stopped_early == (target_kl is not None)
    for name, parameter in seam.policy.named_parameters():
        assert th.equal(parameter, written_out.policy.get_parameter(name)), name
    # The term makes a difference
    assert any(not th.equal(p, q) for p, q in zip(seam.policy.parameters(), plain.policy.parameters(), strict=True))


@pytest.mark.parametrize("env_id, target_churn_ratio", [("CartPole-v1", 1e4), ("Pendulum-v1", 0.05)])
def test_equals_a_loop_that_copies_the_network(env_id, target_churn_ratio):
    arguments = dict(target_churn_ratio=target_churn_ratio, churn_warmup=2, churn_window=5, **PPO_SETTINGS)
    copying = DeepCopyPPO("MlpPolicy", env_id, **arguments).learn(64 * 13)
    seam = CChainPPO("MlpPolicy", env_id, **arguments).learn(64 * 13)
    assert seam.policy.optimizer.state_dict()["state"][0]["step"] == 13 * 16 >= 200
    for name, parameter in seam.policy.named_parameters():
        assert th.allclose(parameter, copying.policy.get_parameter(name), rtol=0, atol=1e-6), name
    # λ had adapted
    assert seam.logger.name_to_value["churn/coef"] not in (0.0, 1.0)


class IndexEnv(gym.Env):
    """The observation is the number of steps made, so that a sample can be told from the others."""

    observation_space = gym.spaces.Box(0, np.inf, (1,))
    action_space = gym.spaces.Discrete(2)

    def __init__(self):
        self.n = 0

    def reset(self, *, seed=None, options=None):
        return np.array([self.n], dtype=np.float32), {}

    def step(self, action):
        self.n += 1
        return np.array([self.n], dtype=np.float32), 0.0, False, False, {}


class RecordingPPO(CChainPPO):
    """Records which samples each update was made on, and on which its churn was measured."""

    def _setup_model(self):
        super()._setup_model()
        self.trained_on, self.measured_on = [], []
        evaluate_actions, backward = self.policy.evaluate_actions, self.churn_reducer.backward

        def recording_evaluate_actions(observations, actions):
            self.trained_on.append({int(x) for x in observations})
            return evaluate_actions(observations, actions)

        def recording_backward(reference, *args):
            self.measured_on.append({int(x) for x in reference})
            return backward(reference, *args)

        self.policy.evaluate_actions = recording_evaluate_actions
        self.churn_reducer.backward = recording_backward


@pytest.mark.parametrize("n_steps, batch_size", [(64, 16), (64, 32), (60, 20), (70, 32), (64, 8)])
@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
def test_reference_batch_shares_nothing_with_the_minibatch(n_steps, batch_size):
    model = RecordingPPO("MlpPolicy", IndexEnv(), n_steps=n_steps, batch_size=batch_size, n_epochs=3, seed=0, device="cpu")
    model.learn(2 * n_steps)
    n_minibatches = -(-n_steps // batch_size)
    assert len(model.trained_on) == len(model.measured_on) == 2 * 3 * n_minibatches
    for trained_on, measured_on in zip(model.trained_on, model.measured_on, strict=True):
        assert not trained_on & measured_on
    # Over an epoch, each sample serves once
    for epoch in range(6):
        of_epoch = model.measured_on[epoch * n_minibatches : (epoch + 1) * n_minibatches]
        assert len(set.union(*of_epoch)) == sum(map(len, of_epoch)) == n_steps


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("verbose, n_lines", [(0, 0), (1, 1)])
def test_rollout_of_one_minibatch_is_its_own_reference(verbose, n_lines, capsys):
    model = CChainPPO("MlpPolicy", "CartPole-v1", n_steps=32, batch_size=32, n_epochs=2, verbose=verbose, device="cpu")
    model.learn(3 * 32)
    assert capsys.readouterr().out.count("32 steps is a single minibatch of batch_size=32") == n_lines
    assert len(model.churn_reducer.coefficient.churn_losses.nonzero()) == 3
