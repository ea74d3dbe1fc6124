"""The command ``benchmarks.doctor``: its models and its tables, of results written by hand."""

from dataclasses import replace

import pytest
from stable_baselines3 import PPO

from benchmarks.doctor import __main__ as command
from benchmarks.doctor import cases, results, training
from benchmarks.doctor.cases import CASES, CHOSEN_ON, HELD_OUT, Case
from benchmarks.doctor.results import (
    Examination,
    confusion_table,
    findings_table,
    models_table,
    read,
    write,
    wrong_table,
)
from benchmarks.doctor.training import Patient, patients
from benchmarks.grid.run import ROOT
from sb3_cchain.analysis.findings import BY_NAME, CHECKS

TINY = {"n_steps": 16, "batch_size": 16, "n_epochs": 1, "policy_kwargs": {"net_arch": [4]}}
HEALTHY = Case(PPO, "CartPole-v1", (16, 32), TINY, normalize=True)
SICK = Case(PPO, "CartPole-v1", (16,), {**TINY, "gamma": 0.0}, ("short_horizon",), cause="γ = 0")


@pytest.fixture
def small(monkeypatch):
    """Healthy models that thresholds were chosen on, and a sick one that was held out."""
    own = {"healthy": HEALTHY, "sick": SICK}
    for module in (cases, training, command):
        monkeypatch.setattr(module, "CASES", own, raising=False)
    monkeypatch.setattr(training, "CHOSEN_ON", {"healthy": HEALTHY})
    monkeypatch.setattr(results, "N_STEPS", 16)


def cells(table, row):
    (found,) = (line for line in table.splitlines() if line.startswith(f"| {row} "))
    return [cell.strip() for cell in found.strip("|").split("|")][1:]


def test_every_finding_is_tried_on_both_sets():
    for some in (CHOSEN_ON, HELD_OUT):
        expected = {name for case in some.values() for name in case.expected}
        assert expected == set(BY_NAME)
        assert sum(not case.expected for case in some.values()) >= 9
    assert len(CASES) == len(CHOSEN_ON) + len(HELD_OUT)
    # Nothing held out is a case that thresholds were chosen on
    assert not [
        case for case in HELD_OUT.values() if replace(case, ages=()) in [replace(c, ages=()) for c in CHOSEN_ON.values()]
    ]


def test_tables(small, tmp_path):
    young, old, sick = patients(tmp_path)
    worst = {"short_horizon": 0.99, "large_rewards": 1.0}
    examinations = [
        Examination(young, 20.0, worst, {}),
        Examination(old, 20.0, {**worst, "large_rewards": 1e6}, {}),
        Examination(sick, 20.0, {"short_horizon": 0.0, "exploding_weights": 1e3}, {"exploding_weights": "layer"}),
    ]
    table = confusion_table(examinations)
    assert cells(table, "`short_horizon`") == ["possible", "", "0 of 2", "1 of 1", ""]
    assert cells(table, "`large_rewards`") == ["likely", "", "1 of 2", "", ""]
    assert cells(table, "**any, likely**") == ["", "", "1 of 2", "1 of 1", ""]
    assert "| PPO, CartPole-v1, 32 steps | chosen on | false alarm | `large_rewards` | 1e+06 (at most 5000) |" in wrong_table(
        examinations
    )
    assert "| PPO, CartPole-v1 | γ = 0 | held out | `exploding_weights`, **`short_horizon`** |" in models_table(examinations)

    write(tmp_path / "models.csv", examinations)
    assert read(tmp_path / "models.csv", patients(tmp_path)) == examinations

    missed = [Examination(sick, 20.0, {"short_horizon": 1.0}, {})]
    assert "| missed: γ = 0 | `short_horizon` | 1 (at least 0.8) |" in wrong_table(missed)
    assert models_table(missed).endswith("| ~~`short_horizon`~~ |")
    assert wrong_table(examinations[:1]) == "None."


def test_trains_and_inspects_what_is_missing(small, tmp_path, capsys):
    arguments = ["--models", str(tmp_path), "--results", str(tmp_path / "results")]
    command.main(arguments)
    first = capsys.readouterr().out
    assert "sick@16: short_horizon" in first and {path.name for path in tmp_path.glob("*.zip")} == {
        *("healthy@16.zip", "healthy@32.zip", "sick@16.zip")
    }
    assert (tmp_path / "healthy@32.pkl").exists()
    rows = (tmp_path / "results" / "models.csv").read_text()
    assert rows.count("\n") == 4 and set(rows.splitlines()[0].split(",")) >= {check.name for check in CHECKS}

    (tmp_path / "sick@16.zip").unlink()
    command.main(arguments)  # its result is there
    assert "sick@16:" not in capsys.readouterr().out and not (tmp_path / "sick@16.zip").exists()
    command.main(["--again", *arguments])
    assert "sick@16: short_horizon" in capsys.readouterr().out
    assert (tmp_path / "results" / "models.csv").read_text() == rows
    # Those of other cases stay
    command.main(["--again", "--case", "healthy", *arguments])
    assert "healthy@16:" in (shown := capsys.readouterr().out) and "sick@16:" not in shown
    assert (tmp_path / "results" / "models.csv").read_text() == rows


def test_models_are_of_their_ages(small, tmp_path):
    training.train_missing(patients(tmp_path))
    for patient in (Patient("healthy", 16, tmp_path), Patient("healthy", 32, tmp_path)):
        assert PPO.load(patient.path).num_timesteps == patient.steps
    assert Patient("healthy", 32, tmp_path).make_env(0).obs_rms.count > 32


def test_the_documentation_has_the_table_of_the_code():
    page = (ROOT / "docs" / "modules" / "doctor.md").read_text()
    assert findings_table() in page, "python -m benchmarks.doctor --write"
