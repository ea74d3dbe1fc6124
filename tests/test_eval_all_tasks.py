"""Evaluation on all tasks during training."""

import random

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import RecordEpisodeStatistics, TransformAction
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import CheckpointCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor, VecNormalize

from sb3_cchain import CChainPPO, ContinualEnv, TaskSignal, TaskSync
from sb3_cchain.analysis import EvalAllTasks, EvalTrainedTask, task_evaluation
from sb3_cchain.analysis.eval_all_tasks import read_task_returns
from sb3_cchain.analysis.metrics.continual import return_matrix
from sb3_cchain.envs import RewardScale, TaskVecNormalize
from sb3_cchain.methods import Oracle
from sb3_cchain.tensorboard.layout import layout_of
from tests.envs import CountEnv, RandomEnv
from tests.resume_cases import Record

ARGUMENTS = dict(n_steps=16, batch_size=8, n_epochs=1, device="cpu", seed=0, policy_kwargs=dict(net_arch=[8]))
CARTPOLE = dict(n_tasks=3, steps_per_task=32)


def tasks(**kwargs):
    """Returns of 7, 14 and 21."""
    rewards = (1.0, 2.0, 3.0)
    makers = [lambda reward=reward, **kw: CountEnv(int(reward), reward=reward, **kw) for reward in rewards]
    return ContinualEnv(makers, 32, **kwargs)


PARTS, OTHER_PARTS = (spaces.Dict({name: spaces.Box(-1, 1, (2,), np.float32)}) for name in "ab")


def random_tasks(observation_space):
    return ContinualEnv([lambda: RandomEnv(observation_space)] * 3, 32)


def evaluate(path, total=96, env=None, **kwargs):
    model = CChainPPO("MlpPolicy", tasks() if env is None else env, **ARGUMENTS)
    callback = EvalAllTasks(kwargs.pop("eval_env", tasks()), path=path, n_eval_episodes=2, **kwargs)
    model.learn(total, callback=callback)
    return model, read_task_returns(path)


def test_evaluates_before_training_at_switches_and_at_the_end(tmp_path):
    model, rows = evaluate(tmp_path / "all.csv")
    assert [(row["timesteps"], row["trained_task"]) for row in rows[::3]] == [(0, 0), (32, 0), (64, 1), (96, 2)]
    assert [row["task_id"] for row in rows] == [0, 1, 2] * 4
    assert [row["mean_return"] for row in rows] == [7, 14, 21] * 4
    assert rows == model.task_returns
    before, after = return_matrix(rows)
    assert before.tolist() == [7, 14, 21] and after.tolist() == [[7, 14, 21]] * 3


def test_at_intervals(tmp_path):
    _, rows = evaluate(tmp_path / "all.csv", interval=16)
    assert [row["timesteps"] for row in rows[::3]] == [0, 16, 32, 48, 64, 80, 96]
    assert [row["trained_task"] for row in rows[::3]] == [0, 0, 0, 1, 1, 2, 2]


def test_training_that_ends_in_a_rollout_with_two_tasks(tmp_path):
    """The task that has just begun was not trained on yet, but for that rollout."""
    arguments = dict(ARGUMENTS, n_steps=20, batch_size=10)
    model = CChainPPO("MlpPolicy", tasks(), **arguments)
    model.learn(80, callback=EvalAllTasks(tasks(), path=tmp_path / "all.csv", n_eval_episodes=1))
    rows = read_task_returns(tmp_path / "all.csv")
    assert [(row["timesteps"], row["trained_task"]) for row in rows[::3]] == [(0, 0), (40, 0), (80, 1)]


def test_cycles_are_evaluated_once(tmp_path):
    env, eval_env = tasks(cycles=2), tasks(cycles=2)
    _, rows = evaluate(tmp_path / "all.csv", total=192, env=env, eval_env=eval_env)
    assert [row["mean_return"] for row in rows[:6]] == [7, 14, 21] * 2
    assert return_matrix(rows)[1].shape == (6, 6)
    assert eval_env._seeded == {2}  # the last that it was put on


class Rising(EvalAllTasks):
    """Returns that one can foresee: ten times the task trained, minus the task."""

    def _all_returns(self):
        trained = self._switch.task_id if self.num_timesteps else 0
        return [10.0 * trained - task for task in range(3)]


def test_what_is_logged():
    record = Record()
    model = CChainPPO("MlpPolicy", tasks(), **ARGUMENTS)
    model.set_logger(Logger(None, [record]))
    model.learn(96, callback=Rising(tasks()), log_interval=1)
    logged = [
        (step, {key.removeprefix("continual_eval/"): value for key, value in row.items() if "continual_eval" in key})
        for step, row in record.rows
        if any("continual_eval" in key for key in row)
    ]
    # At the rollout's end after the evaluation; the last one at once. `happened()` has been told of the next task by then
    assert [step for step, _ in logged] == [16, 48, 80, 96]
    zero, _, second, last = (row for _, row in logged)
    assert (zero["task_0"], zero["task_2"], zero["average"], zero["zero_shot_transfer"]) == (0, -2, -1, 0)
    assert "forgetting" not in zero
    # After task 1: 20 on task 0, which had 10 right after task 0; task 2 had -2 before
    assert second["forgetting"] == -10 and second["zero_shot_transfer"] == 20
    assert last["forgetting"] == np.mean([10 - 20, 19 - 19]) and "zero_shot_transfer" not in last


@pytest.mark.parametrize("algorithm", [PPO, DQN])
@pytest.mark.parametrize("deterministic", [True, False])
def test_training_is_the_same_with_and_without(algorithm, deterministic):
    arguments = (
        ARGUMENTS if algorithm is PPO else dict(learning_starts=8, batch_size=8, policy_kwargs=dict(net_arch=[8]), seed=0)
    )
    outcomes = []
    for callbacks in ([], [EvalAllTasks(n_eval_episodes=1, interval=10, deterministic=deterministic)]):
        env = VecNormalize(make_vec_env("Continual/CartPole-v1", 2, seed=1, env_kwargs=CARTPOLE))
        model = algorithm("MlpPolicy", env, **arguments)
        model.learn(96, callback=[TaskSync(), *callbacks])
        outcomes.append((model, env))
    (plain, plain_env), (watched, watched_env) = outcomes
    assert len(watched.task_returns) > 3 * 3
    for name, parameter in plain.policy.state_dict().items():
        assert parameter.equal(watched.policy.state_dict()[name]), name
    assert np.array_equal(plain._last_obs, watched._last_obs)
    assert np.array_equal(plain_env.obs_rms.mean, watched_env.obs_rms.mean)


def test_the_environment_is_made_like_that_of_training():
    callback = EvalAllTasks(n_eval_episodes=1)
    env = VecNormalize(make_vec_env("Continual/Acrobot-v1", 2, env_kwargs=dict(CARTPOLE, max_episode_steps=20)))
    model = PPO("MlpPolicy", env, **ARGUMENTS)
    model.learn(32, callback=[TaskSync(), callback])
    made = callback.eval_env
    assert made.get_attr("task_sequence") == env.get_attr("task_sequence", 0)
    assert isinstance(made, VecNormalize) and not made.training
    assert np.array_equal(made.obs_rms.mean, env.obs_rms.mean)
    assert {row["mean_return"] for row in model.task_returns} == {-20.0}


def other_action(action):
    return 1 - action


def flipped(env):
    return TransformAction(env, other_action, env.action_space)


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_wrappers_that_an_evaluation_would_lack_are_refused(vec_env_cls):
    env = make_vec_env("Continual/CartPole-v1", 1, env_kwargs=CARTPOLE, wrapper_class=flipped, vec_env_cls=vec_env_cls)
    with pytest.raises(ValueError, match=r"is wrapped in TransformAction, which may change .* an `eval_env` with"):
        PPO("MlpPolicy", env, **ARGUMENTS).learn(1, callback=[TaskSync(), EvalAllTasks()])
    env.close()


def test_wrappers_of_rewards_and_statistics_make_no_difference():
    env = RecordEpisodeStatistics(RewardScale(gym.make("Continual/Acrobot-v1", **CARTPOLE, max_episode_steps=20), 0.1))
    model = PPO("MlpPolicy", env, **ARGUMENTS)
    model.learn(16, callback=[TaskSync(), EvalAllTasks(n_eval_episodes=1)])
    assert {row["mean_return"] for row in model.task_returns} == {-20.0}


def test_every_evaluation_sees_the_same_episodes():
    callback = EvalAllTasks(n_eval_episodes=2, interval=8)
    env = gym.make("Continual/CartPole-v1", **CARTPOLE)
    model = PPO("MlpPolicy", env, **dict(ARGUMENTS, learning_rate=0.0)).learn(32, callback=[TaskSync(), callback])
    values = np.array([row["mean_return"] for row in model.task_returns]).reshape(-1, 3)
    assert len(values) >= 3 and (values == values[0]).all()


def test_comes_before_what_changes_the_networks(tmp_path):
    """The evaluation at a switch is of the networks that were trained on the task, not of the Oracle's fresh ones."""
    seen = {}

    class Watch(EvalAllTasks):
        def _all_returns(self):
            seen[self.num_timesteps] = self.model.policy.action_net.weight.detach().clone()
            return [0.0] * 3

    model = PPO("MlpPolicy", tasks(), **ARGUMENTS)
    save = CheckpointCallback(32, str(tmp_path))
    model.learn(64, callback=[TaskSync(), save, Watch(tasks()), Oracle()])
    # An update of one rollout lies between the saved one and that at the switch; the Oracle's draw is another
    assert not seen[32].equal(seen[0])
    assert (seen[32] - seen[0]).abs().max() < 0.02


def test_a_training_that_stops_right_after_a_switch_is_not_evaluated_again():
    """Oracle has made new networks by then, which were not trained on the task before."""
    model = PPO("MlpPolicy", tasks(), **ARGUMENTS)
    stop = StopTrainingOnMaxEpisodes(6)  # the fifth episode is cut by the switch at step 32
    model.learn(96, [TaskSync(), EvalAllTasks(tasks(), n_eval_episodes=1), Oracle(), stop])
    assert model.num_timesteps == 39
    assert [row["timesteps"] for row in model.task_returns[::3]] == [0, 32]


class Means(EvalAllTasks):
    """Records the statistics of the evaluation."""

    def _all_returns(self):
        self.counts = [*getattr(self, "counts", []), round(self.eval_env.obs_rms.count)]
        return super()._all_returns()


def test_statistics_that_restart_at_the_switch_are_those_of_the_task_before():
    env, eval_env = (TaskVecNormalize(make_vec_env(tasks)) for _ in range(2))
    callback = Means(eval_env, n_eval_episodes=1)
    PPO("MlpPolicy", env, **ARGUMENTS).learn(80, [TaskSync(), callback])
    # Observations: a reset and 31 or 32 steps, as the one at the switch is the next task's
    assert callback.counts == [1, 32, 32, 17]


def test_training_that_ends_at_a_switch_has_the_statistics_of_its_task():
    env, eval_env = (TaskVecNormalize(make_vec_env(tasks)) for _ in range(2))
    callback, model = Means(eval_env, n_eval_episodes=1), PPO("MlpPolicy", env, **ARGUMENTS)
    for _ in range(2):
        model.learn(32, [TaskSync(), callback], reset_num_timesteps=False)
    assert callback.counts == [1, 32, 32]


def test_an_evaluation_leaves_its_statistics():
    class Watch(Means):
        def _all_returns(self):
            returns = super()._all_returns()
            assert round(self.eval_env.obs_rms.count) == self.counts[-1]
            return returns

    env, eval_env = (TaskVecNormalize(make_vec_env(tasks)) for _ in range(2))
    callback = Watch(eval_env, n_eval_episodes=1)
    PPO("MlpPolicy", env, **ARGUMENTS).learn(48, [TaskSync(), callback])
    assert len(callback.counts) == 3


@pytest.mark.parametrize("interval", [None, 50])
def test_resumed_in_the_middle_of_an_interval(tmp_path, interval):
    """There is no evaluation at the start. Rows of training that was lost after the last save will come again."""
    model = CChainPPO("MlpPolicy", tasks(), **ARGUMENTS)
    model.learn(64, callback=EvalAllTasks(tasks(), n_eval_episodes=1, interval=interval))
    rows = [*model.task_returns]
    model.task_returns += [{**row, "timesteps": 80} for row in rows[:3]]
    model.save(tmp_path / "model")
    loaded = CChainPPO.load(tmp_path / "model", env=tasks(), device="cpu")
    loaded.learn(32, callback=EvalAllTasks(tasks(), n_eval_episodes=1, interval=interval), reset_num_timesteps=False)
    assert loaded.task_returns[: len(rows)] == rows
    assert [row["timesteps"] for row in loaded.task_returns[len(rows) :]] == [96] * 3


def test_tasks_that_were_left_out_are_not_forgotten():
    record = Record()
    model = CChainPPO("MlpPolicy", tasks(first_task=1), **ARGUMENTS)
    model.set_logger(Logger(None, [record]))
    model.learn(64, callback=EvalAllTasks(tasks(first_task=1), n_eval_episodes=1), log_interval=1)
    forgotten = [row["continual_eval/forgetting"] for _, row in record.rows if "continual_eval/forgetting" in row]
    assert forgotten == [0.0]


def test_resumed_training_goes_on_with_the_rows(tmp_path):
    model, rows = evaluate(tmp_path / "all.csv", total=64)
    model.save(tmp_path / "model")
    loaded = CChainPPO.load(tmp_path / "model", env=tasks(), device="cpu")
    callback = EvalAllTasks(tasks(), path=tmp_path / "all.csv", n_eval_episodes=2)
    loaded.learn(32, callback=callback, reset_num_timesteps=False)
    resumed = read_task_returns(tmp_path / "all.csv")
    assert resumed[: len(rows)] == rows
    assert [(row["timesteps"], row["trained_task"]) for row in resumed[::3]] == [(0, 0), (32, 0), (64, 1), (96, 2)]


def test_pictures_and_processes():
    """The evaluation environment is wrapped as Stable-Baselines3 wraps that of training, which may be in other processes."""

    def pictures():
        return ContinualEnv([lambda: RandomEnv(spaces.Box(0, 255, (36, 36, 3), np.uint8))] * 2, 16)

    callback = EvalAllTasks(DummyVecEnv([pictures]), n_eval_episodes=1)
    model = PPO("CnnPolicy", pictures(), **ARGUMENTS).learn(32, callback=[TaskSync(), callback])
    assert callback.eval_env.observation_space.shape == (3, 36, 36) and len(model.task_returns) == 3 * 2
    processes = dict(vec_env_cls=SubprocVecEnv, vec_env_kwargs=dict(start_method="forkserver"))
    env = make_vec_env("Continual/CartPole-v1", 2, env_kwargs=CARTPOLE, **processes)
    model = PPO("MlpPolicy", env, **ARGUMENTS).learn(64, callback=[TaskSync(), EvalAllTasks(n_eval_episodes=1)])
    env.close()
    assert [row["trained_task"] for row in model.task_returns[::3]] == [0, 0, 1]


def test_tasks_are_the_environments_own_whatever_a_signal_says():
    signal = TaskSignal(switch_every=1000)  # later than the tasks switch
    model = PPO("MlpPolicy", tasks(), **ARGUMENTS)
    model.learn(64, callback=[TaskSync(), signal, EvalAllTasks(tasks(), n_eval_episodes=1)])
    assert [row["trained_task"] for row in model.task_returns[::3]] == [0, 0, 1]


def test_charts():
    tags = {f"continual_eval/{name}" for name in ("task_0", "average", "forgetting", "zero_shot_transfer")}
    assert len(layout_of(tags)["Evaluations on the tasks"]) == 4


@pytest.mark.parametrize(
    "kwargs, error, message",
    [
        (dict(n_eval_episodes=0), ValueError, "`n_eval_episodes` must be an integer greater than or equal to 1, got 0"),
        (dict(interval=0), ValueError, "`interval` must be .* got 0"),
        (dict(deterministic="no"), TypeError, "`deterministic` must be True or False, got 'no'"),
        (dict(seed=-1), ValueError, "`seed` must be .* got -1"),
        (dict(path=3), TypeError, "`path` must be a path, got 3"),
    ],
)
def test_bad_arguments(kwargs, error, message):
    with pytest.raises(error, match=message):
        EvalAllTasks(**kwargs)


@pytest.mark.parametrize(
    "env, eval_env, error, message",
    [
        (tasks, lambda: None, ValueError, "was not made by gymnasium.make.* give the callback an `eval_env`"),
        (
            tasks,
            lambda: gym.make("Continual/CartPole-v1"),
            ValueError,
            "`eval_env` must have the observations of the training",
        ),
        (tasks, CountEnv, TypeError, "`eval_env` must be a continual environment, got"),
        (tasks, lambda: ContinualEnv([CountEnv], 32), ValueError, "it has 1 tasks instead of 3"),
        (RandomEnv, tasks, TypeError, "EvalAllTasks is for continual environments"),
        (tasks, lambda: VecNormalize(DummyVecEnv([tasks])), ValueError, "wrapped as .*: it alone has a VecNormalize"),
        (lambda: VecNormalize(DummyVecEnv([tasks])), tasks, ValueError, "wrapped as .*: only that has a VecNormalize"),
        (tasks, lambda: random_tasks(spaces.Box(-1e6, 1e6, (1,), np.float32)), ValueError, "must have the actions of the"),
        (lambda: random_tasks(PARTS), lambda: random_tasks(OTHER_PARTS), ValueError, "must have the observations of the"),
    ],
)
def test_environments_that_do_not_fit(env, eval_env, error, message):
    with pytest.raises(error, match=message):
        training_env = env()
        policy = "MultiInputPolicy" if isinstance(training_env.observation_space, spaces.Dict) else "MlpPolicy"
        PPO(policy, training_env, **ARGUMENTS).learn(16, callback=EvalAllTasks(eval_env()))


@pytest.mark.parametrize(
    "make_env, wrap",
    [
        (tasks, lambda env: env),
        (lambda: DummyVecEnv([tasks]), VecMonitor),
        (lambda: SubprocVecEnv([tasks], start_method="forkserver"), VecMonitor),
    ],
)
def test_the_environment_of_training_is_refused(make_env, wrap):
    env = make_env()
    eval_env = wrap(env)
    with pytest.raises(ValueError, match="`eval_env` must be another environment than that of training"):
        PPO("MlpPolicy", env, **ARGUMENTS).learn(16, callback=EvalAllTasks(eval_env))


def test_a_warning_says_that_episodes_may_never_end(monkeypatch):
    monkeypatch.setattr(task_evaluation, "LONG_EPISODE", 6)
    model = PPO("MlpPolicy", tasks(), **ARGUMENTS)
    with pytest.warns(UserWarning, match="EvalTrainedTask: an episode on task 0 goes on after 6 steps.*TimeLimit"):
        model.learn(16, callback=[TaskSync(), EvalTrainedTask(tasks(), n_eval_episodes=1)])


def test_pythons_random_numbers_are_left_as_they_are():
    class Draws(CountEnv):
        def reset(self, **kwargs):
            self.length = random.randint(2, 5)
            return super().reset(**kwargs)

    def draws():
        return ContinualEnv([Draws] * 2, 32)

    states = []
    for callbacks in ([], [EvalAllTasks(draws(), n_eval_episodes=1)]):
        PPO("MlpPolicy", draws(), **ARGUMENTS).learn(48, callback=[TaskSync(), *callbacks])
        states.append(random.getstate())
    assert states[0] == states[1]


def test_a_file_of_another_kind_is_refused(tmp_path):
    (tmp_path / "all.csv").write_text("timesteps,task_id,n_episodes,mean_return\n")
    with pytest.raises(ValueError, match="its first line must be 'timesteps,trained_task"):
        evaluate(tmp_path / "all.csv")


def test_statistics_that_a_signal_restarts_are_those_of_the_moment():
    env, eval_env = (TaskVecNormalize(make_vec_env(tasks)) for _ in range(2))
    callback = Means(eval_env, n_eval_episodes=1)
    PPO("MlpPolicy", env, **ARGUMENTS).learn(48, [TaskSync(), TaskSignal(switch_at=[16]), callback])
    assert callback.counts == [1, 16, 32]
