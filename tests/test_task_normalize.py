"""Normalisation that restarts at each task."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecCheckNan, VecNormalize

from sb3_cchain import CChainPPO, ContinualEnv, TaskSignal, TaskSync
from sb3_cchain.envs import TaskVecNormalize
from tests.envs import CountEnv, RandomEnv
from tests.method_models import OFF_POLICY, make_env

SETTINGS = dict(n_steps=16, batch_size=8, n_epochs=1, device="cpu", seed=0)


class Noise(gym.Env):
    """Observations and rewards of a mean and a scale of their own; episodes of seven steps."""

    action_space = spaces.Discrete(2)

    def __init__(self, mean=0.0, scale=1.0, as_dict=False):
        self.mean, self.scale, self.as_dict = mean, scale, as_dict
        box = spaces.Box(-np.inf, np.inf, (3,), np.float32)
        self.observation_space = spaces.Dict({"one": box, "two": box}) if as_dict else box

    def observe(self):
        draw = (self.mean + self.scale * self.np_random.normal(size=(2, 3))).astype(np.float32)
        return {"one": draw[0], "two": draw[1]} if self.as_dict else draw[0]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n_steps = 0
        return self.observe(), {}

    def step(self, action):
        self.n_steps += 1
        return self.observe(), self.mean + self.scale * self.np_random.normal(), self.n_steps >= 7, False, {}


def sequence(steps_per_task=30, n_envs=1, as_dict=False, **kwargs):
    tasks = [partial(Noise, mean, scale, as_dict) for mean, scale in ((0.0, 1.0), (5.0, 3.0), (-40.0, 0.5))]
    return ContinualEnv(tasks, steps_per_task, n_envs=n_envs, **kwargs)


def make_sequence(n_envs=1, vec_env_cls=DummyVecEnv, **kwargs):
    # Forked, because several times faster to start
    vec_env_kwargs = {"start_method": "forkserver"} if vec_env_cls is SubprocVecEnv else {}
    env_kwargs = {"n_envs": n_envs, **kwargs}
    arguments = dict(env_kwargs=env_kwargs, vec_env_cls=vec_env_cls, vec_env_kwargs=vec_env_kwargs, seed=3)
    return make_vec_env(sequence, n_envs=n_envs, **arguments)


def play(env, n_steps):
    """First observation, then observation, reward, ends, infos of each step."""
    return [env.reset(), *(env.step(np.zeros(env.num_envs, dtype=int)) for _ in range(n_steps))]


class Moments:
    """Mean and variance of all numbers seen, and of SB3's beginning: 1e-4 numbers of the mean 0 and the variance 1."""

    def __init__(self):
        self.seen = []

    def add(self, batch):
        self.seen.extend(np.asarray(batch, dtype=np.float64))

    def normalise(self, values, centred=True, limit=10.0):
        weight = len(self.seen) + 1e-4
        mean = np.sum(self.seen, axis=0) / weight
        var = (1e-4 + np.sum(np.square(self.seen), axis=0)) / weight - mean**2
        return np.clip((values - (mean if centred else 0)) / np.sqrt(var + 1e-8), -limit, limit)


class Cut(Noise):
    """Every second episode is cut, the others end."""

    n_episodes = 0

    def reset(self, **kwargs):
        self.n_episodes += 1
        return super().reset(**kwargs)

    def step(self, action):
        observation, _, ended, _, info = super().step(action)
        return observation, 1.0, ended and self.n_episodes % 2 == 0, ended and self.n_episodes % 2 == 1, info


@pytest.mark.parametrize("returns_over_cuts", [False, True])
def test_the_discounted_return_over_cuts(returns_over_cuts):
    """It may go on there, as Gymnasium's. It starts over where an episode ends, and at the switch after step 20."""
    env = DummyVecEnv([lambda: ContinualEnv([Cut, Cut], 20)])
    env = TaskVecNormalize(env, gamma=0.5, returns_over_cuts=returns_over_cuts)
    env.reset()
    discounted = 0.0
    for count in range(1, 40):
        env.step(np.zeros(1, dtype=int))
        # Of seven steps each, from the first one of a task: cut, ended, and cut by the switch
        in_task = (count - 1) % 20 + 1
        begins_new = in_task in (14, 20) or (in_task == 7 and not returns_over_cuts)
        discounted = 0.0 if begins_new else 0.5 * discounted + 1.0
        assert (count, env.returns[0]) == (count, pytest.approx(discounted))


def test_the_discounted_return_starts_over_at_a_switch_within_an_episode():
    class Returns(BaseCallback):
        def _on_step(self):
            returns.append(self.training_env.returns[0])
            return True

    env, returns = TaskVecNormalize(DummyVecEnv([lambda: CountEnv(length=100)]), gamma=0.5), []
    CChainPPO("MlpPolicy", env, **SETTINGS).learn(16, [TaskSignal(switch_at=[8]), Returns()])
    before = [2 - 0.5**step for step in range(9)]  # the restart is in the step after the signal's word
    assert returns == pytest.approx([*before[:8], 0.0, *before[:7]])


@pytest.mark.parametrize(
    "n_envs, vec_env_cls, limits",
    [
        (1, DummyVecEnv, {}),
        (3, DummyVecEnv, {}),
        (2, SubprocVecEnv, {}),
        (1, DummyVecEnv, {"clip_obs": 0.7, "clip_reward": 0.4}),
    ],
)
def test_statistics_are_those_since_the_switch(n_envs, vec_env_cls, limits):
    raw, normalised = (make_sequence(n_envs, vec_env_cls, steps_per_task=30 * n_envs) for _ in range(2))
    # With a wrapper in between, as the zoo and others have it
    normalised = TaskVecNormalize(VecCheckNan(normalised), **limits)
    first, *raw_steps = play(raw, 80)
    observation, *steps = play(normalised, 80)
    obs_limit, reward_limit = limits.get("clip_obs", 10.0), limits.get("clip_reward", 10.0)

    seen, returns, discounted = Moments(), Moments(), np.zeros(n_envs)
    seen.add(first)
    assert observation == pytest.approx(seen.normalise(first, limit=obs_limit), abs=1e-5)
    n_switches = 0
    for count, ((raw_obs, raw_rewards, raw_dones, raw_infos), (obs, rewards, dones, infos)) in enumerate(
        zip(raw_steps, steps, strict=True), start=1
    ):
        assert np.array_equal(raw_dones, dones)
        discounted = 0.99 * discounted + raw_rewards
        returns.add(discounted)
        # The reward belongs to the task that the step was made in
        assert rewards == pytest.approx(returns.normalise(raw_rewards, centred=False, limit=reward_limit), rel=1e-4)
        before, switch = seen, count in (30, 60)
        if switch:
            seen, returns, discounted, n_switches = Moments(), Moments(), np.zeros(n_envs), n_switches + 1
        seen.add(raw_obs)
        assert obs == pytest.approx(seen.normalise(raw_obs, limit=obs_limit), abs=1e-4)
        for done, raw_info, info in zip(dones, raw_infos, infos, strict=True):
            assert info["task_id"] == (count - 1) // 30
            if done:
                last = (before if switch else seen).normalise(raw_info["terminal_observation"], limit=obs_limit)
                assert info["terminal_observation"] == pytest.approx(last, abs=1e-4)
        discounted = np.where(dones, 0, discounted)
    assert n_switches == 2
    raw.close(), normalised.close()


class Constant(gym.Env):
    """Always the same observation and reward."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, value):
        self.value = value

    def reset(self, *, seed=None, options=None):
        return np.full(1, self.value, np.float32), {}

    def step(self, action):
        return np.full(1, self.value, np.float32), self.value, False, False, {}


def test_numbers_by_hand():
    env = DummyVecEnv([lambda: ContinualEnv([partial(Constant, 3.0), partial(Constant, 1.0)], 1)])
    env = TaskVecNormalize(env, epsilon=0.0)
    # One observation x beside 1e-4 of the mean 0 and the variance 1: mean x/1.0001, variance
    # 1e-4/1.0001 + 1e-4 x²/1.0001², so that with x = 3: (3 - 2.99970003) / √(0.00099990 - 0.00000010 + ...) = 0.0094863
    assert env.reset() == pytest.approx(3e-4 / 1.0001 / np.sqrt(1e-4 / 1.0001 + 9e-4 / 1.0001**2))
    observation, reward, done, (info,) = env.step(np.zeros(1, int))
    assert done
    # Still the first task's: 3 for the second time is not counted, and the return is 3
    assert info["terminal_observation"] == pytest.approx(0.0094863, abs=1e-6)
    assert reward == pytest.approx(10.0)  # 3 / √0.001 = 94.9, clipped
    # The second task's, with x = 1: 1e-4 / √(2e-4) but for the fifth digit
    assert observation == pytest.approx(0.0070711, abs=1e-6)
    assert env.obs_rms.count == pytest.approx(1.0001)
    assert (env.ret_rms.mean, env.ret_rms.var, env.ret_rms.count) == (0.0, 1.0, 1e-4)
    assert env.returns == [0.0]


def without_times(trace):
    for *_, infos in trace[1:]:
        for info in infos:
            info.pop("episode", None)
    return trace


def equal(one, other):
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(equal(one[key], other[key]) for key in one)
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(equal, one, other))
    return np.array_equal(one, other)


@pytest.mark.parametrize(
    "make_env, arguments",
    [
        (partial(make_sequence, 2), {"restart": False}),
        (partial(make_sequence, 2), {"training": False}),
        (partial(make_sequence, 2, steps_per_task=1000), {}),
        (partial(make_sequence, 2, steps_per_task=1000, as_dict=True), {}),
        (partial(make_sequence, 2, steps_per_task=1000, as_dict=True), {"norm_obs_keys": ["two"], "norm_reward": False}),
        (partial(make_sequence, 2, steps_per_task=1000), {"norm_obs": False, "gamma": 0.9}),
        (partial(make_vec_env, RandomEnv, 2, seed=3), {}),
    ],
)
def test_otherwise_it_is_sb3s(make_env, arguments):
    sb3s = {name: value for name, value in arguments.items() if name != "restart"}

    def trace(env):
        # Reset in the middle, too
        return [without_times(play(env, n_steps)) for n_steps in (50, 20)]

    expected = trace(VecNormalize(make_env(), **sb3s))
    assert equal(trace(TaskVecNormalize(make_env(), **arguments)), expected)
    if arguments == {"restart": False}:
        assert not equal(trace(TaskVecNormalize(make_env())), expected)


def test_restart_of_dict_observations():
    env = TaskVecNormalize(make_sequence(as_dict=True), norm_obs_keys=["two"])
    play(env, 29)
    assert env.obs_rms["two"].count == pytest.approx(30, abs=1e-3)
    raw = make_sequence(as_dict=True)
    expected = play(raw, 30)[-1][0]
    observation = env.step(np.zeros(1, int))[0]
    assert env.obs_rms.keys() == {"two"} and env.obs_rms["two"].count == pytest.approx(1, abs=1e-3)
    assert np.array_equal(observation["one"], expected["one"])
    moments = Moments()
    moments.add(expected["two"])
    assert observation["two"] == pytest.approx(moments.normalise(expected["two"]), abs=1e-5)


def test_rewards_alone():
    env = TaskVecNormalize(make_sequence(), norm_obs=False)
    play(env, 31)
    assert not hasattr(env, "obs_rms")
    assert env.ret_rms.count == pytest.approx(1, abs=1e-3)


# --- Saved, resumed, evaluated --------------------------------------------------------------------------------------------


def test_save_and_load(tmp_path):
    env = TaskVecNormalize(make_sequence(), clip_obs=3.0, gamma=0.5, restart=False)
    play(env, 5)
    env.save(tmp_path / "restart.pkl")
    loaded = VecNormalize.load(tmp_path / "restart.pkl", make_sequence())
    assert type(loaded) is TaskVecNormalize and loaded.restart is False
    assert (loaded.clip_obs, loaded.gamma, loaded.obs_rms.count) == (3.0, 0.5, env.obs_rms.count)

    env = TaskVecNormalize(make_sequence(first_task=1))
    play(env, 5)
    env.save(tmp_path / "second.pkl")
    same_task = TaskVecNormalize.load(tmp_path / "second.pkl", make_sequence(first_task=1))
    play(same_task, 1)
    assert same_task.obs_rms.count == pytest.approx(6 + 2, abs=1e-3)
    other_task = TaskVecNormalize.load(tmp_path / "second.pkl", make_sequence())
    play(other_task, 1)
    assert other_task.obs_rms.count == pytest.approx(2, abs=1e-3)
    evaluated = TaskVecNormalize.load(tmp_path / "second.pkl", make_sequence())
    evaluated.training = False
    play(evaluated, 40)
    assert np.array_equal(evaluated.obs_rms.mean, env.obs_rms.mean) and evaluated.ret_rms.var == env.ret_rms.var


@pytest.mark.parametrize("keep_statistics", [True, False])
def test_resumed_training(tmp_path, keep_statistics):
    env = TaskVecNormalize(make_sequence(steps_per_task=48))
    CChainPPO("MlpPolicy", env, **SETTINGS).learn(64).save(tmp_path / "model")
    env.save(tmp_path / "statistics.pkl")
    # The 16 steps of the second task, and its first observation
    assert env.obs_rms.count == pytest.approx(17, abs=1e-3) and env.ret_rms.count == pytest.approx(16, abs=1e-3)

    new = make_sequence(steps_per_task=48)
    new = TaskVecNormalize.load(tmp_path / "statistics.pkl", new) if keep_statistics else TaskVecNormalize(new)
    model = CChainPPO.load(tmp_path / "model", env=new, device="cpu")
    model.learn(16, reset_num_timesteps=False)
    # It is reset into the first task before it is told the time, which leaves no trace
    assert new.obs_rms.count == pytest.approx(17 * keep_statistics + 17, abs=1e-3)
    assert new.ret_rms.count == pytest.approx(16 * keep_statistics + 16, abs=1e-3)
    # From the first task again
    model.learn(16)
    assert new.obs_rms.count == pytest.approx(17, abs=1e-3)


class RecordStatistics(BaseCallback):
    """Statistics of training and evaluation after each evaluation."""

    def __init__(self):
        super().__init__()
        self.rows = []

    def _on_step(self):
        envs = self.training_env, self.parent.eval_env
        self.rows.append([self.num_timesteps, *(env.obs_rms.count for env in envs), *(env.obs_rms.mean for env in envs)])
        return True


@pytest.mark.parametrize("is_reset_before", [False, True])
def test_a_task_that_is_chosen_is_no_switch_after_forget_task(is_reset_before):
    env = TaskVecNormalize(make_sequence())
    env.reset()
    for _ in range(10):
        env.step(np.zeros(1, dtype=int))
    for task_id, forgets, count in ((2, True, 12), (1, False, 1)):
        env.env_method("set_task", task_id)
        if forgets:
            if is_reset_before:
                env.reset()
            env.forget_task()
        env.reset()
        assert env.obs_rms.count == pytest.approx(count, abs=0.01)
        env.step(np.zeros(1, dtype=int))


@pytest.mark.parametrize("n_envs", [1, 2])
def test_evaluation_has_the_statistics_of_training(n_envs):
    recorded = RecordStatistics()
    # Of another number of environments, and with more steps in an evaluation than a task has
    eval_env = TaskVecNormalize(make_sequence(1, steps_per_task=48), training=False, norm_reward=False)
    callback = EvalCallback(eval_env, eval_freq=16 // n_envs, n_eval_episodes=9, callback_after_eval=recorded, verbose=0)
    env = TaskVecNormalize(make_sequence(n_envs, steps_per_task=48))
    CChainPPO("MlpPolicy", env, **{**SETTINGS, "n_steps": 16 // n_envs}).learn(144, callback=callback)
    expected = {16: 16, 32: 32, 48: 0, 64: 16, 80: 32, 96: 0, 112: 16, 128: 32, 144: 48}
    assert [row[0] for row in recorded.rows] == list(expected)
    for step, count, eval_count, mean, eval_mean in recorded.rows:
        assert count == pytest.approx(expected[step] + n_envs, abs=1e-3)
        assert eval_count == count and np.array_equal(eval_mean, mean)


def test_another_algorithm():
    env = TaskVecNormalize(make_sequence(steps_per_task=40))
    model = DQN("MlpPolicy", env, buffer_size=200, learning_starts=20, batch_size=8, device="cpu", seed=0)
    model.learn(60, callback=TaskSync())
    assert env.obs_rms.count == pytest.approx(21, abs=1e-3)
    # The buffer has them as they are, and normalises what is sampled with the present statistics
    observations, next_observations = model.replay_buffer.observations, model.replay_buffer.next_observations
    assert observations[40].mean() == pytest.approx(5, abs=6)
    assert not np.array_equal(next_observations[39], observations[40])  # the first task's last one


def test_environments_whose_task_is_not_told():
    env = TaskVecNormalize(make_vec_env(CountEnv, 2, seed=0))
    play(env, 20)
    assert env.obs_rms.count == pytest.approx(42, abs=1e-3)


def test_a_switch_that_a_signal_did_not_tell_is_not_heard_later():
    env = TaskVecNormalize(make_sequence(steps_per_task=16))
    model = CChainPPO("MlpPolicy", env, **SETTINGS).learn(32, TaskSignal(switch_at=[1000]))
    model.learn(16, reset_num_timesteps=False)
    # The third task has begun at step 32
    assert env.obs_rms.count == pytest.approx(49, abs=1e-3)


def test_the_first_transition_after_a_sync_is_of_the_task_that_is_due():
    envs = [VecNormalize(make_vec_env(make_env, 1)) for _ in range(2)]
    model = DQN("MlpPolicy", envs[0], device="cpu", seed=0, **OFF_POLICY).learn(40, TaskSync())
    model.set_env(envs[1])
    model.learning_starts = 10**6
    model.replay_buffer.reset()
    model.learn(1, TaskSync(), reset_num_timesteps=False)
    assert 1 <= model.replay_buffer.observations[0, 0, 0] <= 1.1
