"""Where the signal of a task switch comes from, and that everything hears of it."""

import builtins
import warnings
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

from sb3_cchain import CChainCallback, ContinualMetrics, TaskSignal, TrainingCheckpoint, resume, task_switched
from sb3_cchain.analysis.inspection import inspect_model
from sb3_cchain.callbacks import TaskLearningStarts, TaskSchedule, read_returns
from sb3_cchain.envs import TaskVecNormalize
from sb3_cchain.methods import (
    EWC,
    FIRE,
    EntropyBonusRestart,
    EWCConsolidation,
    ExplorationRateRestart,
    LayerReset,
    LogStdRestart,
    Oracle,
    PlasticityInjection,
    ShrinkAndPerturb,
)
from sb3_cchain.methods.registry import FAMILY_PAGE, REGISTRY
from sb3_cchain.methods.switch_or_interval import SwitchOrInterval
from sb3_cchain.networks import InjectionPolicy
from sb3_cchain.tasks import TaskBoundary
from sb3_cchain.tasks.task_signal import _equal
from tests.envs import CountEnv
from tests.method_models import make_callback, make_env, make_model, optimizer_arguments

SWITCH = 32


class World(CountEnv):
    """Episodes of two steps. After ``change_at`` steps it has another level and other rewards, and says so in its info."""

    difficulty = 1

    def __init__(self, change_at=SWITCH):
        super().__init__(length=2)
        self.change_at, self.n_steps_so_far, self.level = change_at, 0, "easy"

    def reset(self, **kwargs):
        return super().reset(**kwargs)[0], {"level": self.level}

    def step(self, action):
        info = {"level": self.level}
        self.n_steps_so_far += 1
        result = super().step(action)[:4]
        if self.n_steps_so_far == self.change_at:
            self.level, self.task_reward = "hard", -5.0
        return *result, info


def long_world():
    """One whose episode does not end."""
    world = World()
    world.length = 10**6
    return world


class Curriculum(BaseCallback):
    """Calls a function at one environment step."""

    def __init__(self, function, at=SWITCH):
        super().__init__()
        self.function, self.at = function, at

    def _on_step(self):
        if self.num_timesteps == self.at:
            self.function(self)
        return True


def say(callback):
    task_switched(callback.model)


def make_harder(callback):
    callback.training_env.env_method("__setattr__", "difficulty", 2)


# Each source, and the callbacks that go before it
SOURCES = {
    "info": ([], dict(key="level")),
    "attribute": ([], dict(attribute="level")),
    "env_method": ([lambda: Curriculum(make_harder)], dict(attribute="difficulty")),
    "switch_every": ([], dict(switch_every=SWITCH)),
    "switch_at": ([], dict(switch_at=[SWITCH])),
    "task_switched": ([lambda: Curriculum(say)], {}),
    "drift": ([], dict(drift="adwin")),
    "set_env": ([], {}),
}
# With 16 episodes before the switch, the detector hears of it after 13 more, of two steps
DELAY = {"drift": 26}
# Up to here there is one switch
N_STEPS = 2 * SWITCH - 4


def signals(source):
    before, arguments = SOURCES[source]
    return [*(make() for make in before), TaskSignal(**arguments)]


def train(model, source, callbacks):
    """One training, in which the task switches once."""
    n_steps = N_STEPS + DELAY.get(source, 0)
    if source != "set_env":
        return model.learn(n_steps, callback=[*signals(source), *callbacks], log_interval=None)
    other = model.env.envs[0].unwrapped.__class__()
    for world, steps in ((model.env, SWITCH), (other, n_steps - SWITCH)):
        model.set_env(world)
        model.learn(steps, [*signals(source), *callbacks], log_interval=None, reset_num_timesteps=False)
    return model


by_source = pytest.mark.parametrize("source", SOURCES)


@by_source
@pytest.mark.parametrize("algorithm", ["PPO", "DQN", "CChainPPO"])
def test_returns_are_those_of_the_tasks(tmp_path, algorithm, source):
    path = tmp_path / "returns.csv"
    model = make_model(algorithm, World())
    train(model, source, [ContinualMetrics(path)])
    rows = read_returns(path)
    assert list(dict.fromkeys(row["task_id"] for row in rows)) == [0, 1]
    begins = SWITCH + DELAY.get(source, 0)
    assert sum(row["n_episodes"] for row in rows if row["task_id"] == 0) == begins / 2
    assert model.continual_state["n_switches"] == 1
    assert {"continual/task_id", "continual/average_task_1"} <= model.logger.name_to_value.keys()


def count_calls(owner, name):
    """:return: A list that grows by one at each call of a method"""
    calls, method = [], getattr(owner, name)

    def call(*args, **kwargs):
        calls.append(True)
        return method(*args, **kwargs)

    setattr(owner, name, call)
    return calls


def boundary(make, ppo_policy="MlpPolicy", **policy_kwargs):
    def listener(algorithm):
        callback = make()
        model = make_model(algorithm, World(), policy=ppo_policy, policy_kwargs=dict(net_arch=[8], **policy_kwargs))
        return model, [callback], count_calls(callback, "_on_task_switch")

    return listener


def gaussian(algorithm):
    class Continuous(World):
        action_space = spaces.Box(-1, 1, (2,), np.float32)

    callback = LogStdRestart()
    return make_model("PPO", Continuous()), [callback], count_calls(callback, "_on_task_switch")


def coefficient_of_the_model(algorithm):
    model = make_model(f"CChain{algorithm}", World(), reset_churn_coef=True)
    return model, [], count_calls(model.churn_reducer.coefficient, "reset")


def coefficient_of_the_callback(algorithm):
    callback, calls = CChainCallback(reset_churn_coef=True), []
    on_start = callback._on_training_start

    def on_training_start():
        on_start()
        method = callback.churn_reducer.coefficient.reset
        callback.churn_reducer.coefficient.reset = lambda: (calls.append(True), method())

    callback._on_training_start = on_training_start
    return make_model(algorithm, World()), [callback], calls


def normalization(algorithm):
    env = TaskVecNormalize(make_vec_env(World))
    return make_model(algorithm, env), [], count_calls(env, "_restart")


def learning_starts(algorithm):
    callback = TaskLearningStarts(4)
    model = make_model("DQN", World())

    class Calls:
        def __len__(self):
            return {4: 0, SWITCH + 4: 1, SWITCH + DELAY["drift"] + 4: 1}[model.learning_starts]

    return model, [callback], Calls()


LISTENERS = {
    "Oracle": boundary(Oracle),
    "ShrinkAndPerturb": boundary(lambda: ShrinkAndPerturb(0.5, interval=None)),
    "LayerReset": boundary(LayerReset),
    "FIRE": boundary(FIRE),
    "PlasticityInjection": boundary(PlasticityInjection, InjectionPolicy),
    "EWCConsolidation": boundary(EWCConsolidation, optimizer_class=EWC),
    "ExplorationRateRestart": boundary(ExplorationRateRestart),
    "EntropyBonusRestart": boundary(EntropyBonusRestart),
    "LogStdRestart": gaussian,
    "TaskSchedule": boundary(lambda: TaskSchedule(SWITCH)),
    "TaskLearningStarts": learning_starts,
    "CChain": coefficient_of_the_model,
    "CChainCallback": coefficient_of_the_callback,
    "TaskVecNormalize": normalization,
}
# Oracle with both algorithms, the others in turn
WITH_DQN = {"Oracle", "ShrinkAndPerturb", "LayerReset", "ExplorationRateRestart", "TaskLearningStarts", "CChainCallback"}
WITH_PPO = LISTENERS.keys() - WITH_DQN | {"Oracle"}


LISTENERS_OF_SOURCES = [
    (algorithm, name, source)
    for algorithm, names in (("PPO", WITH_PPO), ("DQN", WITH_DQN))
    for name in sorted(names)
    for source in SOURCES
    # Another environment has normalisation of its own
    if (name, source) != ("TaskVecNormalize", "set_env")
]


@pytest.mark.parametrize("algorithm, name, source", LISTENERS_OF_SOURCES)
def test_every_listener_hears_every_source(algorithm, name, source):
    model, callbacks, calls = LISTENERS[name](algorithm)
    train(model, source, callbacks)
    assert len(calls) == 1


def test_every_boundary_is_a_listener_here():
    kinds = [*TaskBoundary.__subclasses__(), *SwitchOrInterval.__subclasses__()]
    classes = {cls.__name__ for cls in kinds if cls.__module__.startswith("sb3_cchain.") and cls is not SwitchOrInterval}
    assert classes <= LISTENERS.keys() and {"Oracle", "TaskSchedule"} <= classes


@pytest.mark.parametrize("method", [m for m in REGISTRY if m.page != FAMILY_PAGE], ids=lambda method: method.algo)
def test_every_method_trains_with_a_signal(method):
    policy_kwargs = {**method.policy_kwargs, "net_arch": [8]}
    if method.optimizer_class is not None:
        policy_kwargs.update(optimizer_class=method.optimizer_class, optimizer_kwargs=optimizer_arguments(method))
    model = make_model(method.algorithm.__name__, World(), policy=method.policy, policy_kwargs=policy_kwargs)
    callbacks = [make_callback(cls) for cls in method.callbacks]
    model.learn(SWITCH + 16, [TaskSignal(switch_at=[SWITCH]), *callbacks, ContinualMetrics()])
    assert model.continual_state["n_switches"] == 1


def test_c_chain_adds_the_metrics_by_itself():
    for callback, is_logged in ((None, False), (TaskSignal(switch_every=16), True)):
        model = make_model("CChainPPO", CountEnv()).learn(48, callback=callback, log_interval=None)
        assert ("continual/n_switches" in model.logger.name_to_value) == is_logged
    assert model.logger.name_to_value["continual/n_switches"] == 2


def test_a_continual_environment_is_heard_as_without_a_signal():
    rows = []
    for callbacks in ([], [TaskSignal()]):
        metrics = ContinualMetrics()
        make_model("CChainPPO").learn(96, [*callbacks, metrics])
        rows.append(metrics.rows)
    assert rows[0] == rows[1] and {row["task_id"] for row in rows[0]} == {0, 1, 2}


def test_a_source_takes_the_place_of_the_environments_numbers():
    oracle = Oracle()
    model = make_model("CChainPPO").learn(96, [TaskSignal(switch_at=[16]), oracle])
    assert oracle.n_resets == model.continual_state["n_switches"] == 1


def test_without_a_signal_the_user_is_heard():
    oracle, metrics = Oracle(), ContinualMetrics()
    model = make_model("PPO", CountEnv())
    model.learn(32, metrics)
    task_switched(model)
    model.learn(32, [metrics, oracle], reset_num_timesteps=False)
    assert model.continual_state["n_switches"] == 1
    model.learn(32, [metrics], reset_num_timesteps=False)
    assert model.continual_state["n_switches"] == 1
    model.learn(32, metrics)
    assert {row["task_id"] for row in metrics.rows} == {0}


def test_the_user_does_not_contradict_the_environment():
    model = make_model("PPO").learn(16)
    with pytest.raises(ValueError, match=r"where the environment numbers its tasks itself, in info\['task_id'\]"):
        task_switched(model)


class HalfTold(World):
    """Has its tasks in the infos of steps, and of resets if wanted."""

    in_reset = False

    def reset(self, **kwargs):
        return super().reset(**kwargs)[0], {"task_id": int(self.level == "hard")} if self.in_reset else {}

    def step(self, action):
        task_id = int(self.level == "hard")
        return *super().step(action)[:4], {"task_id": task_id}


@pytest.mark.parametrize("follower", ["Oracle", "TaskLearningStarts", "TaskVecNormalize"])
@pytest.mark.parametrize("in_reset, signals", [(False, []), (True, []), (False, [TaskSignal])])
def test_a_task_that_is_told_in_steps_alone_is_warned_of(follower, in_reset, signals):
    world = HalfTold()
    world.in_reset = in_reset
    env = make_vec_env(lambda: world)
    callbacks = [make() for make in signals] + [ContinualMetrics()]
    callbacks += {"Oracle": [Oracle()], "TaskLearningStarts": [TaskLearningStarts(8)], "TaskVecNormalize": []}[follower]
    algorithm = "DQN" if follower == "TaskLearningStarts" else "PPO"
    model = make_model(algorithm, TaskVecNormalize(env) if follower == "TaskVecNormalize" else env)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(2):
            model.learn(32, callbacks, reset_num_timesteps=False)
    n_warnings = sum("infos of step(), but not in those of reset()" in str(warning.message) for warning in caught)
    assert n_warnings == (not in_reset and not signals)
    assert model.continual_state["n_switches"] == 1


def test_two_reports_at_a_step_are_one_switch():
    """The call, another environment, and an attribute that differs there."""
    worlds, metrics = [World(), World()], ContinualMetrics()
    worlds[1].difficulty = 2
    model = make_model("PPO", worlds[0])
    signal = TaskSignal(attribute="difficulty")
    model.learn(16, [signal, metrics])
    task_switched(model)
    model.set_env(worlds[1])
    model.learn(16, [signal, metrics], reset_num_timesteps=False)
    assert model.continual_state["n_switches"] == 2 - 1


def test_the_info_and_a_call_at_a_step_are_one_switch():
    # The info tells of the new level a step after the change
    model = make_model("PPO", long_world())
    model.learn(48, [Curriculum(say, SWITCH + 1), TaskSignal(key="level"), ContinualMetrics()])
    assert model.continual_state["n_switches"] == 1


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
@pytest.mark.parametrize("algorithm", ["PPO", "DQN"])
def test_an_episode_that_goes_on_over_calls_of_learn_does_not_switch_back(algorithm, vec_env_cls):
    env = make_vec_env(long_world, vec_env_cls=vec_env_cls)
    model = make_model(algorithm, env)
    for _ in range(4):
        model.learn(16, [TaskSignal(key="level"), ContinualMetrics()], reset_num_timesteps=False)
    env.close()
    assert model.continual_state["n_switches"] == 1


def test_a_world_that_comes_back_is_a_new_task():
    class Cycle(World):
        def step(self, action):
            result = super().step(action)
            self.level = "hard" if 16 <= self.n_steps_so_far < 32 else "easy"
            return result

    metrics = ContinualMetrics()
    make_model("PPO", Cycle(10**9)).learn(48, [TaskSignal(attribute="level"), metrics])
    assert list(dict.fromkeys(row["task_id"] for row in metrics.rows)) == [0, 1, 2]


def test_an_attribute_that_is_changed_in_place():
    class InPlace(CountEnv):
        masses = np.ones(2)

    oracle = Oracle()

    def change(callback):
        callback.training_env.get_attr("masses")[0][1] = 5

    make_model("PPO", InPlace()).learn(48, [Curriculum(change, 20), TaskSignal(attribute="masses"), oracle])
    assert oracle.n_resets == 1


def test_a_loop_that_begins_as_any_training():
    """The first ``learn()`` without ``reset_num_timesteps=False``, and a stock model with λ to reset."""
    c_chain, oracle, resets = CChainCallback(reset_churn_coef=True), Oracle(), []
    model = make_model("PPO", CountEnv())
    for reset in (True, False, False):
        model.learn(32, [TaskSignal(), ContinualMetrics(), c_chain, oracle], reset_num_timesteps=reset)
        resets.append(oracle.n_resets)
        model.set_env(CountEnv())
    assert resets == [0, 1, 1] and model.continual_state["n_switches"] == 2


@pytest.mark.parametrize("kwargs", [{}, dict(vec_env_cls=SubprocVecEnv, vec_env_kwargs=dict(start_method="forkserver"))])
def test_environments_side_by_side(kwargs):
    oracle = Oracle()
    env = make_vec_env(World, 2, **kwargs)
    make_model("PPO", env, n_steps=8).learn(96, [TaskSignal(attribute="level"), oracle])
    env.close()
    assert oracle.n_resets == 1


@pytest.mark.parametrize("source", [dict(key="level"), dict(attribute="level"), dict(switch_every=SWITCH)])
def test_methods_act_before_the_first_step_of_the_new_world(source):
    """Of one that changes between two rollouts, where an episode ends."""
    oracle, heard = Oracle(), []
    model = make_model("PPO", World())
    oracle._on_task_switch = lambda: heard.append(model.num_timesteps)
    model.learn(SWITCH + 16, [TaskSignal(**source), oracle])
    assert heard == [SWITCH]


@pytest.mark.parametrize("step, expected", [(0, 32), (16, 32), (32, 64), (64, None)])
@pytest.mark.parametrize("arguments", [dict(switch_every=32), dict(switch_at=[32, 64])], ids=["every", "at"])
def test_the_next_switch(arguments, step, expected):
    signal = TaskSignal(**arguments)
    signal.model, signal.num_timesteps = SimpleNamespace(_total_timesteps=96), step
    assert signal.next_switch == expected


@pytest.mark.parametrize("arguments", [dict(switch_every=20), dict(switch_at=[20, 40, 60])], ids=["every", "at"])
def test_the_last_rollout_begins_no_task(arguments):
    """Its 16 steps end at step 48."""
    model, metrics = make_model("PPO", CountEnv()), ContinualMetrics()
    model.learn(40, [TaskSignal(**arguments), metrics])
    assert [(row["timesteps"], row["task_id"]) for row in metrics.rows] == [(16, 0), (32, 1), (48, 1)]
    model.learn(12, [TaskSignal(**arguments), metrics], reset_num_timesteps=False)
    assert [(row["timesteps"], row["task_id"]) for row in metrics.rows[3:]] == [(64, 2)]


def test_a_training_that_begins_anew_begins_with_task_0():
    model, signal = make_model("PPO", CountEnv()).learn(32, TaskSignal(switch_at=[16])), TaskSignal()
    model.learn(16, signal)
    assert signal.next_task == 0


@pytest.mark.parametrize("with_metrics", [True, False])
def test_an_episode_that_goes_on_is_no_new_world(with_metrics):
    model, callbacks = make_model("PPO", long_world()), [ContinualMetrics()] if with_metrics else []
    for _ in range(4):
        signal = TaskSignal(key="level")
        model.learn(16, [signal, *callbacks], reset_num_timesteps=False)
    assert signal.next_task == 1


def test_a_reset_between_calls_of_learn_is_heard():
    """Into a world that changed meanwhile."""
    model, world = make_model("PPO", long_world()), long_world()
    model.learn(16, TaskSignal(key="level"))
    world.level, signal, tasks = "hard", TaskSignal(key="level"), []
    model.set_env(world)
    look = Curriculum(lambda _: tasks.append(signal.step_task), at=17)
    model.learn(16, [signal, look], reset_num_timesteps=False)
    assert tasks == [1]


def test_a_switch_in_the_middle_of_an_episode_is_heard_at_the_next_rollout():
    oracle, heard = Oracle(), []
    model = make_model("DQN", CountEnv(length=10**6))
    oracle._on_task_switch = lambda: heard.append(model.num_timesteps)
    model.learn(40, [TaskSignal(switch_at=[17, 30]), oracle])
    assert heard == [17, 30]


def test_an_interrupted_signal_is_silent_in_the_next_training():
    def stop(callback):
        raise KeyboardInterrupt

    model, metrics = make_model("PPO"), ContinualMetrics()
    signal = TaskSignal(switch_at=[8])
    with pytest.raises(KeyboardInterrupt):
        model.learn(32, [signal, Curriculum(stop, 20)])
    model.learn(96, metrics)
    assert {row["task_id"] for row in metrics.rows} == {0, 1, 2}


@pytest.mark.parametrize("algorithm", ["PPO", "DQN"])
def test_a_saved_model_goes_on_counting(tmp_path, algorithm):
    model = make_model(algorithm, World())
    model.learn(SWITCH + 8, [TaskSignal(attribute="level"), ContinualMetrics()]).save(tmp_path / "model")
    world = World()
    loaded = type(model).load(tmp_path / "model", env=world, device="cpu")
    # Its level is the first one again, which is another one than the last
    loaded.learn(16, [TaskSignal(attribute="level"), ContinualMetrics()], reset_num_timesteps=False)
    assert loaded.continual_state["n_switches"] == 2 and loaded.continual_state["task_id"] == 2


@pytest.mark.parametrize("arguments", [dict(drift="adwin"), dict(attribute="level"), dict(switch_every=20)])
@pytest.mark.parametrize("algorithm", ["PPO", "DQN"])
def test_resumed_exactly(tmp_path, algorithm, arguments):
    """Saved a little before the switch is heard, training goes on to the same switch."""

    def callbacks(folder):
        return [TaskSignal(**arguments), ContinualMetrics(), Oracle(), TrainingCheckpoint(16, folder, keep=10)]

    make_model(algorithm, World()).learn(64, whole := callbacks(tmp_path / "whole"))
    (checkpoint,) = (tmp_path / "whole").glob("step_*16")
    resume(checkpoint, World(), resumed := callbacks(tmp_path / "resumed"))
    assert resumed[1].rows == whole[1].rows
    assert {row["task_id"] for row in whole[1].rows} > {0}


@pytest.mark.parametrize("arguments", [dict(key="level"), dict(attribute="level")])
def test_a_new_world_starts_no_random_actions_where_training_is_resumed_exactly(tmp_path, arguments):
    """Until its state is put back, it has the first level again."""

    def callbacks(folder):
        return [TaskSignal(**arguments), TaskLearningStarts(8), TrainingCheckpoint(16, folder, keep=10)]

    whole = make_model("DQN", World()).learn(64, callbacks(tmp_path / "whole"))
    (checkpoint,) = (tmp_path / "whole").glob("step_*48")
    resumed = resume(checkpoint, World(), callbacks(tmp_path / "resumed"))
    for name, parameter in whole.policy.state_dict().items():
        assert parameter.equal(resumed.policy.state_dict()[name]), name


def test_drift_of_a_logged_value():
    """Value error and churn are what the algorithm logs."""
    model, heard, signal = make_model("PPO", CountEnv()), [], TaskSignal(drift="adwin", drift_of="train/value_loss")
    signal._detector = SimpleNamespace(update=lambda value: heard.append(value) or len(heard) == 3, reset=lambda: None)
    losses = []

    class Spy(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_start(self):
            losses.append(self.logger.name_to_value.get("train/value_loss"))

    model.learn(80, [signal, Spy()])
    assert heard == losses[1:] and len(heard) == 4
    assert signal.next_task == 1


def test_the_returns_of_all_environments_are_watched():
    signal, heard = TaskSignal(drift="adwin"), []
    signal._detector = SimpleNamespace(update=heard.append, reset=lambda: None)
    envs = VecMonitor(DummyVecEnv([lambda length=length: CountEnv(length=length) for length in (1000, 2)]))
    make_model("PPO", envs, n_steps=8).learn(16, signal)
    assert heard == [2.0] * 4


@pytest.mark.parametrize("reason", ["drift", "call"])
def test_the_detector_starts_over_when_methods_have_acted(reason):
    """At the rollout after the switch, before it watches anything else."""
    signal, events = TaskSignal(drift="adwin"), []
    model = make_model("PPO", World())

    def update(value):
        events.append(("value", model.num_timesteps))
        return reason == "drift" and model.num_timesteps == 20

    signal._detector = SimpleNamespace(update=update, reset=lambda: events.append(("reset", model.num_timesteps)))
    model.learn(48, [Curriculum(say if reason == "call" else lambda _: None, 20), signal])
    assert [event for event in events if event[0] == "reset"] == [("reset", 32)]
    assert signal.next_task == 1


def test_river_is_asked_for(monkeypatch):
    original = builtins.__import__

    def without_river(name, *args, **kwargs):
        if name.startswith("river"):
            raise ImportError(name)
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_river)
    with pytest.raises(ImportError, match=r'pip install "sb3-cchain\[drift\]"'):
        TaskSignal(drift="adwin")


@pytest.mark.parametrize(
    "arguments, error, message",
    [
        (
            dict(attribute="level", switch_every=3),
            ValueError,
            "one source, got attribute='level', switch_every=3: give one of",
        ),
        (dict(switch_every=3, switch_at=[3]), ValueError, "one source"),
        (dict(drift="adwin", key="level"), ValueError, "one source"),
        (dict(key=3), TypeError, "`key` must be a string, got 3"),
        (dict(attribute=["level"]), TypeError, r"`attribute` must be a string, got \['level'\]"),
        (dict(switch_every=0), ValueError, "`switch_every` must be an integer greater than or equal to 1, got 0"),
        (dict(switch_at=[]), ValueError, "`switch_at` must name at least one"),
        (dict(switch_at=7), TypeError, "`switch_at` must be a list of environment steps, got 7"),
        (dict(switch_at=[0]), ValueError, r"`switch_at\[0\]` must be an integer greater than or equal to 1, got 0"),
        (dict(switch_at=[5, 5]), ValueError, r"`switch_at\[1\]` must be an integer greater than or equal to 6, got 5"),
        (dict(switch_at=[1_000_000] * 2), ValueError, "greater than or equal to 1000001, got 1000000"),
        (dict(drift="page"), ValueError, "`drift` must be one of 'adwin', got 'page'"),
        *(
            (dict(drift="adwin", drift_delta=delta), ValueError, "must be a number greater than 0 and less than 1, got")
            for delta in (0, 1)
        ),
    ],
)
def test_bad_arguments(arguments, error, message):
    with pytest.raises(error, match=message):
        TaskSignal(**arguments)


@pytest.mark.parametrize(
    "arguments, error, message",
    [
        (dict(key="lvl"), ValueError, r"the environment's info must have 'lvl', but it has .*'level'"),
        (dict(attribute="lvl"), ValueError, "`attribute` must be one of the environment or of a wrapper, but none has 'lvl'"),
    ],
)
def test_a_source_that_is_not_there(arguments, error, message):
    with pytest.raises(error, match=message):
        make_model("PPO", World()).learn(16, TaskSignal(**arguments))


def test_returns_need_a_monitor():
    model = make_model("PPO", make_vec_env(World))
    model.set_env(model.env.__class__([World]))  # nobody records episodes
    with pytest.raises(ValueError, match=r"wrap it in stable_baselines3.common.monitor.Monitor"):
        model.learn(16, TaskSignal(drift="adwin"))


@pytest.mark.parametrize("make, algorithm", [(Oracle, "PPO"), (ContinualMetrics, "PPO"), (TaskLearningStarts, "DQN")])
def test_the_signal_comes_first(make, algorithm):
    with pytest.raises(ValueError, match=f"TaskSignal must come before {make.__name__}"):
        make_model(algorithm, CountEnv()).learn(16, [make(), TaskSignal()])


def test_another_environment_in_a_training_that_begins_anew_is_warned_of():
    model = make_model("PPO", CountEnv()).learn(16, TaskSignal())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(16, TaskSignal())
    model.set_env(CountEnv())
    with pytest.warns(UserWarning, match=r"`set_env\(\)` gave another environment, but .* reset_num_timesteps=False"):
        model.learn(16, TaskSignal())


def test_a_model_that_has_heard_a_signal_is_inspected():
    model = make_model("PPO", World()).learn(16, [TaskSignal(attribute="level"), oracle := Oracle()])
    inspection = inspect_model(model, callbacks=[TaskSignal(attribute="level"), oracle])
    assert inspection.figures["rollout/n_steps"] == 16 and oracle.n_resets == 0
    model.env.set_attr("level", "hard")
    inspect_model(model, callbacks=[TaskSignal(attribute="level"), oracle])
    assert oracle.n_resets == 1


def test_from_yaml():
    """As the stock RL Zoo reads ``callback:``."""
    entries = [{"sb3_cchain.TaskSignal": {"switch_at": [16]}}, "sb3_cchain.ContinualMetrics", "sb3_cchain.methods.Oracle"]
    callbacks = pytest.importorskip("rl_zoo3.utils").get_callback_list({"callback": entries})
    make_model("PPO", CountEnv()).learn(32, callbacks)
    assert callbacks[2].n_resets == 1


def test_one_signal_is_enough():
    with pytest.raises(ValueError, match="2 callbacks TaskSignal"):
        make_model("PPO", CountEnv()).learn(16, [TaskSignal(), TaskSignal(switch_every=3)])


@pytest.mark.parametrize("cls", [PPO, DQN])
def test_without_a_signal_a_method_still_asks_for_tasks(cls):
    with pytest.raises(TypeError, match=r"say when the world changes, by a sb3_cchain.TaskSignal"):
        make_model(cls.__name__, CountEnv()).learn(16, Oracle())


@pytest.mark.parametrize(
    "a, b, equal",
    [
        *((1, 1, True), ("a", "b", False), (1, None, False), (np.ones(2), np.ones(2), True)),
        *(([1, [2]], [1, [2]], True), ([1, 2], [1], False)),
        *(({"a": np.ones(2)}, {"a": np.ones(2)}, True), ({"a": np.ones(2)}, {"a": np.zeros(2)}, False)),
        *(({"a": 1}, {"b": 1}, False), ((np.ones(2), 1), (np.ones(2), 2), False)),
    ],
)
def test_tasks_of_any_type_are_compared(a, b, equal):
    assert _equal(a, b) == equal


def test_a_signal_is_kept_out_of_the_continual_environments_clock():
    """TaskSync puts evaluation on the environment's own task, whatever the signal is."""
    evaluation = EvalCallback(make_env(), eval_freq=8, n_eval_episodes=1, verbose=0, warn=False)
    make_model("CChainPPO").learn(48, [TaskSignal(switch_every=8), evaluation])
    assert evaluation.eval_env.get_attr("task_id") == [1]


def test_delta_reaches_the_detector():
    assert TaskSignal(drift="adwin", drift_delta=0.3)._detector.delta == 0.3


def give_another_world(model):
    model.set_env(World())


@pytest.mark.parametrize(
    "listeners, saved, change, task",
    [
        ([], False, None, 0),
        ([], True, None, 0),
        ([], True, task_switched, 1),
        ([ContinualMetrics], True, None, 0),
        ([ContinualMetrics], False, task_switched, 1),
        ([ContinualMetrics], False, give_another_world, 1),
    ],
)
def test_a_model_that_was_trained_without_a_signal_goes_on_with_one(listeners, saved, change, task, tmp_path):
    """Into the next task, if the task switched after its last step."""
    model, signal, tasks = make_model("PPO", World()), TaskSignal(switch_every=48), []
    model.learn(32, [make() for make in listeners])
    if saved:
        model.save(tmp_path / "model")
        model = type(model).load(tmp_path / "model", env=World())
    if change is not None:
        change(model)
    look = Curriculum(lambda _: tasks.append(signal.step_task), at=33)
    model.learn(32, [signal, look], reset_num_timesteps=False)
    assert tasks == [task]
    assert signal.next_task == task + 1  # since step 48


def test_what_was_heard_before_the_first_signal_is_not_heard_again():
    model, signal = make_model("PPO", World()), TaskSignal()
    model.learn(16, ContinualMetrics())
    task_switched(model)
    model.learn(16, ContinualMetrics(), reset_num_timesteps=False)
    model.learn(16, signal, reset_num_timesteps=False)
    assert signal.next_task == 1  # as the metrics have it
    model.learn(16, signal)
    assert signal.next_task == 0


@pytest.mark.parametrize("saved", [False, True])
@pytest.mark.parametrize(
    "n_steps, offset_seed, expected",
    [(64, 0, {1}), (64, 1, {2, 3}), (32, 0, {1}), (16, 0, {0, 1})],
)
def test_a_signal_that_comes_later_goes_on_with_the_numbers_of_the_metrics(n_steps, offset_seed, expected, saved, tmp_path):
    def make(offset_seed):
        return gym.make("Continual/CartPole-v1", n_tasks=2, steps_per_task=32, offset_seed=offset_seed)

    model = make_model("CChainPPO", make(0)).learn(n_steps, Oracle())
    if saved:
        model.save(tmp_path / "model")
        model = type(model).load(tmp_path / "model", env=make(offset_seed), device="cpu")
    elif offset_seed:
        model.set_env(make(offset_seed))
    oracle = Oracle()
    model.learn(48, [TaskSignal(), oracle], reset_num_timesteps=False)
    assert {row["task_id"] for row in model.continual_returns if row["timesteps"] > n_steps} == expected
    before = (n_steps - 1) // 32
    assert oracle.n_resets == len(expected | {before}) - 1
