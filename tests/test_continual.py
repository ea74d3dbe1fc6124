"""The metrics of continual learning, on tables that were worked by hand."""

import numpy as np
import pytest

from sb3_cchain.analysis.metrics import continual
from sb3_cchain.analysis.metrics.continual import recovery_times
from sb3_cchain.callbacks.continual_metrics import task_averages

# Rollouts of 10 steps, three tasks of 40, 40 and 20
RETURNS = [
    dict(timesteps=step, task_id=task, n_episodes=1, mean_return=value)
    for step, task, value in [
        *[(10, 0, 0.0), (20, 0, 4.0), (30, 0, 8.0), (40, 0, 8.0)],
        *[(50, 1, 1.0), (60, 1, 7.0), (70, 1, 8.0), (80, 1, 10.0)],
        *[(90, 2, 2.0), (100, 2, 3.0)],
    ]
]
# Returns on task i after training on task j
BEFORE = np.array([1.0, 2.0, 0.0])
AFTER = np.array([[10.0, 4.0, 1.0], [6.0, 8.0, 2.0], [5.0, 9.0, 4.0]])


def test_curve_of_a_task():
    steps, returns = continual.task_curve(RETURNS, 2)
    assert steps.tolist() == [90, 100] and returns.tolist() == [2, 3]
    assert [len(part) for part in continual.task_curve(RETURNS, 3)] == [0, 0]


def test_average_performance():
    averages = task_averages(RETURNS)
    assert averages == {0: 5.0, 1: 6.5, 2: 2.5}
    assert continual.average_performance(list(averages.values())) == pytest.approx(14 / 3)


def test_plasticity_gap():
    assert continual.plasticity_gap([5.0, 6.5, 2.5], [5.0, 7.0, 6.5]).tolist() == [0.0, 0.5, 4.0]


@pytest.mark.parametrize(
    "steps, returns, start, end, area",
    [
        ([10, 20], [2, 4], 10, 20, 3),  # a trapezium
        ([10, 20], [2, 4], 0, 20, 2.5),  # level before the first point: 10 of 2, 10 of 3
        ([10, 20], [2, 4], 10, 40, (10 * 3 + 20 * 4) / 30),  # and after the last
        ([0, 10, 20, 30], [0, 2, 4, 0], 10, 20, 3),  # points outside count as far as the line between them
        ([0, 20], [0, 4], 5, 15, 2),
        ([5], [7], 0, 10, 7),
        ([10, 20, 60], [0, 10, 10], 10, 60, 9),  # by time, not by points: 10 of 5, 40 of 10
    ],
)
def test_area_under_the_curve(steps, returns, start, end, area):
    assert continual.area_under_curve(steps, returns, start, end) == pytest.approx(area)


def test_no_area_without_points():
    assert np.isnan(continual.area_under_curve([], [], 0, 10))


def test_forward_transfer():
    # Half of what is missing to 10; worse than a fresh agent; no room
    found = continual.forward_transfer([6.0, 1.0, 10.0], [2.0, 4.0, 10.0], 10.0)
    assert found[:2] == pytest.approx([0.5, -0.5]) and np.isnan(found[2])
    assert continual.forward_transfer([0.5], [0.25], [1.0]) == pytest.approx([1 / 3])


def test_recovery_times():
    # The level is the mean of the last two: 8, reached at 70; then 9, never
    times = continual.recovery_times(RETURNS, window=2)
    assert times[0] == 30 and np.isnan(times[1])
    assert continual.recovery_times(RETURNS, window=2, tolerance=1)[0] == 20
    assert continual.recovery_times(RETURNS, window=2, tolerance=6).tolist() == [20, 20]
    assert continual.recovery_times(RETURNS, window=4).tolist()[0] == 20  # 5, reached at 60
    assert continual.recovery_times(RETURNS[:4]).shape == (0,)


def test_recovery_of_a_task_that_comes_back():
    returns = [(0, 4.0), (0, 8.0), (1, 2.0), (1, 8.0), (1, 6.0), (0, 5.0), (0, 9.0)]
    rows = [dict(timesteps=10 * i, task_id=task, n_episodes=1, mean_return=value) for i, (task, value) in enumerate(returns)]
    # To 8, at step 30; to 6, at step 60
    assert continual.recovery_times(rows, window=1).tolist() == [20, 20]


def rows_of(before, after):
    rows = [dict(timesteps=0, trained_task=0, task_id=i, mean_return=value) for i, value in enumerate(before)]
    for j, values in enumerate(after):
        rows += [
            # One in the middle of the task, which does not count
            dict(timesteps=100 * j + shift, trained_task=j, task_id=i, mean_return=value + shift - 100)
            for shift in (50, 100)
            for i, value in enumerate(values)
        ]
    return rows


def test_matrix_of_returns():
    before, after = continual.return_matrix(rows_of(BEFORE, AFTER))
    assert np.array_equal(before, BEFORE) and np.array_equal(after, AFTER)
    before, after = continual.return_matrix(rows_of(BEFORE, AFTER)[:9])
    assert np.array_equal(after[0], AFTER[0]) and np.isnan(after[1:]).all()
    before, after = continual.return_matrix([])
    assert before.size == after.size == continual.forgetting(after).size == 0
    metrics = (
        continual.final_performance(after),
        continual.backward_transfer(after),
        continual.zero_shot_transfer(before, after),
    )
    assert np.isnan(metrics).all()


def test_final_performance():
    assert continual.final_performance(AFTER) == 6


def test_forgetting_and_backward_transfer():
    assert continual.forgetting(AFTER).tolist() == [5, -1, 0]
    assert continual.backward_transfer(AFTER) == -2
    assert np.isnan(continual.backward_transfer([[3.0]]))


def test_zero_shot_transfer():
    # 4 - 2 before task 1, 2 - 0 before task 2
    assert continual.zero_shot_transfer(BEFORE, AFTER) == 2
    assert np.isnan(continual.zero_shot_transfer([1.0], [[3.0]]))


def test_isolated_changes():
    expected = np.array([[9, 2, 1], [-4, 4, 1], [-1, 1, 2]]) / [10, 9, 4]
    assert continual.isolated_changes(BEFORE, AFTER) == pytest.approx(expected)
    forgotten = continual.isolated_forgetting(BEFORE, AFTER)
    assert forgotten[:2] == pytest.approx([(0.4 + 0.1) / 2, -1 / 9]) and np.isnan(forgotten[2])
    gained = continual.isolated_zero_shot_transfer(BEFORE, AFTER)
    assert np.isnan(gained[0]) and gained[1:] == pytest.approx([2 / 9, (0.25 + 0.25) / 2])


def test_isolated_changes_of_negative_returns_and_of_none():
    changes = continual.isolated_changes([-10.0, 0.0], [[-5.0, 0.0], [-8.0, 0.0]])
    assert changes[:, 0] == pytest.approx([1.0, -0.6]) and np.isnan(changes[:, 1]).all()


def test_isolated_changes_without_a_scale():
    assert np.isnan(continual.isolated_changes([-1.0], [[0.0]])).all()


def test_recovery_is_to_the_last_five_rollouts():
    values = [100.0] * 3 + [1.0] * 5
    rows = [dict(timesteps=10 * i, task_id=0, n_episodes=1, mean_return=value) for i, value in enumerate(values)]
    assert recovery_times([*rows, dict(timesteps=90, task_id=1, n_episodes=1, mean_return=1.0)]).tolist() == [20]
