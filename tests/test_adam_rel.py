"""Adam with relative timesteps."""

from itertools import pairwise

import pytest
import torch as th
from stable_baselines3 import A2C, DQN, PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from torch import nn

from sb3_cchain import CChainDQN, CChainPPO, DoubleDQN
from sb3_cchain.methods import TRAC, AdamRel, WeightClipping
from sb3_cchain.methods.adam_rel import reset_step_count
from tests.envs import RandomEnv

PPO_SETTINGS = dict(n_steps=16, batch_size=8, n_epochs=2, seed=0, device="cpu")
DQN_SETTINGS = dict(learning_starts=20, buffer_size=100, batch_size=4, seed=0, device="cpu")


@pytest.mark.parametrize(
    "cls, kwargs", [(th.optim.Adam, {}), (th.optim.Adam, dict(fused=True)), (th.optim.AdamW, dict(weight_decay=0.0))]
)
def test_first_update_after_a_reset_by_hand(cls, kwargs):
    parameter = nn.Parameter(th.tensor([1.0, -1.0]))
    optimizer = cls([parameter], lr=0.1, betas=(0.9, 0.99), eps=1e-3, **kwargs)
    m, v = th.zeros(2), th.zeros(2)
    for gradient in ([1.0, 2.0], [-3.0, 0.5], [2.0, 2.0]):
        parameter.grad = th.tensor(gradient)
        m, v = 0.9 * m + 0.1 * parameter.grad, 0.99 * v + 0.01 * parameter.grad**2
        optimizer.step()
    assert reset_step_count(optimizer)
    before = parameter.detach().clone()
    parameter.grad = th.tensor([0.5, -4.0])
    m, v = 0.9 * m + 0.1 * parameter.grad, 0.99 * v + 0.01 * parameter.grad**2
    optimizer.step()
    assert th.allclose(parameter, before - 0.1 * (m / 0.1) / ((v / 0.01).sqrt() + 1e-3), rtol=1e-6)
    assert optimizer.state[parameter]["step"] == 1


@pytest.mark.parametrize("cls", [th.optim.RAdam, th.optim.NAdam, th.optim.Adamax])
def test_without_moments_a_reset_is_a_new_start(cls):
    parameters = [nn.Parameter(th.ones(2)) for _ in range(2)]
    old, new = (cls([parameter], lr=0.1) for parameter in parameters)
    for step in range(9):
        if step == 3:
            reset_step_count(old)
            for name, value in old.state[parameters[0]].items():
                if name in ("exp_avg", "exp_avg_sq", "exp_inf"):
                    value.zero_()
            with th.no_grad():
                parameters[0].fill_(1.0)
        for parameter, optimizer in zip(parameters, (old, new), strict=True):
            if step >= 3 or optimizer is old:
                parameter.grad = th.tensor([1.0, step + 0.5])
                optimizer.step()
    assert th.equal(*parameters)


class Steps(BaseCallback):
    """Adam's step count before the first update of each ``train()``, and after the last of the one before."""

    def _on_training_start(self):
        self.ends, self.starts = [], []
        train = self.model.train

        def recording_train(*args, **kwargs):
            self.starts.append(self.count())
            train(*args, **kwargs)
            self.ends.append(self.count())

        self.model.train = recording_train

    def _on_training_end(self):
        del self.model.train

    def count(self):
        counts = {int(state["step"]) for key, state in self.model.policy.optimizer.state.items() if th.is_tensor(key)}
        assert len(counts) <= 1
        return counts.pop() if counts else None

    def _on_step(self):
        return True


@pytest.mark.parametrize("cls", [PPO, CChainPPO])
@pytest.mark.parametrize(
    "optimizer",
    [{}, dict(optimizer_class=TRAC, optimizer_kwargs=dict(base_class=WeightClipping))],
)
def test_ppo_resets_at_each_rollout(cls, optimizer):
    steps, adam_rel = Steps(), AdamRel()
    model = cls("MlpPolicy", RandomEnv(), policy_kwargs=dict(net_arch=[4], **optimizer), **PPO_SETTINGS)
    model.learn(4 * 16, callback=[steps, adam_rel], log_interval=100)
    assert steps.starts == [None, 0, 0, 0]
    assert steps.ends == [4, 4, 4, 4]
    assert model.logger.name_to_value["adam_rel/n_resets"] == adam_rel.n_resets == 3


@pytest.mark.parametrize("cls", [DQN, DoubleDQN, CChainDQN])
@pytest.mark.parametrize("n_envs, train_freq", [(1, 1), (1, 4), (2, 3)])
def test_dqn_resets_when_the_target_network_was_copied(cls, n_envs, train_freq):
    env = make_vec_env(RandomEnv, n_envs)
    model = cls("MlpPolicy", env, target_update_interval=10, train_freq=train_freq, **DQN_SETTINGS)
    steps, adam_rel, targets = Steps(), AdamRel(), []
    target = model.q_net_target.q_net[0].weight
    train = model.train

    def recording_train(*args, **kwargs):
        targets.append(target.clone())
        train(*args, **kwargs)

    model.train = recording_train
    model.learn(80, callback=[steps, adam_rel])
    copied = [not th.equal(old, new) for old, new in pairwise(targets)]
    assert sum(copied) == adam_rel.n_resets >= 4
    # The count before each train() but the first: 0 after a copy, else where the last one ended
    expected = [0 if was_copied else end for was_copied, end in zip(copied, steps.ends, strict=False)]
    assert steps.starts[1:] == expected


def test_resumes(tmp_path):
    model = DQN("MlpPolicy", RandomEnv(), target_update_interval=10, train_freq=1, **DQN_SETTINGS)
    model.learn(35, callback=AdamRel()).save(tmp_path / "model")
    steps, adam_rel = Steps(), AdamRel()
    loaded = DQN.load(tmp_path / "model", env=RandomEnv(), device="cpu")
    assert loaded._n_calls == 35
    loaded.learn(10, callback=[steps, adam_rel], reset_num_timesteps=False)
    assert adam_rel.n_resets == 1
    # Copied after 30 steps, as before each update from the 30th step on, and after 40
    assert steps.starts == [6, 7, 8, 9, 0, 1, 2, 3, 4, 5]


def test_refuses_what_it_cannot_serve():
    sgd = dict(optimizer_class=th.optim.SGD)
    for cls, kwargs in [(PPO, sgd), (PPO, dict(optimizer_class=TRAC, optimizer_kwargs=dict(base_class=th.optim.SGD)))]:
        with pytest.raises(TypeError, match=r"needs an optimiser with a step count, as Adam has, got (SGD|TRAC)"):
            cls("MlpPolicy", RandomEnv(), policy_kwargs=kwargs, **PPO_SETTINGS).learn(16, callback=AdamRel())
    with pytest.raises(TypeError, match="as Adam has, got RMSprop"):  # whose count has no use
        A2C("MlpPolicy", RandomEnv(), device="cpu").learn(10, callback=AdamRel())
    with pytest.raises(TypeError, match="on-policy algorithms and DQN, got SAC"):
        SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, device="cpu").learn(10, callback=AdamRel())

    class NoSteps(th.optim.Optimizer):
        def __init__(self, params, lr):
            super().__init__(params, dict(lr=lr, betas=(0.9, 0.99)))

        def step(self, closure=None):
            for parameter in self.param_groups[0]["params"]:
                self.state[parameter]["momentum"] = parameter.grad

    with pytest.raises(TypeError, match="as Adam has, got NoSteps"):
        model = PPO("MlpPolicy", RandomEnv(), policy_kwargs=dict(optimizer_class=NoSteps), **PPO_SETTINGS)
        model.learn(32, callback=AdamRel())
