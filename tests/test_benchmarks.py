"""The commands ``demo``, ``compare`` and ``references``, with a training command that starts at once."""

import subprocess
import sys
from functools import partial

import pytest

from benchmarks import compare, demo, references
from benchmarks.grid.executor import LocalBackend
from benchmarks.grid.results import read_results
from benchmarks.grid.run import ROOT, make_run
from benchmarks.grid.suites import paper_length
from benchmarks.report.random_policy import look_at_task
from tests.extras import needs_dm_control
from tests.fake_training import fake_program

LENGTH = ["--n-tasks", "2", "--steps-per-task", "800"]


@pytest.fixture
def run_command(tmp_path, monkeypatch):
    """Runs a command, with instructions for the attempts of each seed, in the folder of the test."""

    def run(command, arguments, **behaviours):
        program = fake_program(tmp_path / "fake", {int(name[1:]): attempts for name, attempts in behaviours.items()})
        monkeypatch.setattr("benchmarks.grid.executor.LocalBackend", partial(LocalBackend, program=program))
        monkeypatch.setattr(sys, "argv", ["command", *arguments, "--output", str(tmp_path / "out")])
        command.main()
        return sorted(str(result.path.relative_to(tmp_path / "out")) for result in read_results(tmp_path / "out")[0])

    return run


def is_picture(path):
    return path.read_bytes().startswith(b"\x89PNG")


def test_demo(run_command, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(demo, "look_at_task", partial(look_at_task, n_episodes=1))
    arguments = [*LENGTH, "--seeds", "0", "1"]
    assert run_command(demo, arguments) == [
        f"demo_2x800/gym_control/Continual-Acrobot-v1/{method}/seed_{seed}"
        for method in ("cchain", "vanilla")
        for seed in (0, 1)
    ]
    shown = capsys.readouterr().out
    assert "4 of 4: Acrobot-v1" in shown and shown.count("C-CHAIN PPO") == 2 and "random policy" in shown
    assert is_picture(tmp_path / "out" / "demo_gym_control_2x800_seeds_0_1.png")
    # Again: nothing is trained
    run_command(demo, arguments, _0=["fail"], _1=["fail"])
    assert "random policy" in capsys.readouterr().out


def test_compare(run_command, tmp_path, capsys):
    arguments = ["--suite", "gym_control", "--env", "Continual/Acrobot-v1", "--method", "cchain", "trac", "--seeds", "0"]
    folder = "compare_2x800/gym_control/Continual-Acrobot-v1"
    assert run_command(compare, [*arguments, *LENGTH, "--random-episodes", "1"]) == [
        f"{folder}/cchain/seed_0",
        f"{folder}/trac/seed_0",
    ]
    table = (tmp_path / "out" / folder / "table.md").read_text()
    assert table in capsys.readouterr().out + "\n"
    assert [line.split(" | ")[0].strip("| *") for line in table.splitlines() if line] == [
        *("method", "---", "TRAC", "C-CHAIN PPO", "TRAC", "C-CHAIN PPO", "random policy"),
        *("method", "---", "TRAC", "C-CHAIN PPO"),
    ]
    assert "| TRAC | 0 | -10.0 | -20.0 | -15.0 |" in table
    assert is_picture(tmp_path / "out" / folder / "curves.png")


def test_references(run_command, tmp_path, capsys):
    env_ids = ["Continual/Acrobot-v1", "Continual/CartPole-v1"]
    folders = [f"references_2x800/gym_control/Continual-{name}" for name in ("Acrobot-v1", "CartPole-v1")]
    assert run_command(references, [*LENGTH, "--seeds", "0", "--env", *env_ids]) == sorted(
        f"{folder}/{name}/seed_0" for folder in folders for name in references.LINES
    )
    shown = capsys.readouterr().out
    for folder in folders:
        table = (tmp_path / "out" / folder / "table.md").read_text()
        assert "| next | 0 | -10.0 | -20.0 | -15.0 |" in table and table in shown + "\n"
        assert is_picture(tmp_path / "out" / folder / "curves.png")


def test_what_the_references_differ_in():
    runs = {name: references.variant_run("gym_control", name, "Continual/Acrobot-v1", 0, 2, 800) for name in references.LINES}
    overrides = {name: run.overrides for name, run in runs.items()}
    assert overrides == {"independent": (), "next": ("churn_reference:'next'",), "half": ("churn_batch_size:0.5",)}


def test_a_failed_run_names_its_log_and_ends_the_command(run_command, tmp_path):
    with pytest.raises(SystemExit, match=r"Acrobot-v1 vanilla seed 0 failed: ValueError: boom; see .*log.txt"):
        run_command(demo, LENGTH, _0=["fail"])


@pytest.mark.parametrize(
    "command, arguments, message",
    [
        (demo, ["--n-tasks", "-1"], "`n_tasks` must be at least 1; got -1"),
        pytest.param(compare, ["--suite", "dmc", "--n-tasks", "9"], "`n_tasks` must be at most 3", marks=needs_dm_control),
        (compare, ["--suite", "gym_control", "--method", "nonsense"], "`method` must be one of oracle, .*; got nonsense"),
        (compare, ["--suite", "gym_control", "--env", "Continual/Maze-v0"], "`env_id` must be one of"),
        (references, ["--steps-per-task", "0"], "`steps_per_task` must be at least 1; got 0"),
        (demo, ["--n-tasks", "0"], "`n_tasks` must be at least 1; got 0"),
        (compare, ["--suite", "gym_control", "--steps-per-task", "0"], "`steps_per_task` must be at least 1; got 0"),
        (references, ["--suite", "minatar", "--n-tasks", "1"], "--variants must be independent or next in minatar"),
    ],
)
def test_errors_come_before_any_work(run_command, tmp_path, capsys, command, arguments, message):
    with pytest.raises(SystemExit) as error:
        run_command(command, arguments)
    captured = capsys.readouterr().err
    assert error.value.code == 2 and message.split(".*")[0] in captured and message.split(".*")[-1] in captured
    assert not (tmp_path / "out").exists()


def test_a_missing_package_is_said_in_a_line(run_command, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "minatar.gym", None)
    paper_length.cache_clear()
    with pytest.raises(SystemExit):
        run_command(demo, ["--suite", "minatar"])
    assert "MinAtar is not installed" in capsys.readouterr().err


def test_what_the_commands_do_not_need():
    """Of the packages that only the report or a cluster needs. `make demo` does not install them."""
    code = (
        "import sys\n"
        "for name in ('ray', 'rliable', 'seaborn', 'markdown_it', 'optuna', 'rl_zoo3'): sys.modules[name] = None\n"
        "import benchmarks.demo, benchmarks.compare, benchmarks.plasticity.__main__, benchmarks.run"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_task_without_an_agent():
    run = make_run("minatar", "Continual/MinAtar-v0", "cchain", 0, 3, 100, "test")
    look = look_at_task(run, 1, n_episodes=150)
    assert look.frame.shape == (160, 160, 3)
    # Measured with MinAtar alone over 9000 episodes: 0.51 ± 0.01
    assert 0.35 < look.random_return < 0.75


def test_a_suite_that_shows_nothing_has_no_frame():
    assert look_at_task(make_run("gym_control", "Continual/CartPole-v1", "cchain", 0, 2, 100, "test"), 1, 1).frame is None
