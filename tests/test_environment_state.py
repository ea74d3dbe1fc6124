"""The state of environments is put back into new ones, which go on as the old ones would have."""

import math
import pickle
import sys
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv
from gymnasium.wrappers import TransformReward
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from sb3_cchain import ContinualEnv
from sb3_cchain.checkpoint.environment_state import (
    can_save_environment,
    check_same_environment,
    prepare_environment,
    remote_states,
    restore_remotes,
    vec_env_parts,
)
from sb3_cchain.checkpoint.episode_replay import EpisodeReplay
from sb3_cchain.checkpoint.object_state import object_states, restore_objects
from sb3_cchain.checkpoint.resumable_env import ResumableEnv
from sb3_cchain.checkpoint.simulator_state import emptied, register_simulators
from sb3_cchain.checkpoint.training_description import describe_env
from sb3_cchain.envs import ContinualProcgenVecEnv, TaskVecNormalize
from tests.envs import CountEnv, RandomEnv
from tests.resume_cases import in_new_process

# Steps of each environment after which the next task begins
TASK_STEPS = 60
# Environment, its arguments, how many of them, and the package that it needs
SHORT = {"max_episode_steps": 40}
CASES = {
    "CartPole-v1": ({}, 2, None),
    "Acrobot-v1": (SHORT, 2, None),
    "MountainCar-v0": (SHORT, 2, None),
    "MountainCarContinuous-v0": (SHORT, 2, None),
    "Pendulum-v1": (SHORT, 2, None),
    "FrozenLake-v1": ({}, 2, None),
    "LunarLander-v3": ({"enable_wind": True}, 2, "Box2D"),
    "BipedalWalker-v3": (SHORT, 2, "Box2D"),
    "HalfCheetah-v5": (SHORT, 2, "mujoco"),
    "Hopper-v5": ({}, 2, "mujoco"),
    "Continual/Acrobot-v1": (SHORT, 2, None),
    "Continual/LunarLander-v3": ({}, 2, "Box2D"),
    "Continual/MinAtar-v0": ({}, 2, "minatar"),
    "Continual/Walker-v0": ({**SHORT, "tasks": ["stand", "run"]}, 1, "dm_control"),
    "Continual/Quadruped-v0": ({**SHORT, "tasks": ["walk", "run"]}, 1, "dm_control"),
    "Continual/Dog-v0": ({**SHORT, "tasks": ["stand", "walk"]}, 1, "dm_control"),
    "Continual/Starpilot-v0": ({"num_levels": 3}, 2, "procgen"),
    "ContinualProcgenVecEnv": ({"game": "starpilot", "num_levels": 3}, 3, "procgen"),
}
# In the environments' own processes; the others have nothing there that these do not have
SUBPROC = ("CartPole-v1", "LunarLander-v3", "HalfCheetah-v5", "Continual/LunarLander-v3", "Continual/Walker-v0")


def environment_state(env):
    """As a checkpoint has it, together with the state of the model and of callbacks."""
    parts = vec_env_parts(env)
    with emptied(parts.unused):
        states = object_states(parts.holders, parts.known, skip=parts.skip, strict=parts.strict)
    return env.num_envs, states, remote_states(env)


def restore_environment(env, state):
    n_envs, states, remote = state
    prepare_environment(env)
    parts = vec_env_parts(env)
    check_same_environment(env, parts.holders, n_envs, states.holders)
    restore_objects(parts.holders, states, parts.known)
    restore_remotes(env, remote)


def make(env_id, subproc=False, seed=0):
    arguments, n_envs, package = CASES[env_id]
    if package is not None:
        pytest.importorskip(package)
    if env_id.startswith("Continual"):
        arguments = {**arguments, "steps_per_task": TASK_STEPS * n_envs, "n_envs": n_envs}
    if env_id == "ContinualProcgenVecEnv":
        env = ContinualProcgenVecEnv(num_threads=0, **arguments)
        env.seed(seed)
        env.reset()
        return env
    kwargs = {}
    if subproc:
        kwargs = dict(vec_env_cls=SubprocVecEnv, vec_env_kwargs={"start_method": "forkserver"}, wrapper_class=ResumableEnv)
    return begin(make_vec_env(env_id, n_envs=n_envs, seed=seed, env_kwargs=arguments, **kwargs))


def begin(env):
    """Prepare an environment, and begin episodes that are recorded where they have to be."""
    env.reset()
    prepare_environment(env)
    env.reset()
    return env


def action(space, rng):
    if isinstance(space, spaces.Discrete):
        return rng.integers(space.n)
    return rng.uniform(space.low, space.high).astype(space.dtype)


def play(env, steps):
    """Random actions, which depend on the numbers of the steps alone. Returns what came of each."""
    found = []
    for step in steps:
        rng = np.random.default_rng(step)
        result = env.step(np.stack([action(env.action_space, rng) for _ in range(env.num_envs)]))
        found.append(plain([*result, env.unwrapped.reset_infos]))
    return found


def plain(value):
    """What ``==`` compares bit for bit. Without times, which are other ones."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items() if key != "t"}
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.dtype.str, value.shape, value.tobytes()
    return value


def assert_same(expected, found):
    assert len(expected) == len(found)
    for step, (one, other) in enumerate(zip(expected, found, strict=True)):
        assert one == other, f"Differs at step {step}"


def play_and_save(env, cuts, n_steps):
    """What each step gave, and the pickled state at the cuts."""
    history, states = [], {}
    for step in range(n_steps):
        if step in cuts:
            assert can_save_environment(env)
            states[step] = pickle.dumps(environment_state(env))
        history += play(env, [step])
    return history, states


def check_cuts(env, new, cuts, n_steps=200, length=100):
    history, states = play_and_save(env, cuts, n_steps)
    for cut, state in states.items():
        restore_environment(new, pickle.loads(state))
        assert_same(history[cut : cut + length], play(new, range(cut, min(cut + length, n_steps))))
    env.close()
    new.close()


# Within an episode, before and after a switch of tasks or the end of an episode, and in the first episode
CUTS = (100, TASK_STEPS - 1, TASK_STEPS, 39, 40, 3)


@pytest.mark.parametrize("env_id", CASES)
def test_goes_on_exactly(env_id):
    # Dog is a hundred times as large as the others
    cuts = [100] if env_id == "Continual/Dog-v0" else CUTS
    check_cuts(make(env_id), make(env_id, seed=7), cuts)


@pytest.mark.parametrize("env_id", SUBPROC)
def test_goes_on_exactly_in_processes_of_their_own(env_id):
    check_cuts(make(env_id, subproc=True), make(env_id, subproc=True, seed=7), CUTS)


IN_NEW_PROCESS = ("Continual/LunarLander-v3", "BipedalWalker-v3", "HalfCheetah-v5", "ContinualProcgenVecEnv")


def test_goes_on_exactly_in_a_new_process():
    expected, states = {}, {}
    for env_id in IN_NEW_PROCESS:
        history, saved = play_and_save(make(env_id), [100], 180)
        expected[env_id], states[env_id] = history[100:], saved[100]
    found = in_new_process(go_on_from, pickle.dumps(states))
    for env_id in IN_NEW_PROCESS:
        assert_same(expected[env_id], found[env_id])


def go_on_from(states):
    """In the new process."""
    found = {}
    for env_id, state in pickle.loads(states).items():
        env = make(env_id, seed=7)
        restore_environment(env, pickle.loads(state))
        found[env_id] = play(env, range(100, 180))
    return found


class Squares(VecEnvWrapper):
    """A wrapper of a user, with a state: the steps of each environment so far."""

    def __init__(self, venv):
        super().__init__(venv)
        self.n_steps = np.zeros(venv.num_envs)

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        observations, _, dones, infos = self.venv.step_wait()
        self.n_steps += 1
        return observations, self.n_steps**2, dones, infos


VEC_WRAPPERS = {
    "VecNormalize": VecNormalize,
    "TaskVecNormalize": TaskVecNormalize,
    "VecFrameStack": lambda env: VecFrameStack(env, 4),
    "VecMonitor": lambda env: VecMonitor(VecCheckNan(env)),
    "several": lambda env: Squares(VecNormalize(VecFrameStack(VecMonitor(env), 3))),
}


@pytest.mark.parametrize("name", VEC_WRAPPERS)
def test_wrappers_of_vectorised_environments(name):
    wrap = VEC_WRAPPERS[name]
    check_cuts(wrap(make("Continual/Acrobot-v1")), wrap(make("Continual/Acrobot-v1", seed=7)), CUTS)


def test_a_state_does_not_change_any_more():
    env = make("Continual/Acrobot-v1")
    state = environment_state(env)
    content = pickle.dumps(state)
    play(env, range(100))
    assert pickle.dumps(state) == content


def test_what_belongs_to_the_process_stays(tmp_path):
    old = begin(DummyVecEnv([lambda: Monitor(CountEnv())]))
    new = begin(DummyVecEnv([lambda: Monitor(CountEnv(), str(tmp_path))]))
    play(old, range(10))
    start, writer = new.envs[0].t_start, new.envs[0].results_writer
    restore_environment(new, environment_state(old))
    assert new.envs[0].results_writer is writer and new.envs[0].t_start == start
    assert new.envs[0].episode_returns == [7.0] and new.envs[0].rewards == [1.0] * 3


class Emulator:
    """Stands for ``ale_py.ALEInterface``, so that the Arcade Learning Environment need not be installed."""


class Breakout(CountEnv):
    """Has an emulator, as Atari games have."""

    def __init__(self):
        super().__init__()
        self.ale = Emulator()


def test_a_simulator_without_an_exact_state(monkeypatch):
    prepare_environment(DummyVecEnv([Breakout]))
    monkeypatch.setitem(sys.modules, "ale_py", SimpleNamespace(ALEInterface=Emulator))
    with pytest.raises(ValueError, match=r"Environment 0: .*Breakout.* cannot be resumed exactly.*exact=False"):
        prepare_environment(DummyVecEnv([Breakout]))


def test_mujoco_is_as_it_was_to_the_last_byte():
    pytest.importorskip("mujoco")
    env, new = make("HalfCheetah-v5"), make("HalfCheetah-v5", seed=7)
    # As in the randomisation of domains
    env.envs[0].unwrapped.model.opt.gravity[:] = 0, 0, -5
    env.envs[0].unwrapped.model.body_mass[:] *= 1.5
    play(env, range(30))
    datas = [single.unwrapped.data for single in new.envs]
    restore_environment(new, environment_state(env))
    for one, other, data in zip(env.envs, new.envs, datas, strict=True):
        assert other.unwrapped.data is data
        assert one.unwrapped.model.__getstate__() == other.unwrapped.model.__getstate__()
        assert one.unwrapped.data.__getstate__() == data.__getstate__()


def test_mujoco_with_another_model():
    pytest.importorskip("mujoco")
    register_simulators()
    hopper, cheetah = (gym.make(name).unwrapped.model for name in ("Hopper-v5", "HalfCheetah-v5"))
    with pytest.raises(ValueError, match="The MuJoCo model differs from the saved one in"):
        restore_objects({"model": cheetah}, object_states({"model": hopper}))


def test_a_recorded_episode_must_have_begun_under_record():
    pytest.importorskip("Box2D")
    env = make_vec_env("LunarLander-v3", n_envs=2)
    env.reset()
    prepare_environment(env)
    prepare_environment(env)
    assert isinstance(env.envs[0].unwrapped, gym.Env) and str(env.envs[0]).count("EpisodeReplay") == 1
    assert not can_save_environment(env)
    with pytest.raises(ValueError, match="began before it was recorded"):
        environment_state(env)
    n_steps = 0
    while not can_save_environment(env):
        play(env, [n_steps])
        n_steps += 1
    assert n_steps > 10
    new = make("LunarLander-v3", seed=7)
    restore_environment(new, environment_state(env))
    assert_same(play(env, range(200)), play(new, range(200)))


def test_an_environment_that_was_not_used_can_be_saved():
    pytest.importorskip("Box2D")
    env, new = (make_vec_env("LunarLander-v3") for _ in range(2))
    prepare_environment(env)
    assert can_save_environment(env)
    restore_environment(new, environment_state(env))


def test_recording_changes_nothing():
    pytest.importorskip("Box2D")
    found = []
    for prepare in (False, True):
        env = make_vec_env("LunarLander-v3", n_envs=2)
        if prepare:
            prepare_environment(env)
            assert "EpisodeReplay" in str(env.envs[0])
        assert [wrapper.name for wrapper in env.envs[0].spec.additional_wrappers] == ["Monitor"]
        env.seed(0)
        env.reset()
        found.append(play(env, range(200)))
    assert_same(*found)


def test_only_what_cannot_be_saved_is_recorded():
    env = make_vec_env("Continual/Acrobot-v1", wrapper_class=ResumableEnv)
    assert not any("EpisodeReplay" in str(task) for task in env.get_attr("tasks")[0])


class Opaque(RandomEnv):
    """Cannot be pickled from its first reset on."""

    def reset(self, **kwargs):
        self.secret = (item for item in "abc")
        return super().reset(**kwargs)


class Chaotic(Opaque):
    """With random numbers that nobody knows of."""

    def step(self, action):
        _, *rest = super().step(action)
        return np.random.default_rng().random(4, dtype=np.float32), *rest


class Bonus(Opaque):
    """With a reward that the next reset, too, takes from what cannot be saved."""

    bonuses = None

    def reset(self, **kwargs):
        self.bonuses = self.bonuses or (float(number) for number in range(100))
        self.bonus = next(self.bonuses)
        return super().reset(**kwargs)

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, self.bonus, *rest


class Lasting(RandomEnv):
    """Goes on with a generator or a file where the episode before stopped."""

    def __init__(self, stream):
        super().__init__()
        self.stream = stream

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, float(len(next(self.stream))), *rest


@pytest.mark.parametrize("make", [lambda: (str(n) for n in range(100)), lambda: open(__file__)], ids=["generator", "file"])
def test_episodes_that_go_on_with_a_stream_are_warned_of(make):
    env = DummyVecEnv([lambda: Lasting(make())])
    with pytest.warns(UserWarning, match=r"Lasting.* holds stream, a generator or a file, .* training cannot be resumed"):
        prepare_environment(env)


class GlobalNumbers(RandomEnv):
    """Draws from NumPy's global generator."""

    def step(self, action):
        _, *rest = super().step(action)
        return np.random.normal(size=4).astype(np.float32), *rest


@pytest.mark.parametrize("wrapper", [None, ResumableEnv])
def test_an_environment_that_cannot_be_saved_is_played_again(wrapper):
    check_cuts(*(begin(make_vec_env(Opaque, 2, seed, wrapper_class=wrapper)) for seed in range(2)), cuts=CUTS)


def test_an_environment_that_is_not_deterministic():
    env, new = (begin(DummyVecEnv([Chaotic])) for _ in range(2))
    play(env, range(3))
    with pytest.raises(ValueError, match=r"environment 0, 0 \w+: .*Chaotic.* 3 steps went otherwise .* not deterministic"):
        restore_environment(new, environment_state(env))


def test_an_episode_with_other_rewards_went_otherwise():
    env, new = (begin(DummyVecEnv([Bonus])) for _ in range(2))
    play(env, range(22))  # to the third episode
    with pytest.raises(ValueError, match=r"Bonus.* 2 steps went otherwise"):
        restore_environment(new, environment_state(env))


def test_global_random_numbers_of_other_processes():
    env, new = (
        begin(
            make_vec_env(
                *(GlobalNumbers, 2, seed),
                vec_env_cls=SubprocVecEnv,
                vec_env_kwargs={"start_method": "forkserver"},
                wrapper_class=ResumableEnv,
            )
        )
        for seed in range(2)
    )
    play(env, range(3))
    restore_environment(new, environment_state(env))
    assert_same(play(env, range(15)), play(new, range(15)))
    env.close()
    new.close()


def test_functions_of_wrappers_are_no_obstacle():
    def single():
        return TransformReward(gym.make("CartPole-v1"), lambda reward: 2 * reward)

    env, new = (begin(DummyVecEnv([single])) for _ in range(2))
    check_cuts(env, new, CUTS)
    assert "EpisodeReplay" not in str(env.envs[0])


class Player:
    def __init__(self, rng):
        self.rng = rng


class Team(gym.Env):
    """Players in a list who share the generator of the environment, which draws from it, too."""

    observation_space = spaces.Box(-10, 10, (3,), np.float32)
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.players = [Player(self.np_random), Player(self.np_random)]
        return np.zeros(3, np.float32), {}

    def step(self, action):
        numbers = [self.np_random.normal(), *(player.rng.normal() for player in self.players)]
        return np.array(numbers, np.float32), 0.0, False, False, {}


class LaterTeam(Team):
    """The list comes before the generator."""

    def __init__(self):
        self.players = []


@pytest.mark.parametrize("kind", [Team, LaterTeam])
def test_a_shared_generator_stays_shared(kind):
    check_cuts(*(begin(make_vec_env(kind, 2, seed)) for seed in range(2)), cuts=CUTS)


class Twins(gym.Wrapper):
    """Has environments in a list, whose state pickle does not save: they say only how they were made."""

    def __init__(self):
        self.twins = [HalfCheetahEnv(), HalfCheetahEnv()]
        super().__init__(self.twins[0])


def test_environments_in_a_list_are_not_saved_as_if_they_were_new():
    pytest.importorskip("mujoco")
    env, new = (begin(DummyVecEnv([Twins])) for _ in range(2))
    assert "EpisodeReplay" in str(env.envs[0])
    check_cuts(env, new, (3, 20), 60)


@pytest.mark.parametrize("n_channels", [1, 3])
def test_transposed_images_keep_their_layout(n_channels):
    # Otherwise convolutions round otherwise
    images = np.arange(2 * 4 * 5 * n_channels, dtype=np.uint8).reshape(2, 4, 5, n_channels)
    saved, new = SimpleNamespace(images=images.transpose(0, 3, 1, 2)), SimpleNamespace()
    restore_objects({"it": new}, object_states({"it": saved}))
    assert new.images.strides == saved.images.strides and (new.images == saved.images).all()


class WithSecret(ContinualEnv):
    def __init__(self):
        self.secret = (item for item in "abc")
        super().__init__(["CartPole-v1", "CartPole-v1"], 100)


def test_a_continual_environment_that_cannot_be_saved():
    env = DummyVecEnv([WithSecret])
    with pytest.raises(ValueError, match=r"Environment 0: .*WithSecret.* cannot be resumed.*secret.*state_dict"):
        prepare_environment(env)


def test_another_environment():
    state = environment_state(begin(make_vec_env("CartPole-v1", n_envs=2)))
    for env, message in [
        (make_vec_env("CartPole-v1", n_envs=3), "There must be 2 environments side by side, .* got 3"),
        (VecNormalize(make_vec_env("CartPole-v1", n_envs=2)), "'0 VecNormalize' instead of '0 DummyVecEnv'"),
        (make_vec_env("Acrobot-v1", n_envs=2), "'environment 0, 4 AcrobotEnv' instead of 'environment 0, 4 CartPoleEnv'"),
        (
            DummyVecEnv([lambda: gym.make("CartPole-v1")] * 2),
            "'environment 0, 0 TimeLimit' instead of 'environment 0, 0 Monitor'",
        ),
    ]:
        env.reset()
        with pytest.raises(ValueError, match=message):
            restore_environment(env, state)


@pytest.mark.parametrize("wrapper", [None, lambda env: Monitor(ResumableEnv(env))])
def test_processes_need_the_outermost_wrapper(wrapper):
    kwargs = dict(vec_env_cls=SubprocVecEnv, vec_env_kwargs={"start_method": "forkserver"}, wrapper_class=wrapper)
    env = make_vec_env("CartPole-v1", **kwargs)
    with pytest.raises(ValueError, match=r"outermost wrapper: make_vec_env\(.*wrapper_class=ResumableEnv"):
        prepare_environment(env)
    env.close()


@pytest.mark.parametrize("kind", [WithSecret, Chaotic])
def test_errors_come_from_the_other_processes(kind):
    env, new = (SubprocVecEnv([lambda: ResumableEnv(kind())], start_method="forkserver") for _ in range(2))
    env.reset(), new.reset()
    with pytest.raises(ValueError, match=f"Environment 0: .*{kind.__name__}.*state_dict"):
        prepare_environment(env)
        env.reset()
        play(env, range(3))
        restore_environment(new, environment_state(env))
    env.close(), new.close()


class Unknown(VecEnv):
    """A vectorised environment of a user."""

    step_async = step_wait = reset = close = set_attr = env_method = env_is_wrapped = None

    def __init__(self):
        super().__init__(1, CountEnv.observation_space, CountEnv.action_space)

    def get_attr(self, name, indices=None):
        return [None]


def test_an_unknown_vectorised_environment():
    with pytest.raises(ValueError, match=r"Unknown cannot be resumed.*`state_dict\(\)` and"):
        prepare_environment(Unknown())


def test_resumable_env_by_itself():
    env, new = ResumableEnv(gym.make("Acrobot-v1")), ResumableEnv(gym.make("Acrobot-v1"))
    env.reset(seed=0), new.reset(seed=1)
    for _ in range(20):
        env.step(1)
    new.load_state_dict(env.state_dict())
    assert new.unwrapped.state.tobytes() == env.unwrapped.state.tobytes()
    assert_same(plain([env.step(2), env.reset()]), plain([new.step(2), new.reset()]))


def test_replay_needs_no_episode():
    env, new = EpisodeReplay(Opaque()), EpisodeReplay(Opaque())
    new.load_state_dict(env.state_dict())
    assert new.is_recorded


class Levels(RandomEnv):
    """Takes the next level, its map and its rule at each reset."""

    levels = ((CountEnv, Path("maps/a"), math.sin), (RandomEnv, Path("maps/b"), math.cos))
    n_resets = 0

    def reset(self, **kwargs):
        self.kind, self.map, self.rule = self.levels[self.n_resets % 2]
        self.n_resets += 1
        return super().reset(**kwargs)

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, self.rule(ord(self.map.name) + len(self.kind.__name__)), *rest


def test_what_an_environment_takes_another_of():
    env, new = (begin(DummyVecEnv([Levels])) for _ in range(2))
    check_cuts(env, new, (3, 13, 20), 40)
    assert "EpisodeReplay" not in str(env.envs[0])


class Reader(RandomEnv):
    """Observes the lines of a file."""

    def reset(self, **kwargs):
        self.file = open(__file__)
        return super().reset(**kwargs)

    def step(self, action):
        observation, _, *rest = super().step(action)
        return observation, float(len(next(self.file))), *rest


@pytest.mark.filterwarnings("ignore:.*holds file, a generator or a file")
def test_an_environment_that_reads_a_file_is_played_again():
    env, new = (begin(DummyVecEnv([Reader])) for _ in range(2))
    assert "EpisodeReplay" in str(env.envs[0])
    check_cuts(env, new, (3, 13, 20), 40)


class World:
    """Moves when it is told to."""

    position = 0.0


class SharedWorldEnv(gym.Env):
    """Reaches its world by two ways, one of which is a list."""

    observation_space = gym.spaces.Box(-9, 9, (1,))
    action_space = gym.spaces.Discrete(2)

    def __init__(self):
        self.world = World()
        self.players = [self.world]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.players[0].position += action
        return np.array([self.world.position], np.float32), 0.0, False, False, {}


def test_an_object_that_is_reached_by_two_ways_stays_one():
    env, new = (begin(DummyVecEnv([SharedWorldEnv])) for _ in range(2))
    check_cuts(env, new, (3, 20), 40)
    assert "EpisodeReplay" not in str(env.envs[0])


def test_rl_zoos_time_limit_is_gymnasiums():
    """RL Zoo replaces the class when it is imported, so training with and without it has another one."""
    pytest.importorskip("rl_zoo3")
    plain = gym.wrappers.TimeLimit.__mro__[1]
    assert plain.__module__.startswith("gymnasium.")

    def make_with(kind):
        def make_one():
            return kind(gym.make("CartPole-v1", max_episode_steps=-1), 20)

        return DummyVecEnv([make_one])

    saved, other = begin(make_with(plain)), make_with(gym.wrappers.TimeLimit)
    assert describe_env(saved) == describe_env(other)
    saved.step([0])
    state = environment_state(saved)
    expected = [saved.step([step % 2])[0] for step in range(40)]
    other.reset()
    restore_environment(other, state)
    np.testing.assert_array_equal([other.step([step % 2])[0] for step in range(40)], expected)
    assert type(other.envs[0]) is gym.wrappers.TimeLimit
