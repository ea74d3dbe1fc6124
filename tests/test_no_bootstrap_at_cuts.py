"""Episodes that are cut count as ended."""

import pytest
import torch as th
from gymnasium.wrappers import TimeLimit
from sb3_contrib import ARS
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import CallbackList

from sb3_cchain import CChainPPO, ContinualEnv, TaskSignal, TaskSync
from sb3_cchain.callbacks import NoBootstrapAtCuts
from tests.envs import RandomEnv

VALUE = 10.0


class Ones(RandomEnv):
    """Rewards of 1, and episodes without an end."""

    def step(self, action):
        observation, *_, info = super().step(action)
        return observation, 1.0, False, False, info


def rollout_rewards(algorithm, env, callbacks):
    """The rewards of a rollout of PPO all of whose values are ``VALUE``."""
    model = algorithm("MlpPolicy", env, n_steps=16, batch_size=8, n_epochs=1, gamma=0.5, seed=0, device="cpu")
    with th.no_grad():
        model.policy.value_net.weight.zero_()
        model.policy.value_net.bias.fill_(VALUE)
    model.learn(16, callback=callbacks)
    return model.rollout_buffer.rewards[:, 0].tolist()


@pytest.mark.parametrize("algorithm", [PPO, CChainPPO])
@pytest.mark.parametrize("callbacks, added", [([], 0.5 * VALUE), ([NoBootstrapAtCuts()], 0.0)])
def test_nothing_stands_for_the_rest_of_an_episode(algorithm, callbacks, added):
    rewards = rollout_rewards(algorithm, TimeLimit(Ones(), 5), callbacks)
    assert rewards == [1.0 + added if step % 5 == 0 else 1.0 for step in range(1, 17)]


def test_at_a_switch_too():
    rewards = rollout_rewards(PPO, ContinualEnv([Ones, Ones], 8), [TaskSync(), NoBootstrapAtCuts()])
    assert rewards == [1.0] * 16


@pytest.mark.parametrize("kind", [list, CallbackList])
def test_metrics_see_the_cut(kind):
    model = CChainPPO("MlpPolicy", ContinualEnv([Ones, Ones], 32), n_steps=16, batch_size=8, n_epochs=1, seed=0, device="cpu")
    model.learn(64, kind([TaskSignal(), NoBootstrapAtCuts()]))
    assert [(row["task_id"], row["n_episodes"], row["mean_return"]) for row in model.continual_returns] == [
        (0, 0, 1),
        (1, 0, 1),
    ]


def test_a_list_of_the_users_own_is_called():
    class OwnList(CallbackList):
        def _on_step(self):
            steps.append(self.num_timesteps)
            return super()._on_step()

    steps = []
    model = CChainPPO("MlpPolicy", ContinualEnv([Ones, Ones], 32), n_steps=16, batch_size=8, n_epochs=1, device="cpu")
    model.learn(32, OwnList([TaskSignal()]))
    assert steps == list(range(1, 33)) and len(model.continual_returns) == 1


def test_off_policy():
    model = DQN("MlpPolicy", TimeLimit(Ones(), 5), learning_starts=100, buffer_size=20, device="cpu")
    model.learn(16, callback=NoBootstrapAtCuts())
    assert not model.replay_buffer.timeouts.any() and model.replay_buffer.dones[:16].sum() == 3


def test_an_algorithm_that_does_not_bootstrap_is_refused():
    with pytest.raises(TypeError, match="NoBootstrapAtCuts is for algorithms that bootstrap, got ARS"):
        ARS("MlpPolicy", "CartPole-v1", device="cpu").learn(10, callback=NoBootstrapAtCuts())
