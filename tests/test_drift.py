"""The detector of drift on series that are known, and what its benchmark makes of it."""

import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from benchmarks import drift as benchmark
from sb3_cchain.tasks.drift import Drift


def noise(mean, n, seed=0, std=1.0):
    return np.random.default_rng(seed).normal(mean, std, n)


def heard(detector, values):
    return [position for position, value in enumerate(values) if detector.update(value)]


@pytest.mark.parametrize("scale", [1.0, 100.0])
@pytest.mark.parametrize("worse, sign", [("smaller", -1), ("greater", 1)])
def test_a_change_for_the_worse_is_heard_soon_and_once(worse, sign, scale):
    values = np.concatenate([noise(0, 100), noise(sign * 10, 100, seed=1)]) * scale
    positions = heard(Drift(worse=worse), values)
    assert len(positions) == 1 and 100 <= positions[0] < 110


@pytest.mark.parametrize("worse, sign", [("smaller", 1), ("greater", -1)])
def test_a_change_for_the_better_is_learning(worse, sign):
    values = np.concatenate([noise(0, 100), noise(sign * 10, 100, seed=1)])
    assert heard(Drift(worse=worse), values) == []
    # A change that comes after it is measured from there
    assert heard(Drift(worse=worse), np.concatenate([values, noise(0, 50, seed=2)]))[0] in range(200, 210)


def test_false_alarms_are_rare_and_rarer_with_a_smaller_threshold():
    alarms = {delta: sum(len(heard(Drift(delta=delta), noise(0, 500, seed))) for seed in range(20)) for delta in (0.5, 0.002)}
    assert alarms[0.002] == 0 < alarms[0.5]


def test_a_slow_drift_is_heard():
    assert heard(Drift(), noise(0, 400) - np.linspace(0, 10, 400))


def test_forgets_and_goes_on():
    detector = Drift()
    heard(detector, noise(0, 100))
    other = Drift()
    other.load_state_dict(pickle.loads(pickle.dumps(detector.state_dict())))
    assert heard(detector, noise(-10, 20, seed=1)) == heard(other, noise(-10, 20, seed=1)) != []
    detector.reset()
    assert heard(detector, noise(-30, 20, seed=1)) == []


def test_alarms_are_told_from_false_ones(monkeypatch):
    """By hand: heard at 5, 15, 25 and 35, with a switch at 10 and one at 30."""

    class Every10:
        def __init__(self, *_):
            self.n = 0

        def update(self, value):
            self.n += 1
            return self.n % 10 == 5

    monkeypatch.setattr(benchmark, "Drift", Every10)
    series = [(time, 0.0) for time in range(1, 41)]
    # At 5 nothing had changed, at 15 the first switch is 5 old, 25 is a second alarm of it, 35 is for the second switch
    assert benchmark.alarms(series, [10, 30], 10, 0.002, "smaller") == ([(5, 5), (5, 5)], 2, 2)
    # None comes in time
    assert benchmark.alarms(series, [10, 30], 4, 0.002, "smaller") == ([], 2, 4)


def test_the_benchmark_runs(tmp_path, capsys):
    arguments = ["--seeds", "0", "--steps-per-task", "512", "--output", str(tmp_path)]
    benchmark.main([*arguments, "--worlds", "CartPole, poles of other lengths"])
    first = (tmp_path / "drift_3x512" / "table.md").read_text()
    assert first.count("| CartPole, poles of other lengths |") == 6
    benchmark.main([*arguments, "--worlds", "CartPole, poles of other lengths"])  # from what was recorded
    assert (tmp_path / "drift_3x512" / "table.md").read_text() == first
    assert "seed 0: done" in capsys.readouterr().out
    # The table is of all that is there
    worlds = tmp_path / "drift_3x512"
    shutil.copytree(worlds / "CartPole_poles_of_other_lengths", worlds / benchmark._folder(worlds, benchmark.UNCHANGED).name)
    benchmark.main([*arguments, "--worlds", "CartPole, poles of other lengths"])
    table = (worlds / "table.md").read_text()
    assert table.count(f"| {benchmark.UNCHANGED} |") == 6 == table.count("| CartPole, poles of other lengths |")


def test_poles_differ():
    env = benchmark.WORLDS["CartPole, poles of other lengths"](100)
    assert [task.unwrapped.length for task in env.tasks] == list(benchmark.POLES)
    assert [task.unwrapped.polemass_length for task in env.tasks] == pytest.approx([0.05, 0.005, 0.2])


def test_the_page_shows_the_table():
    root = Path(__file__).parent.parent
    table = (root / "benchmarks" / "results" / "drift_3x20000" / "table.md").read_text()
    assert table in (root / "docs" / "changing_world.md").read_text()
