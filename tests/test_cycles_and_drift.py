"""Tasks that come again, and tasks that drift into each other."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from sb3_cchain import ContinualEnv
from tests.envs import CountEnv

OFFSETS = np.array([[0.0] * 4, [10.0] * 4, [30.0] * 4])


def counted(steps_per_task=(3, 5), **kwargs):
    return ContinualEnv([lambda name=name: CountEnv(name) for name in range(2)], steps_per_task, **kwargs)


def walk(env, n_steps, **kwargs):
    """Task and first observation of each step."""
    env.reset(seed=0, **kwargs)
    found = []
    for _ in range(n_steps):
        observation, _, terminated, truncated, info = env.step(0)
        found.append((info["task_id"], observation))
        if terminated or truncated:
            env.reset()
    return found


def test_each_visit_of_a_cycle_is_a_task_of_its_own():
    env = counted(cycles=2)
    found = walk(env, 20)
    assert [task for task, _ in found] == [0] * 3 + [1] * 5 + [2] * 3 + [3] * 9  # the last goes on
    assert [int(observation[0]) for _, observation in found] == [0] * 3 + [1] * 5 + [0] * 3 + [1] * 9
    assert env.n_tasks == 4 and env.steps_per_task == [3, 5, 3, 5] and len(env.task_sequence) == 4
    assert counted(cycles=2, first_task=3).task_id == 3


@pytest.mark.parametrize("env_id", ["Continual/CartPole-v1", "Continual/MinAtar-v0"])
def test_registered_environments_in_cycles(env_id):
    once, twice = (gym.make(env_id, steps_per_task=10, cycles=cycles).unwrapped for cycles in (1, 2))
    assert twice.task_sequence == once.task_sequence * 2 and twice.n_tasks == 2 * once.n_tasks
    twice.set_clock(10 * once.n_tasks)
    assert twice.reset(seed=0)[1]["task_id"] == once.n_tasks


def drifting(**kwargs):
    settings = dict(offsets=OFFSETS, n_tasks=3, steps_per_task=10, blend_steps=4, max_episode_steps=100)
    return gym.make("Continual/CartPole-v1", **{**settings, **kwargs})


def offsets_of(env, n_steps):
    """CartPole's own observations lie near 0."""
    return [float(observation[0]) for _, observation in walk(env, n_steps)]


def close_to(values):
    return pytest.approx(values, abs=0.5)


def test_offsets_drift_in_a_straight_line():
    # A switch at 10 and at 20, each the beginning of a drift of 4 steps. The first step is made at weight 0
    expected = [0] * 10 + [0, 2.5, 5, 7.5] + [10] * 6 + [10, 15, 20, 25] + [30] * 6
    assert offsets_of(drifting(), 30) == close_to(expected)


def test_the_first_observation_of_a_task_is_of_the_task_before():
    env = drifting()
    env.unwrapped.set_clock(10)
    assert abs(env.reset(seed=0)[0]).max() < 1
    env.unwrapped.set_clock(12)
    assert np.allclose(env.reset(seed=0)[0], 5, atol=1)


def test_a_task_that_training_begins_with_or_is_pinned_to_does_not_drift():
    assert offsets_of(drifting(first_task=1), 3) == close_to([10] * 3)
    env = drifting()
    env.unwrapped.set_task(2)
    assert offsets_of(env, 3) == close_to([30] * 3)
    env.unwrapped.set_clock(20)  # and goes on drifting afterwards
    assert offsets_of(env, 3) == close_to([10, 15, 20])


def test_a_task_goes_on_drifting_where_it_was_left():
    env = drifting()
    env.unwrapped.set_clock(21)
    assert offsets_of(env, 1) == close_to([15])
    env.unwrapped.set_clock(12)
    assert offsets_of(env, 1) == close_to([5])
    env.unwrapped.set_clock(21)
    assert offsets_of(env, 1) == close_to([15])


def test_steps_count_over_all_environments():
    assert offsets_of(drifting(n_envs=2), 9)[5:] == close_to([0, 5, 10, 10])


def test_drift_from_the_last_task_of_a_cycle_to_the_first():
    assert offsets_of(drifting(cycles=2), 36)[30:] == close_to([30, 22.5, 15, 7.5, 0, 0])


def test_without_blending_nothing_changes():
    plain, drifts = gym.make("Continual/CartPole-v1", n_tasks=3, steps_per_task=10), drifting(offsets=None, blend_steps=1)
    # One step of drift, made at weight 0, and the reset before it
    one, other = (walk(env, 30) for env in (plain, drifts))
    same = [np.array_equal(first[1], second[1]) for first, second in zip(one, other, strict=True)]
    assert [step for step, equal in enumerate(same) if not equal] == [10, 20]


def test_checkers_and_seeds():
    check_env(drifting().unwrapped, skip_render_check=True)
    first, second = (np.array([observation for _, observation in walk(drifting(), 30)]) for _ in range(2))
    assert np.array_equal(first, second)


@pytest.mark.parametrize(
    "kwargs, message",
    [
        (dict(cycles=0), "`cycles` must be an integer greater than or equal to 1, got 0"),
        (dict(cycles=1.5), "`cycles` must be an integer .* got 1.5"),
        (dict(blend_steps=-1), "`blend_steps` must be an integer between 0 and 3, got -1"),
        (dict(blend_steps=4), "`blend_steps` must be an integer between 0 and 3, got 4"),  # longer than the shortest task
        (
            dict(blend_steps=2),
            "`blend_steps` must be 0 for ContinualEnv, got 2: nothing is known to lie between .* `blend\\(\\)`",
        ),
    ],
)
def test_bad_arguments(kwargs, message):
    with pytest.raises(ValueError, match=message):
        counted(**kwargs)


def test_games_cannot_be_blended():
    with pytest.raises(ValueError, match="`blend_steps` must be 0 for ContinualMinAtar, got 10"):
        gym.make("Continual/MinAtar-v0", blend_steps=10)
