"""The command ``benchmarks.plasticity``: what it trains, the NTKs that it keeps, tables and pictures of made-up results."""

from functools import partial

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure

from benchmarks.grid.executor import LocalBackend
from benchmarks.grid.plan import Rates
from benchmarks.grid.results import write_result
from benchmarks.grid.run import STRENGTH_COLORS
from benchmarks.grid.suites import SUITES
from benchmarks.plasticity.__main__ import main
from benchmarks.plasticity.heat_maps import cosines, plot_heat_maps
from benchmarks.plasticity.page import read_groups, table
from benchmarks.plasticity.rates import WatchedRates
from benchmarks.plasticity.runs import COMPONENTS, default_names, lines, quantities, snapshot_times, watched_run
from benchmarks.plasticity.snapshots import FILE, NTKSnapshots, read_snapshots, write_snapshots
from sb3_cchain.checkpoint import TrainingCheckpoint, find_checkpoint, resume
from tests.fake_training import fake_program
from tests.test_grid import make_result

ACROBOT = "Continual/Acrobot-v1"
FOLDERS = ("--results", "--logs", "--docs")


def command(folder, *arguments):
    options = [text for name in FOLDERS for text in (name, str(folder / name.strip("-")))]
    return main([*arguments, *options])


def write(folder, name, srank, suite="gym_control", env_id=ACROBOT, matrices=None, seed=0):
    """A watched run of two tasks of 800 steps, one rollout in each, with the same rank in both."""
    run = watched_run(suite, name, env_id, seed, 2, 800)
    result = make_result(folder, run)
    returns = [{"timesteps": 800 * (i + 1), "task_id": i, "n_episodes": 1, "mean_return": -10.0 * (i + 1)} for i in (0, 1)]
    write_result(result, returns, [{"timesteps": steps, "name": "ntk/srank", "value": srank} for steps in (800, 1600)])
    if matrices:
        write_snapshots(matrices, result.path / FILE)
    return result


# --- What is trained ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "suite, env_id, names",
    [
        ("gym_control", ACROBOT, ["vanilla", "trac", "cchain", *COMPONENTS]),
        ("procgen", "Continual/Chaser-v0", ["vanilla", "trac", "cchain", *COMPONENTS]),
        ("dmc", "Continual/Walker-v0", ["vanilla", "trac", "cchain", *COMPONENTS]),
        ("minatar", "Continual/MinAtar-v0", ["vanilla", "cchain"]),
    ],
)
def test_what_is_compared_in_each_suite(suite, env_id, names, monkeypatch):
    monkeypatch.setattr("benchmarks.grid.run.paper_length", lambda env_id: (5, 10))  # without making the environment
    assert default_names(suite, env_id) == names
    for name in names:
        run = watched_run(suite, name, env_id, 0, 2, 8000)
        callbacks, *others = run.overrides
        # What looks at the network comes before what changes it
        assert "['sb3_cchain.TaskSync', 'sb3_cchain.ChurnMonitor'" in callbacks and "sb3_cchain.ContinualMetrics" in callbacks
        assert "'times': [8000, 12000, 16000]" in callbacks and "NetworkHealth" in callbacks
        assert others == ([f"churn_component:'{name}'"] if name in COMPONENTS else [])
        assert run.line == name and run.experiment == "plasticity_2x8000" and name in lines(suite)
    assert ("value_churn" in str(quantities(suite))) == (suite == "minatar") and len(quantities(suite)) == 6


@pytest.mark.parametrize("suite", SUITES)
def test_each_line_has_a_colour_for_itself(suite):
    names = ["cchain"] if suite == "minatar" else ["cchain", "l2_init"]
    strengths = [f"{name}@{value}" for name in names for value in range(1, len(STRENGTH_COLORS) // len(names) + 1)]
    shown = lines(suite, strengths)
    assert {*strengths, *names} <= set(shown)
    assert len({line.color for line in shown.values()}) == len(shown)


@pytest.mark.parametrize("n_tasks, times", [(1, [100]), (2, [100, 150, 200]), (3, [100, 200, 300]), (5, [100, 300, 500])])
def test_when_the_ntk_is_kept(n_tasks, times):
    assert snapshot_times(watched_run("gym_control", "cchain", ACROBOT, 0, n_tasks, 100)) == times


@pytest.mark.parametrize("steps, interval", [(8000, 1), (160_000, 5)])
def test_a_long_run_is_looked_at_less_often(steps, interval):
    # Of 5 x 160 000 steps, 1000 rollouts of 800
    run = watched_run("gym_control", "cchain", ACROBOT, 0, 5, steps)
    assert run.overrides[0].count(f"'interval': {interval}}}") == 2


def test_another_strength_of_a_method():
    run = watched_run("gym_control", "cchain@1e3", ACROBOT, 0, 2, 800)
    assert run.overrides[0] == "target_churn_ratio:1e3" and run.line == "cchain@1e3"
    assert lines("gym_control", [run.line])[run.line].label == "C-CHAIN PPO, β = 1e3"


def test_watched_runs_tell_nothing_about_the_time_of_others(tmp_path):
    watched = watched_run("gym_control", "vanilla", ACROBOT, 0, 2, 800)
    rates = Rates([make_result(tmp_path, watched, seconds=160.0)])
    assert rates.seconds(watched_run("gym_control", "vanilla", ACROBOT, 0, 2, 1600)) == pytest.approx(320)
    assert rates.seconds(make_result(tmp_path, watched, experiment="paper")) == pytest.approx(1600 / 500)


def test_looks_take_no_longer_in_a_long_run(tmp_path):
    """Acrobot trains 500 steps a second by the suite's row, and 800 steps are a rollout."""
    # 2 rollouts of 1.6 s each, and a look at each of them, which takes 4 s
    rates = WatchedRates([make_result(tmp_path, watched_run("gym_control", "vanilla", ACROBOT, 0, 2, 800), seconds=11.2)])
    # 1000 rollouts, of which every fifth is looked at; a component takes as long as the whole, at 510 steps a second
    for name, rate in (("vanilla", 500), ("cchain", 510), ("projection", 510)):
        run = watched_run("gym_control", name, ACROBOT, 0, 5, 160_000)
        assert rates.seconds(run) == pytest.approx(800_000 / rate + 200 * 4)
    # Nothing is known of the looks of another suite
    run = watched_run("procgen", "vanilla", "Continual/Starpilot-v0", 0, 2, 8000)
    assert rates.seconds(run) == pytest.approx(16_000 / 55)


def test_dqn_has_no_components():
    with pytest.raises(ValueError, match=r"`method` must not be a component .* in minatar, which has none; got projection"):
        watched_run("minatar", "projection", "Continual/MinAtar-v0", 0, 2, 800)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--steps-per-task", "0"], "`steps_per_task` must be at least 1; got 0"),
        (["--suite", "procgen", "--env", ACROBOT], "--env must be one of Continual/BigFish-v0"),
        (["--method", "nonsense"], "`method` must be one of"),
    ],
)
def test_errors_come_before_any_work(tmp_path, capsys, arguments, message):
    with pytest.raises(SystemExit) as error:
        command(tmp_path, *arguments)
    assert error.value.code == 2 and message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_gpus_that_are_not_there_are_an_error(tmp_path):
    with pytest.raises(SystemExit, match=r"--gpus-per-run must be at most the GPUs of this machine, .*; got 99"):
        command(tmp_path, "--gpus-per-run", "99")
    assert not list(tmp_path.iterdir())


def test_the_command_trains_once_and_keeps_the_ntk(tmp_path, capsys, monkeypatch):
    program = partial(LocalBackend, program=fake_program(tmp_path / "fake", {}))
    monkeypatch.setattr("benchmarks.grid.executor.LocalBackend", program)
    arguments = ["--method", "vanilla", "orthogonal", "--n-tasks", "2", "--steps-per-task", "800", "--seeds", "0"]
    command(tmp_path, *arguments, "--dry-run")
    assert "2 runs, 0 of them done" in capsys.readouterr().out and not (tmp_path / "logs").exists()
    command(tmp_path, *arguments)
    assert "| return per episode | orthogonal alone | 0 | -10 | -20 |" in capsys.readouterr().out
    # The matrices that the stand-in does not write: they are also kept when another run fails
    ((result, _),) = read_groups(tmp_path / "results")
    logs = next(result.path_in(tmp_path / "logs").glob("attempt_*/tensorboard/*/*"))
    write_snapshots({800: np.eye(2)}, logs / FILE)
    fake_program(tmp_path / "fake", {1: ["fail"]})
    with pytest.raises(SystemExit, match="seed 1 failed: ValueError: boom"):
        command(tmp_path, *arguments, "1")
    assert list(read_snapshots(result)) == [800]


# --- The NTKs that are kept ---------------------------------------------------------------------------------------------


class Stop(BaseCallback):
    def __init__(self, at=None):
        super().__init__()
        self.at = at

    def _on_step(self):
        if self.num_timesteps == self.at:
            raise KeyboardInterrupt
        return True


def callbacks(folder, stop_at=None):
    """The times are in the third rollout of 16 steps, and at its end."""
    return [NTKSnapshots([40, 48]), TrainingCheckpoint(16, folder / "checkpoints"), Stop(stop_at)]


def train(folder, stop_at=None):
    settings = dict(n_steps=16, batch_size=16, n_epochs=1, policy_kwargs={"net_arch": [8]})
    model = PPO("MlpPolicy", make_vec_env("CartPole-v1", 1, seed=0), seed=0, device="cpu", **settings)
    model.set_logger(configure(str(folder), []))
    model.learn(64, callbacks(folder, stop_at))


def test_the_ntk_is_kept_at_or_before_each_time(tmp_path):
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    train(whole)
    with pytest.raises(KeyboardInterrupt):
        train(stopped, stop_at=42)
    assert not list(stopped.glob(FILE))
    checkpoint = find_checkpoint(stopped / "checkpoints").path
    resume(checkpoint, make_vec_env("CartPole-v1", 1, seed=9), callbacks(stopped), device="cpu")
    with np.load(whole / FILE) as expected, np.load(stopped / FILE) as resumed:
        assert sorted(expected) == sorted(resumed) == ["32", "48"] and expected["48"].shape == (16, 16)
        assert all(np.array_equal(expected[steps], resumed[steps]) for steps in expected)


# --- Tables and pictures ------------------------------------------------------------------------------------------------


def test_cosines_by_hand():
    # Gradients (3, 0), (3, 4), (0, -2) and 0
    matrix = np.array([[9.0, 9, 0, 0], [9, 25, -8, 0], [0, -8, 4, 0], [0, 0, 0, 0]])
    expected = [[1, 0.6, 0], [0.6, 1, -0.8], [0, -0.8, 1]]
    assert np.allclose(cosines(matrix)[:3, :3], expected) and np.isnan(cosines(matrix)[3]).all()


def test_each_matrix_is_drawn_at_its_time(tmp_path):
    write(tmp_path, "vanilla", 1.0, matrices={800: np.eye(3), 1200: np.ones((3, 3)), 1600: np.zeros((3, 3))})
    write(tmp_path, "cchain", 1.0, matrices={1592: np.array([[2.0, -1], [-1, 2]])})
    (results,) = read_groups(tmp_path)
    figure = plot_heat_maps(results, lines("gym_control"), tmp_path / "ntk.png", "title")
    assert [panel.get_title() for panel in figure.axes[:6]] == [
        "step 800\nsrank 3, off-diagonal sum 0",
        "step 1 200\nsrank 1, off-diagonal sum 6",
        "step 1 600\nsrank 0, off-diagonal sum 0",
        *("step 800\nno matrix", "step 1 200\nno matrix", "step 1 592\nsrank 2, off-diagonal sum 2"),
    ]
    assert [panel.get_ylabel() for panel in figure.axes[:4:3]] == ["PPO, seed 0", "C-CHAIN PPO, seed 0"]


def test_a_table_by_hand(tmp_path):
    for seed, srank in ((0, 7.0), (1, 8.0)):
        write(tmp_path, "cchain", srank, seed=seed)
    write(tmp_path, "projection", 2.0)
    (results,) = read_groups(tmp_path)
    rows = [line.strip("| ").split(" | ") for line in table(results).splitlines()]
    assert ["NTK: srank", "C-CHAIN PPO", "0 1", "7 / 8", "7 / 8"] in rows
    assert ["NTK: srank", "projection alone", "0", "2", "2"] in rows
    assert ["return per episode", "projection alone", "0", "-10", "-20"] in rows


def test_the_page_comes_from_the_results_alone(tmp_path, monkeypatch):
    # Whose drawing is tested with the report
    monkeypatch.setattr("benchmarks.plasticity.page.plot_quantities", lambda results, path, *others, **options: path.touch())
    (tmp_path / "docs").mkdir()
    page = tmp_path / "docs/plasticity.md"
    page.write_text("<!-- table: plasticity -->\n\n<!-- end -->\n")
    write(tmp_path / "results", "cchain", 3.0, matrices={800: np.eye(3)})
    write(tmp_path / "results", "vanilla", 5.0, "procgen", "Continual/Starpilot-v0")
    command(tmp_path, "--write")
    text = page.read_text()
    assert "### Acrobot-v1, 2 × 800 steps" in text and "### Starpilot-v0, 2 × 800 steps" in text
    pictures = sorted(path.name for path in (tmp_path / "docs/images/plasticity").iterdir())
    # Starpilot's run has no matrices
    assert pictures == ["Acrobot-v1_2x800.png", "Acrobot-v1_2x800_ntk.png", "Starpilot-v0_2x800.png"]
    assert all(f"images/plasticity/{name}" in text for name in pictures)
