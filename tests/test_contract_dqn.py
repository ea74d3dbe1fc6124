"""
DoubleDQN and CChainDQN equal SB3's ``DQN.train()`` with Double Q-learning, the loss and the churn term written into its
source. When SB3 changes its ``train()``, these tests fail.
"""

from functools import partial

import pytest
import torch as th
from stable_baselines3 import DQN
from stable_baselines3.common.torch_layers import FlattenExtractor

from benchmarks.speed.deepcopy_dqn import DeepCopyDQN
from sb3_cchain import CChainDQN, DoubleDQN
from sb3_cchain.algorithms import dqn_cchain
from tests.envs import RandomEnv
from tests.sb3_source import rewritten

SETTINGS = dict(
    learning_rate=3e-3,
    learning_starts=50,
    buffer_size=300,
    batch_size=16,
    train_freq=2,
    gradient_steps=2,
    target_update_interval=100,
    policy_kwargs=dict(net_arch=[16]),
    seed=0,
    device="cpu",
)
N_STEPS = 270  # 220 updates
COEF = 30.0

DOUBLE_Q = (
    "next_q_values, _ = next_q_values.max(dim=1)",
    "greedy = self.q_net(replay_data.next_observations).argmax(dim=1, keepdim=True)\n"
    "next_q_values = next_q_values.gather(1, greedy)",
)
MSE = ("F.smooth_l1_loss(", "F.mse_loss(")
CHURN = [
    ("losses.append(loss.item())", "losses.append(loss.item())\nloss = loss + self.churn_term()"),
    ("self.policy.optimizer.zero_grad()", "self.remember(batch_size)\nself.policy.optimizer.zero_grad()"),
]


def rewritten_dqn(*replacements):
    """SB3's DQN with its source changed."""

    class WrittenOutDQN(DQN):
        train = rewritten(DQN.train, *replacements)
        pending = None
        n_churn_terms = 0

        def churn_term(self):
            if self.pending is None:
                return 0.0
            self.n_churn_terms += 1
            reference, old = self.pending
            return COEF * th.nn.functional.mse_loss(self.q_net(reference), old)

        def remember(self, batch_size):
            reference = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env).observations
            with th.no_grad():
                self.pending = reference, self.q_net(reference)

    return WrittenOutDQN


def assert_equal(model, other):
    for name, parameter in model.policy.state_dict().items():
        assert th.equal(parameter, other.policy.state_dict()[name]), name


def differ(model, other):
    return any(not th.equal(p, q) for p, q in zip(model.policy.parameters(), other.policy.parameters(), strict=True))


@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("double_q, loss", [(True, "mse"), (True, "huber"), (False, "mse")])
def test_double_dqn_equals_sb3_source_with_other_targets_and_loss(double_q, loss, n_steps):
    arguments = dict(SETTINGS, n_steps=n_steps)
    written_out = rewritten_dqn(*[DOUBLE_Q] * double_q, *[MSE] * (loss == "mse"))
    written_out = written_out("MlpPolicy", "CartPole-v1", **arguments).learn(N_STEPS)
    ours = DoubleDQN("MlpPolicy", "CartPole-v1", double_q=double_q, loss=loss, **arguments).learn(N_STEPS)
    assert ours._n_updates == 220
    assert_equal(ours, written_out)
    assert ours.logger.name_to_value["train/loss"] == written_out.logger.name_to_value["train/loss"]
    assert differ(ours, DQN("MlpPolicy", "CartPole-v1", **arguments).learn(N_STEPS))


class DoublePrecision(FlattenExtractor):
    """The churn loss is a difference of nearly equal numbers: in single precision its rounding errors soon show."""

    def forward(self, observations):
        return super().forward(observations).double()


def learn_in_double_precision(make, n_steps, env_id="CartPole-v1", **arguments):
    arguments["policy_kwargs"] = dict(net_arch=[16], features_extractor_class=DoublePrecision)
    model = make("MlpPolicy", env_id, **arguments)
    model.policy.double()
    return model.learn(n_steps)


@pytest.mark.parametrize("own_pass", [False, True])
@pytest.mark.parametrize("max_grad_norm", [10, 0.05])
@pytest.mark.parametrize("double_q, loss", [(True, "mse"), (False, "huber")])
def test_c_chain_equals_sb3_source_with_the_term_in_its_loss(double_q, loss, max_grad_norm, own_pass, monkeypatch):
    arguments = dict(SETTINGS, max_grad_norm=max_grad_norm)
    cchain = partial(CChainDQN, double_q=double_q, loss=loss, churn_coef=COEF)
    written_out = rewritten_dqn(*[DOUBLE_Q] * double_q, *[MSE] * (loss == "mse"), *CHURN)
    if own_pass:
        monkeypatch.setattr(dqn_cchain, "has_training_mode", lambda policy: True)
        reference = written_out("MlpPolicy", "CartPole-v1", **arguments).learn(N_STEPS)
        ours = cchain("MlpPolicy", "CartPole-v1", **arguments).learn(N_STEPS)
        assert_equal(ours, reference)
    else:
        # Batches of twice the size are summed in another order
        reference = learn_in_double_precision(written_out, N_STEPS, **arguments)
        ours = learn_in_double_precision(cchain, N_STEPS, **arguments)
        for name, parameter in ours.policy.state_dict().items():
            assert th.allclose(parameter, reference.policy.state_dict()[name], rtol=0, atol=1e-9), name
    assert reference.n_churn_terms == 219  # the first update has no previous one
    vanilla = DoubleDQN("MlpPolicy", "CartPole-v1", double_q=double_q, loss=loss, **arguments).learn(N_STEPS)
    assert not all(
        th.allclose(p.float(), q, atol=1e-3)
        for p, q in zip(ours.policy.parameters(), vanilla.policy.parameters(), strict=True)
    )


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Acrobot-v1"])
def test_equals_a_loop_that_copies_the_network(env_id):
    arguments = dict(SETTINGS, target_churn_ratio=0.01, churn_warmup=20, churn_window=50, gradient_steps=1)
    copying = learn_in_double_precision(DeepCopyDQN, 500, env_id, **arguments)
    ours = learn_in_double_precision(partial(CChainDQN, loss="mse", churn_coef="auto_50"), 500, env_id, **arguments)
    assert ours._n_updates == copying._n_updates == 225
    for name, parameter in ours.policy.named_parameters():
        assert th.allclose(parameter, copying.policy.get_parameter(name), rtol=0, atol=1e-9), name
    # λ had adapted
    assert ours.churn_reducer.coefficient.value == pytest.approx(copying._churn_coef())
    assert ours.churn_reducer.coefficient.value != 50


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
    model = DoubleDQN("MlpPolicy", RandomEnv(), double_q=double_q, loss=loss, **{**SETTINGS, "gamma": 0.5})
    model.learn(20)  # fewer than `learning_starts`
    buffer = model.replay_buffer
    buffer.rewards[:], buffer.actions[:], buffer.dones[:] = 0.0, 0, 0.0
    model.q_net, model.q_net_target = FixedQ(1.0, 2.0), FixedQ(6.0, 4.0)
    model.policy.optimizer = th.optim.SGD(model.q_net.parameters(), lr=0.1)
    model.train(gradient_steps=1, batch_size=8)
    assert model.logger.name_to_value["train/loss"] == pytest.approx(expected)
