"""
Training equals SB3's own ``train()`` with the churn term, Double Q-learning and the loss written into its source, and a loop
that copies the network at every update. An SB3 release that changes its ``train()`` makes these tests fail.
"""

from functools import cache, partial

import pytest
import torch as th
from stable_baselines3 import DQN, PPO

from benchmarks.speed.deepcopy_dqn import DeepCopyDQN
from benchmarks.speed.deepcopy_ppo import DeepCopyPPO
from sb3_cchain import CChainDQN, CChainPPO, DoubleDQN
from sb3_cchain.algorithms import dqn_cchain, on_policy
from sb3_cchain.algorithms.reference_batches import REFERENCES
from sb3_cchain.churn import cross_entropy, mean_squared_difference
from sb3_cchain.networks.policy_outputs import policy_outputs
from tests.churn_models import assert_close, assert_equal, differ, learn_in_double_precision, spied
from tests.sb3_source import COEF, NUMBERED_MINIBATCHES, PPO_SETTINGS, rewritten

# --- PPO -------------------------------------------------------------------------------------------------------------------

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
    churn_reference = "independent"
    churn_batch_size = 1

    def churn_term(self):
        if self.pending is None:
            return 0.0
        reference, old = self.pending
        divergence = cross_entropy if hasattr(self.action_space, "n") else mean_squared_difference
        return COEF * divergence(old, policy_outputs(self.policy, reference))

    def remember(self, minibatches, position):
        first = position + (1 if self.churn_reference == "next" else (len(minibatches) + 1) // 2)
        following = [minibatches[(first + i) % len(minibatches)].observations for i in range(2)]
        reference = th.cat(following)[: round(self.churn_batch_size * self.batch_size)]
        with th.no_grad():
            self.pending = reference, policy_outputs(self.policy, reference)
        self.n_optimizer_steps += 1


each_reference = pytest.mark.parametrize(
    "churn_reference, churn_batch_size", [(kind, size) for kind in ("independent", "next") for size in (0.5, 1, 2)]
)


def written_out_ppo(churn_reference, churn_batch_size):
    class WithReferences(WrittenOutPPO):
        pass

    WithReferences.churn_reference = churn_reference
    WithReferences.churn_batch_size = churn_batch_size
    return WithReferences


@pytest.mark.parametrize(
    "env_id, max_grad_norm, target_kl",
    [  # all pairs of two
        *(("CartPole-v1", *others) for others in ((0.5, None), (0.05, 0.0005))),
        *(("Pendulum-v1", *others) for others in ((0.5, 0.0005), (0.05, None))),
    ],
)
def test_ppo_equals_sb3_source_with_the_term_in_its_loss(env_id, max_grad_norm, target_kl, monkeypatch):
    monkeypatch.setattr(on_policy, "can_evaluate_jointly", lambda policy: False)
    settings = dict(PPO_SETTINGS, max_grad_norm=max_grad_norm, target_kl=target_kl)
    written_out = WrittenOutPPO("MlpPolicy", env_id, **settings).learn(64 * N_ITERATIONS)
    seam = CChainPPO("MlpPolicy", env_id, churn_coef=COEF, **settings).learn(64 * N_ITERATIONS)
    plain = PPO("MlpPolicy", env_id, **settings).learn(64 * N_ITERATIONS)

    assert written_out.n_optimizer_steps >= 100, written_out.n_optimizer_steps
    stopped_early = written_out.n_optimizer_steps < 16 * N_ITERATIONS
    assert stopped_early == (target_kl is not None)
    assert_equal(seam, written_out)
    assert differ(seam, plain)  # the term makes a difference


@pytest.mark.parametrize("env_id, target_kl", [("CartPole-v1", None), ("Pendulum-v1", 0.0005)])
@each_reference
def test_joint_passes_equal_sb3_source_with_the_term_in_its_loss(env_id, target_kl, churn_reference, churn_batch_size):
    settings = dict(PPO_SETTINGS, target_kl=target_kl)
    with spied(on_policy, "joint_passes") as joint:
        written_out, seam = (
            learn_in_double_precision(make, 64 * N_ITERATIONS, env_id, **settings)
            for make in (
                written_out_ppo(churn_reference, churn_batch_size),
                partial(CChainPPO, churn_coef=COEF, churn_reference=churn_reference, churn_batch_size=churn_batch_size),
            )
        )
    assert joint.call_count == N_ITERATIONS
    assert written_out.n_optimizer_steps >= 100, written_out.n_optimizer_steps
    assert_close(seam, written_out, atol=1e-12)


@pytest.mark.parametrize(
    "env_id, churn_reference, churn_batch_size",
    [  # pairs of two; the test above has them all
        *(("CartPole-v1", kind, size) for kind, size in (("independent", 0.5), ("independent", 2), ("next", 1))),
        *(("Pendulum-v1", kind, size) for kind, size in (("next", 0.5), ("next", 2), ("independent", 1))),
    ],
)
def test_ppo_equals_a_loop_that_copies_the_network(env_id, churn_reference, churn_batch_size):
    target_churn_ratio = 1e4 if env_id == "CartPole-v1" else 0.05
    arguments = dict(target_churn_ratio=target_churn_ratio, churn_warmup=2, churn_window=5, **PPO_SETTINGS)
    arguments.update(churn_reference=churn_reference, churn_batch_size=churn_batch_size)
    copying = learn_in_double_precision(DeepCopyPPO, 64 * 13, env_id, **arguments)
    with spied(on_policy, "joint_passes") as joint:
        seam = learn_in_double_precision(CChainPPO, 64 * 13, env_id, **arguments)
    assert joint.call_count == 13
    assert seam.policy.optimizer.state_dict()["state"][0]["step"] == 13 * 16 >= 200
    assert_close(seam, copying, atol=1e-9)
    # λ had adapted
    assert seam.logger.name_to_value["churn/coef"] not in (0.0, 1.0)


# --- DQN -------------------------------------------------------------------------------------------------------------------

DQN_SETTINGS = dict(
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

DOUBLE_Q = (
    "next_q_values, _ = next_q_values.max(dim=1)",
    "greedy = self.q_net(replay_data.next_observations).argmax(dim=1, keepdim=True)\n"
    "next_q_values = next_q_values.gather(1, greedy)",
)
MSE = ("F.smooth_l1_loss(", "F.mse_loss(")
CHURN = [
    ("self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)", "self.minibatch(batch_size)"),
    ("losses.append(loss.item())", "losses.append(loss.item())\nloss = loss + self.churn_term()"),
    ("self.policy.optimizer.zero_grad()", "self.remember(batch_size)\nself.policy.optimizer.zero_grad()"),
]


def rewritten_dqn(*replacements, reference="independent"):
    """SB3's DQN with its source changed."""

    class WrittenOutDQN(DQN):
        train = rewritten(DQN.train, *replacements)
        pending = following = None
        n_churn_terms = 0

        def sample(self, batch_size):
            return self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)

        def minibatch(self, batch_size):
            if reference == "independent":
                return self.sample(batch_size)
            current = self.following or self.sample(batch_size)
            self.following = self.sample(batch_size)
            return current

        def churn_term(self):
            if self.pending is None:
                return 0.0
            self.n_churn_terms += 1
            reference, old = self.pending
            return COEF * th.nn.functional.mse_loss(self.q_net(reference), old)

        def remember(self, batch_size):
            observations = (self.following or self.sample(batch_size)).observations
            with th.no_grad():
                self.pending = observations, self.q_net(observations)

    return WrittenOutDQN


@cache
def without_churn_reduction(algorithm, **arguments):
    return algorithm("MlpPolicy", "CartPole-v1", **DQN_SETTINGS, **arguments).learn(N_STEPS)


@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("double_q, loss", [(True, "mse"), (True, "huber"), (False, "mse")])
def test_double_dqn_equals_sb3_source_with_other_targets_and_loss(double_q, loss, n_steps):
    arguments = dict(DQN_SETTINGS, n_steps=n_steps)
    written_out = rewritten_dqn(*[DOUBLE_Q] * double_q, *[MSE] * (loss == "mse"))
    written_out = written_out("MlpPolicy", "CartPole-v1", **arguments).learn(N_STEPS)
    model = DoubleDQN("MlpPolicy", "CartPole-v1", double_q=double_q, loss=loss, **arguments).learn(N_STEPS)
    assert model._n_updates == 220
    assert_equal(model, written_out)
    assert model.logger.name_to_value["train/loss"] == written_out.logger.name_to_value["train/loss"]
    assert differ(model, without_churn_reduction(DQN, n_steps=n_steps))


@pytest.mark.parametrize(
    "double_q, loss, max_grad_norm, own_pass, churn_reference",
    [  # all combinations of any three of: the targets with their loss, the norm, the pass, the reference
        (double_q, loss, max_grad_norm, own_pass, REFERENCES[double_q ^ (max_grad_norm == 10) ^ own_pass])
        for double_q, loss in ((True, "mse"), (False, "huber"))
        for max_grad_norm in (10, 0.05)
        for own_pass in (False, True)
    ],
)
def test_dqn_equals_sb3_source_with_the_term_in_its_loss(
    double_q, loss, max_grad_norm, own_pass, churn_reference, monkeypatch
):
    arguments = dict(DQN_SETTINGS, max_grad_norm=max_grad_norm)
    cchain = partial(CChainDQN, double_q=double_q, loss=loss, churn_coef=COEF, churn_reference=churn_reference)
    written_out = rewritten_dqn(*[DOUBLE_Q] * double_q, *[MSE] * (loss == "mse"), *CHURN, reference=churn_reference)
    if own_pass:
        monkeypatch.setattr(dqn_cchain, "has_training_mode", lambda policy: True)
        reference = written_out("MlpPolicy", "CartPole-v1", **arguments).learn(N_STEPS)
        model = cchain("MlpPolicy", "CartPole-v1", **arguments).learn(N_STEPS)
        assert_equal(model, reference)
    else:
        # Batches of twice the size are summed in another order
        reference = learn_in_double_precision(written_out, N_STEPS, **arguments)
        with spied(dqn_cchain, "joint_pass") as joint:
            model = learn_in_double_precision(cchain, N_STEPS, **arguments)
        assert joint.call_count == 220
        assert_close(model, reference, atol=1e-9)
    assert reference.n_churn_terms == 219  # the first update has no previous one
    vanilla = without_churn_reduction(DoubleDQN, double_q=double_q, loss=loss, max_grad_norm=max_grad_norm)
    assert not all(
        th.allclose(p.float(), q, atol=1e-3)
        for p, q in zip(model.policy.parameters(), vanilla.policy.parameters(), strict=True)
    )


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Acrobot-v1"])
def test_dqn_equals_a_loop_that_copies_the_network(env_id):
    arguments = dict(DQN_SETTINGS, target_churn_ratio=0.01, churn_warmup=20, churn_window=50, gradient_steps=1)
    copying = learn_in_double_precision(DeepCopyDQN, 500, env_id, **arguments)
    model = learn_in_double_precision(partial(CChainDQN, loss="mse", churn_coef="auto_50"), 500, env_id, **arguments)
    assert model._n_updates == copying._n_updates == 225
    assert_close(model, copying, atol=1e-9)
    # λ had adapted
    assert model.churn_reducer.coefficient.value == pytest.approx(copying._churn_coef())
    assert model.churn_reducer.coefficient.value != 50
