"""Evaluation on the task being trained."""

import numpy as np
import pytest
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecNormalize

from sb3_cchain import CChainPPO, ContinualEnv, TaskSync
from sb3_cchain.analysis import EvalAllTasks, EvalTrainedTask
from sb3_cchain.callbacks import read_returns
from sb3_cchain.tensorboard.layout import layout_of
from tests.envs import CountEnv
from tests.resume_cases import Record
from tests.test_eval_all_tasks import ARGUMENTS, CARTPOLE, tasks


def test_evaluates_before_training_at_intervals_and_right_after_each_task(tmp_path):
    """The tasks have returns of 7, 14 and 21, and 32 steps."""
    record = Record()
    model = CChainPPO("MlpPolicy", tasks(), **ARGUMENTS)
    model.set_logger(Logger(None, [record]))
    model.learn(96, callback=EvalTrainedTask(tasks(), path=tmp_path / "evaluations.csv", n_eval_episodes=2, interval=16))
    rows = read_returns(tmp_path / "evaluations.csv")
    assert rows == model.evaluations and {row["n_episodes"] for row in rows} == {2}
    assert [(row["timesteps"], row["task_id"], row["mean_return"]) for row in rows] == [
        *((0, 0, 7), (16, 0, 7), (32, 0, 7), (48, 1, 14), (64, 1, 14), (80, 2, 21), (96, 2, 21)),
    ]
    # At the end of the rollout after the evaluation, the last one at once
    logged = [(step, row["evaluation/mean_return"]) for step, row in record.rows if "evaluation/mean_return" in row]
    assert logged == [(16, 7), (32, 7), (48, 7), (64, 14), (80, 14), (96, 21), (96, 21)]
    assert layout_of({"evaluation/mean_return"}) == {
        "Evaluations on the tasks": {"Mean return on the task being trained": "evaluation/mean_return"}
    }


def test_off_policy_it_is_at_the_very_step():
    arguments = dict(learning_starts=8, batch_size=8, train_freq=1, policy_kwargs=dict(net_arch=[8]), seed=0)
    model = DQN("MlpPolicy", tasks(), **arguments)
    model.learn(64, callback=[TaskSync(), EvalTrainedTask(tasks(), n_eval_episodes=1, interval=10)])
    at = [(row["timesteps"], row["task_id"]) for row in model.evaluations]
    assert at == [(0, 0), (10, 0), (20, 0), (30, 0), (32, 0), (40, 1), (50, 1), (60, 1), (64, 1)]


def test_it_goes_with_evaluations_on_all_tasks():
    model = PPO("MlpPolicy", tasks(), **ARGUMENTS)
    callbacks = [EvalTrainedTask(tasks(), n_eval_episodes=1), EvalAllTasks(tasks(), n_eval_episodes=1)]
    model.learn(64, callback=[TaskSync(), *callbacks])
    on_all = [row["mean_return"] for row in model.task_returns if row["task_id"] == row["trained_task"]]
    assert [row["mean_return"] for row in model.evaluations] == on_all == [7, 7, 14]
    with pytest.raises(ValueError, match="EvalTrainedTask"):
        model.learn(16, callback=[TaskSync(), callbacks[0], EvalTrainedTask(tasks())])


def test_sampled_actions_leave_training_as_it_is():
    parameters = []
    for callbacks in ([], [EvalTrainedTask(n_eval_episodes=1, interval=16, deterministic=False)]):
        model = PPO("MlpPolicy", "Continual/CartPole-v1", **ARGUMENTS).learn(48, callback=[TaskSync(), *callbacks])
        parameters.append(model.policy.state_dict())
    assert len(model.evaluations) == 4
    assert all(np.array_equal(parameters[0][name], parameters[1][name]) for name in parameters[0])


class Recorded(CountEnv):
    actions, firsts = [], []

    def reset(self, **kwargs):
        observation, info = super().reset(**kwargs)
        self.firsts.append(float(observation[0]))
        return observation, info

    def step(self, action):
        self.actions.append(int(action))
        return super().step(action)


Recorded.__name__ = "CountEnv"  # the same tasks as those of training


def test_the_environment_is_normalised_within_the_limits_of_training():
    env = VecNormalize(make_vec_env("Continual/CartPole-v1", env_kwargs=CARTPOLE), clip_obs=0.5, epsilon=1e-3)
    callback = EvalTrainedTask(n_eval_episodes=1)
    PPO("MlpPolicy", env, **ARGUMENTS).learn(16, [TaskSync(), callback])
    assert (callback.eval_env.clip_obs, callback.eval_env.epsilon) == (0.5, 1e-3)


@pytest.mark.parametrize("training", [True, False])
def test_the_mode_of_the_network_is_left_as_it_is(training):
    callback, model = EvalTrainedTask(tasks()), PPO("MlpPolicy", tasks(), **ARGUMENTS)
    model.set_logger(Logger(None, []))
    callback.init_callback(model)
    model.policy.set_training_mode(training)
    model.env.reset()
    callback.on_training_start({}, {})
    callback.on_rollout_start()
    assert len(model.evaluations) == 1 and model.policy.training is training


def evaluate(**arguments):
    Recorded.actions, Recorded.firsts = [], []
    settings = dict(n_steps=16, batch_size=8, n_epochs=1, seed=0, device="cpu")
    model = PPO("MlpPolicy", ContinualEnv([CountEnv] * 2, 32), **settings)
    model.learn(16, [TaskSync(), EvalTrainedTask(ContinualEnv([Recorded] * 2, 32), **arguments)])
    return len(Recorded.actions), set(Recorded.actions), Recorded.firsts


def test_arguments_of_an_evaluation_hold():
    n_steps, actions, firsts = evaluate(n_eval_episodes=1)
    assert n_steps > 0 and len(actions) == 1
    assert evaluate(n_eval_episodes=3)[0] == 3 * n_steps
    assert evaluate(n_eval_episodes=5, deterministic=False)[1] == {0, 1}
    assert evaluate(n_eval_episodes=1, seed=5)[2] != firsts
