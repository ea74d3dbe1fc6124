"""ContinualEnv and the registered environments."""

import pickle
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback, EveryNTimesteps
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_cchain import CChainPPO, ContinualEnv, ContinualMetrics, TaskSignal, TaskSync
from sb3_cchain.callbacks.default_callbacks import with_continual_callbacks
from sb3_cchain.envs import ObservationOffset, RewardScale, TaskVecNormalize
from sb3_cchain.envs.registration import CONTINUAL_ENVS
from tests.envs import CountEnv, RandomEnv

GYM_CONTROL_IDS = [f"Continual/{name}" for name, entry in CONTINUAL_ENVS.items() if "gym_control" in entry["entry_point"]]


def three_tasks(steps_per_task=10, **kwargs):
    """Episodes of seven steps."""
    return ContinualEnv([lambda name=name, **kw: CountEnv(name, **kw) for name in range(3)], steps_per_task, **kwargs)


def walk(env, n_steps):
    """Task, end of episode and observation of each step."""
    env.reset(seed=0)
    steps, length = [], 0
    for _ in range(n_steps):
        observation, _, terminated, truncated, info = env.step(0)
        steps.append((info["task_id"], terminated, truncated, int(observation[0])))
        length += 1
        assert info["episode_return"] == length  # one a step
        if terminated or truncated:
            env.reset()
            length = 0
    return steps


def test_a_switch_truncates_the_episode_and_the_next_is_of_the_next_task():
    steps = walk(three_tasks(), 40)
    assert [task for task, *_ in steps] == [0] * 10 + [1] * 10 + [2] * 20  # the last goes on
    assert [i for i, (_, _, truncated, _) in enumerate(steps) if truncated] == [9, 19]
    assert [i for i, (_, terminated, _, _) in enumerate(steps) if terminated] == [6, 16, 26, 33]
    assert all(task == observation for task, _, _, observation in steps)  # the observation is the task's own


def test_steps_may_differ_between_tasks():
    assert [task for task, *_ in walk(three_tasks([3, 5, 1]), 12)] == [0] * 3 + [1] * 5 + [2] * 4


def test_tasks_as_ids():
    env = ContinualEnv(["CartPole-v1", "CartPole-v0"], 30)
    assert env.reset()[1]["task_id"] == 0
    env.set_clock(30)
    assert env.reset()[1]["task_id"] == 1
    assert env.task.spec.id == "CartPole-v0"
    env.close()


def test_one_seed_determines_the_whole_sequence():
    def observations(seed):
        env = three_tasks()
        trace = [env.reset(seed=seed)[0]]
        for _ in range(30):
            observation, _, terminated, truncated, _ = env.step(0)
            trace.append(observation)
            if terminated or truncated:
                trace.append(env.reset()[0])
        return np.array(trace)

    assert np.array_equal(observations(1), observations(1))
    first, second = observations(1), observations(2)
    assert all((first[first.astype(int) == task] != second[second.astype(int) == task]).all() for task in range(3))


def test_a_seed_is_that_of_tasks_that_were_seen_before():
    env, seen = three_tasks(), []
    for _ in range(2):
        env.set_task(0)
        env.reset(seed=1)
        env.set_task(1)
        seen.append(env.reset()[0])
    assert np.array_equal(*seen)


def test_vectorised_environments_are_told_to_switch_together():
    env = three_tasks(n_envs=5)
    assert [task for task, *_ in walk(env, 6)] == [0, 0, 1, 1, 2, 2]


def test_first_task():
    env = three_tasks(first_task=1)
    assert [task for task, *_ in walk(env, 12)] == [1] * 10 + [2] * 2
    record = RecordTasks()
    CChainPPO("MlpPolicy", three_tasks(16, first_task=1), **SETTINGS).learn(32, callback=record)
    assert [record.tasks[step] for step in (1, 16, 17, 32)] == [[1], [1], [2], [2]]


def test_set_task_pins():
    env = three_tasks()
    env.set_task(2)
    assert [task for task, *_ in walk(env, 25)] == [2] * 25
    env.set_task(0)
    assert [task for task, *_ in walk(env, 25)] == [0] * 25


def test_render_modes():
    env = three_tasks(render_mode="rgb_array", first_task=2)
    env.reset()
    assert (env.render() == 2).all()
    assert three_tasks().render_mode is None


@pytest.mark.parametrize(
    "arguments, error, message",
    [
        (([], 10), ValueError, "`tasks` must name at least one task, got an empty list"),
        (("CartPole-v1", 10), TypeError, "`tasks` must be a list .* got the string 'CartPole-v1'"),
        (([3], 10), TypeError, r"`tasks\[0\]` must be an environment id or a callable .* got 3"),
        ((["CartPole-v1"], 0), ValueError, "`steps_per_task` must be an integer greater than or equal to 1, got 0"),
        ((["CartPole-v1"], -5), ValueError, "`steps_per_task` must be .* got -5"),
        ((["CartPole-v1"], 2.5), ValueError, "`steps_per_task` must be an integer .* got 2.5"),
        ((["CartPole-v1"], None), ValueError, "`steps_per_task` must be an integer .* got None"),
        ((["CartPole-v1"], True), ValueError, "`steps_per_task` must be an integer .* got True"),
        ((["CartPole-v1"], "many"), ValueError, "`steps_per_task` must be an integer .* got 'many'"),
        (
            (["CartPole-v1"], [10, 10]),
            ValueError,
            r"`steps_per_task` must be one number or one per task \(1\), got \[10, 10\]",
        ),
        ((["CartPole-v1", "CartPole-v1"], [10, 0]), ValueError, r"`steps_per_task\[1\]` .* got 0"),
        ((["CartPole-v1", lambda: None], 10), TypeError, r"`tasks\[1\]` must make a Gymnasium environment, .* returned None"),
        ((["CartPol-v1"], 10), ValueError, "Unknown environment 'CartPol-v1' .*CartPole"),
        (
            (["CartPole-v1", "Acrobot-v1"], 10),
            ValueError,
            r"same observation_space, but task 0 \(CartPole-v1\) has Box.*\(4,\).* and task 1 \(Acrobot-v1\) has Box.*\(6,\)",
        ),
        (
            (["CartPole-v1", lambda: TimeLimit(RandomEnv(gym.make("CartPole-v1").observation_space), 5)], 10),
            ValueError,
            r"same action_space, but task 0 \(CartPole-v1\) has Discrete\(2\) and task 1 \(RandomEnv\) has Discrete\(3\)",
        ),
    ],
)
def test_bad_arguments(arguments, error, message):
    with pytest.raises(error, match=message):
        ContinualEnv(*arguments)


def test_missing_package_says_what_mends_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "Box2D", None)
    for module in ("lunar_lander", "bipedal_walker", "car_racing", "car_dynamics"):
        monkeypatch.delitem(sys.modules, f"gymnasium.envs.box2d.{module}", raising=False)
    monkeypatch.delitem(sys.modules, "gymnasium.envs.box2d", raising=False)
    with pytest.raises(ImportError, match=r"'LunarLander-v3' needs a package that is not installed: .*pip install"):
        gym.make("Continual/LunarLander-v3")


def test_numpy_numbers_are_numbers():
    assert three_tasks(np.int64(10), n_envs=np.int32(2), first_task=np.int64(1)).steps_per_task == [10] * 3


@pytest.mark.parametrize("call", [lambda env: env.set_task(3), lambda env: env.set_clock(-1), lambda env: env.set_clock(0, 0)])
def test_bad_clock_and_task(call):
    with pytest.raises(ValueError, match="must"):
        call(three_tasks())
    with pytest.raises(ValueError, match="`first_task` must be an integer between 0 and 2, got 3"):
        three_tasks(first_task=3)


# --- Registered environments --------------------------------------------------------------------------------------------


# The suites that have wheels for all versions of Python; the others' tests are in files of their own
@pytest.mark.parametrize("env_id", [*GYM_CONTROL_IDS, "Continual/MinAtar-v0"])
def test_registered_environments_pass_the_checkers(env_id):
    check_env(gym.make(env_id, steps_per_task=100).unwrapped)
    sb3_check_env(gym.make(env_id, steps_per_task=100))


@pytest.mark.parametrize("env_id", GYM_CONTROL_IDS)
def test_gym_control_defaults_are_the_papers(env_id):
    env = gym.make(env_id).unwrapped
    mountain_car = "MountainCar" in env_id
    assert env.n_tasks == (5 if mountain_car else 10)
    assert set(env.steps_per_task) == {320_000 if mountain_car else 160_000}
    assert np.all(env.offsets[0] == 0)
    assert np.std(env.offsets[1:]) == pytest.approx(0.02 if mountain_car else 2.0, rel=0.5)
    env.close()


@pytest.mark.parametrize("env_id, worst", [("Continual/Acrobot-v1", -400), ("Continual/MountainCar-v0", -400)])
def test_episodes_are_cut_at_400_steps(env_id, worst):
    env = gym.make(env_id)
    env.reset(seed=0)
    for step in range(1, 401):
        _, _, terminated, truncated, info = env.step(1)
        assert not terminated and truncated == (step == 400)
    assert info["episode_return"] == worst
    shorter = gym.make(env_id, max_episode_steps=3)
    shorter.reset()
    assert [shorter.step(1)[3] for _ in range(3)] == [False, False, True]
    longer = gym.make(env_id, max_episode_steps=600)  # beyond the environment's own limit
    longer.reset()
    assert not any(longer.step(1)[3] for _ in range(599))


def test_offsets_have_their_own_seed_and_can_be_read_back_and_passed_in():
    default = gym.make("Continual/CartPole-v1").unwrapped.offsets
    env = gym.make("Continual/CartPole-v1")
    env.reset(seed=123)
    assert np.array_equal(env.unwrapped.offsets, default)
    other = gym.make("Continual/CartPole-v1", offset_seed=1).unwrapped.offsets
    assert not np.array_equal(other[1:], default[1:])
    passed_in = gym.make("Continual/CartPole-v1", offsets=other).unwrapped
    assert np.array_equal(passed_in.offsets, other)

    plain, shifted = gym.make("CartPole-v1"), passed_in
    shifted.set_task(3)
    assert np.allclose(shifted.reset(seed=5)[0], plain.reset(seed=5)[0] + other[3])
    assert np.allclose(shifted.step(1)[0], plain.step(1)[0] + other[3])


@pytest.mark.parametrize(
    "kwargs, message",
    [
        ({"n_tasks": 0}, "`n_tasks` must be an integer greater than or equal to 1, got 0"),
        ({"n_tasks": "4"}, "`n_tasks` must be an integer .* got '4'"),
        ({"offset_std": -1.0}, "`offset_std` must be a number greater than or equal to 0, got -1.0"),
        ({"offset_std": float("nan")}, "`offset_std` must be .* got nan"),
        ({"offset_seed": -1}, "`offset_seed` must be an integer .* got -1"),
        ({"offsets": [[1.0], [2.0, 3.0]]}, "`offsets` must be an array of numbers"),
        ({"n_tasks": 1, "offsets": [[0.0, 0.0, 0.0, float("nan")]]}, "`offsets` must be finite"),
        ({"offsets": np.zeros((10, 3))}, r"`offsets` must have the shape .* = \(10, 4\), got \(10, 3\)"),
        ({"n_tasks": 2, "offsets": np.zeros((10, 4))}, r"`offsets` must have the shape .* = \(2, 4\), got \(10, 4\)"),
        ({"env_id": "CartPole-v7"}, "Unknown environment 'CartPole-v7'"),
        ({"env_id": "FrozenLake-v1"}, "`env_id` must be an environment with Box observations"),
        ({"steps_per_task": 0}, "`steps_per_task` must be an integer"),
    ],
)
def test_bad_arguments_of_gym_control(kwargs, message):
    with pytest.raises(ValueError, match=message):
        gym.make("Continual/CartPole-v1", **kwargs)


def test_unknown_continual_environment_names_the_nearest():
    with pytest.raises(gym.error.UnregisteredEnv, match="Acrobot"):
        gym.make("Continual/Acrobat-v1")


def test_offset_wrapper_refuses_what_it_cannot_shift():
    with pytest.raises(TypeError, match="needs Box observations"):
        ObservationOffset(RandomEnv(spaces.Discrete(3)), 1.0)
    with pytest.raises(ValueError, match=r"`offset` must have the observations' shape \(4,\), got \(3,\)"):
        ObservationOffset(RandomEnv(), np.zeros(3))
    with pytest.raises(TypeError, match="needs Box observations of floating-point numbers"):
        ObservationOffset(RandomEnv(spaces.Box(0, 255, (2,), np.uint8)), np.zeros(2))
    for offset in ([np.nan] * 4, [np.inf] * 4):
        with pytest.raises(ValueError, match="`offset` must be finite"):
            ObservationOffset(RandomEnv(), offset)
    with pytest.raises(ValueError, match="`offset` must be an array of numbers, got 'far'"):
        ObservationOffset(RandomEnv(), "far")


def test_importing_form_of_the_id():
    assert gym.make("sb3_cchain:Continual/CartPole-v1").unwrapped.n_tasks == 10


# --- In step with training ------------------------------------------------------------------------------------------------


class RecordTasks(BaseCallback):
    """Task of each environment at each step, by total environment steps."""

    def _on_training_start(self):
        self.tasks = {}

    def _on_step(self):
        self.tasks[self.num_timesteps] = [info["task_id"] for info in self.locals["infos"]]
        return True


SETTINGS = dict(n_steps=16, batch_size=8, n_epochs=1, device="cpu", seed=0)


@pytest.mark.parametrize("vec_env_cls", [None, SubprocVecEnv])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
def test_vectorised_environments_switch_together_in_total_steps(n_envs, vec_env_cls):
    env = make_vec_env(three_tasks, n_envs=n_envs, vec_env_cls=vec_env_cls, env_kwargs=dict(steps_per_task=48))
    record = RecordTasks()
    CChainPPO("MlpPolicy", env, **SETTINGS).learn(48 * 3, callback=record)
    env.close()
    for total_steps, tasks in record.tasks.items():
        assert tasks == [min((total_steps - n_envs) // 48, 2)] * n_envs, total_steps


@pytest.mark.parametrize("normalise", [False, True])
def test_resumed_training_goes_on_with_the_right_task(tmp_path, normalise):
    def make_env():
        env = make_vec_env(three_tasks, env_kwargs=dict(steps_per_task=48))
        return VecNormalize(env) if normalise else env

    CChainPPO("MlpPolicy", make_env(), **SETTINGS).learn(64).save(tmp_path / "model")
    model = CChainPPO.load(tmp_path / "model", env=make_env(), device="cpu")
    record = RecordTasks()
    model.learn(64, callback=record, reset_num_timesteps=False)
    assert [record.tasks[step][0] for step in (65, 96, 97, 128)] == [1, 1, 2, 2]
    # Counting from 0 again begins the sequence again
    model.learn(16, callback=record)
    assert record.tasks[16] == [0]


class RecordEvaluation(BaseCallback):
    """Task that the evaluation environment is on after each evaluation."""

    def __init__(self):
        super().__init__()
        self.tasks = []

    def _on_step(self):
        self.tasks.append((self.num_timesteps, self.parent.eval_env.get_attr("task_id")))
        return True


@pytest.mark.parametrize("algorithm", [CChainPPO, PPO])
@pytest.mark.parametrize("nested", [False, True])
def test_evaluation_follows_the_task_being_trained(algorithm, nested):
    recorded = RecordEvaluation()
    eval_env = make_vec_env(three_tasks, n_envs=2, env_kwargs=dict(steps_per_task=48))
    evaluate = EvalCallback(
        eval_env, eval_freq=1 if nested else 12, callback_after_eval=recorded, n_eval_episodes=9, verbose=0
    )
    callback = CallbackList([EveryNTimesteps(12, evaluate)]) if nested else evaluate
    callbacks = [TaskSync(), callback] if algorithm is PPO else callback
    env = three_tasks(48)
    algorithm("MlpPolicy", env, **SETTINGS).learn(144, callback=callbacks)
    # 9 evaluation episodes of 7 steps are more than a task's 48 steps, yet the task is that of training
    assert recorded.tasks == [(step, [(step - 1) // 48] * 2) for step in range(12, 145, 12)]


@pytest.mark.parametrize(
    "difference, message",
    [
        (dict(n_tasks=3), "it has 3 tasks instead of 2"),
        (dict(offset_seed=1), r"task 1 differs: \('CartPole-v1', \[.*\]\) instead of"),
    ],
)
def test_evaluation_on_other_tasks_is_refused(difference, message):
    env, eval_env = (gym.make("Continual/CartPole-v1", **{"n_tasks": 2, **kwargs}) for kwargs in ({}, difference))
    with pytest.raises(ValueError, match=f"must have the tasks of the training environment, but {message}"):
        CChainPPO("MlpPolicy", env, **SETTINGS).learn(16, callback=EvalCallback(Monitor(eval_env), verbose=0))


def test_a_task_sequence_is_equal_in_another_process_and_differs_with_the_tasks():
    made = [three_tasks(), ContinualEnv(["CartPole-v1"] * 2, 10), gym.make("Continual/Acrobot-v1").unwrapped]
    made.append(gym.make("Continual/MinAtar-v0", games=["Breakout", "Freeway"]).unwrapped)
    sequences = [env.task_sequence for env in made]
    assert [len(sequence) for sequence in sequences] == [env.n_tasks for env in made]
    assert [pickle.loads(pickle.dumps(sequence)) for sequence in sequences] == sequences
    assert sequences[0] == ["CountEnv"] * 3 and sequences[1] == ["CartPole-v1"] * 2
    assert gym.make("Continual/MinAtar-v0", games=["Freeway", "Breakout"]).unwrapped.task_sequence != sequences[3]


@pytest.mark.parametrize(
    "name, makers",
    [
        ("steps_per_task", [lambda: three_tasks(10), lambda: three_tasks(20)]),
        ("first_task", [three_tasks, lambda: three_tasks(first_task=1)]),
        ("task_sequence", [three_tasks, lambda: ContinualEnv([CountEnv] * 2, 10)]),
    ],
)
def test_environments_side_by_side_must_agree(name, makers):
    with pytest.raises(ValueError, match=f"must have the same `{name}`, .* but environment 0 has .* and environment 1 has"):
        CChainPPO("MlpPolicy", DummyVecEnv(makers), **SETTINGS).learn(32)


def two_carts(offset_seed=0, **kwargs):
    """The first task is the same for each seed."""
    return gym.make("Continual/CartPole-v1", **{"n_tasks": 2, "steps_per_task": 32, "offset_seed": offset_seed, **kwargs})


def give(model, env, loaded, folder):
    """The model, in another environment: by ``set_env()``, or loaded into it."""
    if not loaded:
        model.set_env(env)
        return model
    model.save(folder / "model")
    return type(model).load(folder / "model", env=env, device="cpu")


@pytest.mark.parametrize("loaded", [False, True])
@pytest.mark.parametrize(
    "difference, message",
    [
        (dict(offset_seed=1), r"task 1 differs: \['CartPole-v1', \[.*\]\] instead of"),
        (dict(n_tasks=1), "it has 1 tasks instead of 2"),
        (dict(first_task=1), "its first task is 1 instead of 0"),
        (dict(steps_per_task=[16, 48]), r"its tasks have \[16\] steps instead of \[32\]"),
    ],
)
def test_training_does_not_go_on_in_another_task_sequence_unawares(loaded, difference, message, tmp_path):
    model = CChainPPO("MlpPolicy", two_carts(), **SETTINGS).learn(64)
    model = give(model, two_carts(**difference), loaded, tmp_path)
    with pytest.raises(ValueError, match=f"{message}.*TaskSignal.* reset_num_timesteps=True"):
        model.learn(16, reset_num_timesteps=False)
    assert model.num_timesteps == 64
    model.learn(16)
    assert model.num_timesteps == 16 and model.trained_sequence["start"] == 0


class DescribedEnv(ContinualEnv):
    """Describes its tasks by what a saved model would bring back otherwise, or what is not equal to itself."""

    @property
    def task_sequence(self):
        return [{1: np.ones(2), "pair": (1, 2), "gap": float("nan")}] * self.n_tasks


@pytest.mark.parametrize("loaded", [False, True])
def test_the_same_task_sequence_however_it_is_described(loaded, tmp_path):
    def make_env():
        return DescribedEnv([CountEnv] * 2, 32)

    model = CChainPPO("MlpPolicy", make_env(), **SETTINGS).learn(48)
    model = give(model, make_env(), loaded, tmp_path)
    assert model.learn(16, reset_num_timesteps=False).num_timesteps == 64


@pytest.mark.parametrize("loaded", [False, True])
def test_another_task_sequence_begins_with_its_first_task_by_a_signal(loaded, tmp_path):
    model = CChainPPO("MlpPolicy", two_carts(), **SETTINGS).learn(64, TaskSignal())
    tasks = {}
    # The last one has the same tasks and one more
    for env in (two_carts(1), None, two_carts(1, n_tasks=3)):
        if env is not None:
            model = give(model, env, loaded, tmp_path)
        record = RecordTasks()
        model.learn(32, [TaskSignal(), record], reset_num_timesteps=False)
        tasks |= record.tasks
    assert [tasks[step] for step in (65, 96, 97, 128, 129, 160)] == [[0], [0], [1], [1], [2], [2]]
    assert model.trained_sequence["start"] == 64
    rows = {row["timesteps"]: row["task_id"] for row in model.continual_returns}
    assert {rows[step] for step in rows if step <= 64} == {0, 1} and {rows[step] for step in rows if step > 64} == {2, 3, 4}
    with pytest.raises(ValueError, match="it began at step 64, after another one"):
        model.learn(16, reset_num_timesteps=False)
    model.learn(16)
    assert model.trained_sequence["start"] == 0


@pytest.mark.parametrize("loaded", [False, True])
@pytest.mark.parametrize(
    "further, n_steps, task",
    [
        *((dict(), 32, 1), (dict(n_tasks=4), 64, 2), (dict(n_tasks=4), 48, 1)),
        # What has not been trained in yet may be another task
        *((dict(offset_seed=1), 32, 1), (dict(steps_per_task=[32, 64]), 64, 1), (dict(steps_per_task=64), 16, 0)),
    ],
)
def test_the_same_sequence_and_a_longer_one_go_on_at_their_step(loaded, further, n_steps, task, tmp_path):
    model, record = CChainPPO("MlpPolicy", two_carts(), **SETTINGS).learn(n_steps), RecordTasks()
    give(model, two_carts(**further), loaded, tmp_path).learn(16, record, reset_num_timesteps=False)
    assert [record.tasks[step] for step in (n_steps + 1, n_steps + 16)] == [[task]] * 2


def test_what_follows_another_task_sequence_knows_its_time():
    model = PPO("MlpPolicy", two_carts(), **SETTINGS).learn(64, TaskSync())
    model.set_env(two_carts(1))
    model.learn(16, [TaskSync(), TaskSignal()], reset_num_timesteps=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(16, [TaskSignal(), ContinualMetrics()], reset_num_timesteps=False)
    model.set_env(two_carts(1))
    with pytest.warns(UserWarning, match="are at step 0, but training is at step 32"):
        model.learn(16, [TaskSignal(), ContinualMetrics()], reset_num_timesteps=False)


def test_arrays_that_describe_tasks_are_compared(tmp_path):
    class Described(ContinualEnv):
        goal = 1.0

        @property
        def task_sequence(self):
            return [("reach", np.array([self.goal, 0.5])), ("reach", np.float32(2.5))]

    model = CChainPPO("MlpPolicy", Described([CountEnv] * 2, 32), **SETTINGS).learn(16)
    same, other = (Described([CountEnv] * 2, 32) for _ in range(2))
    other.goal = 2.0
    model = give(model, same, True, tmp_path).learn(16, reset_num_timesteps=False)
    model.set_env(other)
    with pytest.raises(ValueError, match=r"task 0 differs: \['reach', \[2.0, 0.5\]\] instead of"):
        model.learn(16, reset_num_timesteps=False)


class HasTaskId(RandomEnv):
    """Numbers tasks in a way of its own, although nobody may set its clock."""

    task_id = "of its own"
    steps_per_task = 5


def test_an_evaluation_callback_needs_an_environment_of_its_own():
    env = make_vec_env("Continual/CartPole-v1", env_kwargs=dict(n_tasks=2, steps_per_task=64))
    for same in (env, DummyVecEnv([lambda: env.envs[0]])):
        with pytest.raises(ValueError, match="must have an environment of its own"):
            CChainPPO("MlpPolicy", env, n_steps=32, batch_size=32).learn(128, EvalCallback(same, eval_freq=32))


def test_environments_that_are_not_continual():
    CChainPPO("MlpPolicy", HasTaskId(), **SETTINGS).learn(16)
    with pytest.raises(TypeError, match="TaskSync is for continual environments"):
        PPO("MlpPolicy", HasTaskId(), **SETTINGS).learn(16, callback=TaskSync())
    named = TransformInfo(RandomEnv(), "kitchen")
    CChainPPO("MlpPolicy", named, reset_churn_coef=True, **SETTINGS).learn(16)
    with pytest.raises(TypeError, match="ContinualMetrics needs an integer as `info\\[\"task_id\"\\]`, got 'kitchen'"):
        PPO("MlpPolicy", named, **SETTINGS).learn(16, callback=ContinualMetrics())


class TransformInfo(gym.Wrapper):
    """Puts a task into the infos."""

    def __init__(self, env, task_id):
        super().__init__(env)
        self.task_id = task_id

    def reset(self, **kwargs):
        return self.env.reset(**kwargs)[0], {"task_id": self.task_id}

    def step(self, action):
        return *self.env.step(action)[:4], {"task_id": self.task_id}


class ResetByHand(BaseCallback):
    """Begins an episode in the middle of training, as users do it."""

    def _on_step(self):
        if self.num_timesteps == 20:
            self.model._last_obs = self.training_env.reset()
        return True


def test_a_reset_by_hand_keeps_tasks_and_metrics():
    record, env = RecordTasks(), TaskVecNormalize(make_vec_env(three_tasks, env_kwargs=dict(steps_per_task=48)))
    model = CChainPPO("MlpPolicy", env, **SETTINGS).learn(80, [record, ResetByHand()], log_interval=None)
    assert [record.tasks[step] for step in (1, 20, 21, 48, 49, 80)] == [[0]] * 4 + [[1]] * 2
    assert env.obs_rms.count == pytest.approx(33, abs=1e-3)
    # One reward a step, whatever episodes it falls in
    assert model.logger.name_to_value["continual/reward_per_step"] == 1


@pytest.mark.parametrize("normalise", [VecNormalize, TaskVecNormalize])
def test_two_normalised_environments_after_each_other(normalise):
    envs = [normalise(make_vec_env(three_tasks, env_kwargs=dict(steps_per_task=48))) for _ in range(2)]
    model, record = CChainPPO("MlpPolicy", envs[0], **SETTINGS), RecordTasks()
    model.learn(32)
    statistics = envs[0].obs_rms.mean.copy()
    model.set_env(envs[1])
    model.learn(32, callback=record, reset_num_timesteps=False)
    assert model.get_vec_normalize_env() is envs[1]
    assert [record.tasks[step] for step in (33, 48, 49, 64)] == [[0], [0], [1], [1]]
    assert np.array_equal(envs[0].obs_rms.mean, statistics)
    assert envs[1].obs_rms.count > 16


def test_callbacks_of_a_derived_class_are_not_added_twice():
    class Mine(ContinualMetrics):
        pass

    given = with_continual_callbacks([Mine()], make_vec_env(three_tasks))
    assert [type(callback) for callback in given] == [TaskSync, Mine]


def test_callbacks_leave_other_environments_alone():
    model = CChainPPO("MlpPolicy", "CartPole-v1", **SETTINGS)
    model.learn(32, callback=EvalCallback(gym.make("CartPole-v1"), eval_freq=16, warn=False, verbose=0))
    assert not any(key.startswith("continual/") for key in model.logger.name_to_value)


def test_reward_scale():
    env = RewardScale(CountEnv(), 0.05)
    env.reset()
    assert env.step(0)[1] == pytest.approx(0.05)
    for scale in (float("nan"), float("inf"), "2", True, None):
        with pytest.raises(ValueError, match="`scale` must be a number, got"):
            RewardScale(CountEnv(), scale)


@pytest.mark.parametrize("value", ["no", "False", 0, 1, None])
def test_what_is_not_a_boolean_is_refused(value):
    with pytest.raises(TypeError, match=f"`difficulty_ramping` must be True or False, got {value!r}"):
        gym.make("Continual/MinAtar-v0", difficulty_ramping=value)
    for name in ("restart", "training", "norm_obs", "norm_reward"):
        with pytest.raises(TypeError, match=f"`{name}` must be True or False, got {value!r}"):
            TaskVecNormalize(make_vec_env(CountEnv), **{name: value})
    assert TaskVecNormalize(make_vec_env(CountEnv), restart=np.bool_(False)).restart == False  # noqa: E712


def test_reset_of_the_coefficient_at_a_switch():
    arguments = dict(churn_warmup=0, churn_window=50, **SETTINGS)
    kept = CChainPPO("MlpPolicy", three_tasks(48), **arguments).learn(96)
    reset = CChainPPO("MlpPolicy", three_tasks(48), reset_churn_coef=True, **arguments).learn(96)
    # 6 iterations, 3 of them of the second task
    assert kept.churn_reducer.coefficient.n_seen == 6
    assert reset.churn_reducer.coefficient.n_seen == 3


def test_offsets_have_the_standard_deviation():
    one, other = (gym.make("Continual/CartPole-v1", offset_std=std).unwrapped.offsets for std in (1.5, 3.0))
    assert np.allclose(2 * one, other)
