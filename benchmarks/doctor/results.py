"""What the doctor found in each model: a row of a file each, and the tables that follow from them."""

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import Any

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from benchmarks.doctor.training import Patient
from benchmarks.report.markdown import markdown_table
from benchmarks.report.places import LINE_LENGTH
from sb3_cchain.analysis.findings import CHECKS, Check
from sb3_cchain.analysis.inspection import inspect_model
from sb3_cchain.checkpoint.files import write_safely

# Of the rollout that the doctor looks at: another one than any of training
SEED = 1000
N_STEPS = 2048


@dataclass(frozen=True)
class Examination:
    """
    A model's measures.

    :param patient: The model
    :param mean_return: Of the episodes that ended in the rollout; not a number where none did
    :param worst: By name of the finding, the value of its measure in the worst part of the networks
    :param parts: By name of the finding, that part
    """

    patient: Patient
    mean_return: float
    worst: dict[str, float]
    parts: dict[str, str]

    @property
    def is_healthy(self) -> bool:
        """Whether nothing was done to make it sick."""
        return not self.patient.case.expected

    @property
    def found(self) -> list[Check]:
        """The findings, with the present thresholds."""
        return [check for check in CHECKS if check.name in self.worst and check.is_sick(self.worst[check.name])]


def examine(patient: Patient) -> Examination:
    """
    :param patient: A model that is there
    :return: Its measures
    """
    case = patient.case
    settings: dict[str, Any] = {"buffer_size": N_STEPS} if issubclass(case.algorithm, OffPolicyAlgorithm) else {}
    model = case.algorithm.load(patient.path, patient.make_env(SEED + case.seed), device="cpu", **settings)
    model.set_random_seed(SEED + case.seed)
    inspection = inspect_model(model, n_steps=N_STEPS)
    assert model.env is not None
    model.env.close()
    worst = {check.name: worst for check in CHECKS if (worst := check.worst(inspection.symptoms)) is not None}
    return Examination(
        patient,
        inspection.figures.get("rollout/mean_return", math.nan),
        {name: value for name, (_, value) in worst.items()},
        {name: part for name, (part, _) in worst.items() if part},
    )


def write(path: Path, examinations: Sequence[Examination]) -> None:
    """
    :param path: CSV file
    :param examinations: What was measured
    """
    header = ["model", "chosen_on", "algorithm", "environment", "expected", "found", "mean_return"]
    header += [check.name for check in CHECKS]
    with write_safely(path) as safe, open(safe, "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        for each in examinations:
            case = each.patient.case
            row = [each.patient.name, int(not each.patient.is_held_out), case.algorithm.__name__, case.env]
            row += [" ".join(case.expected), " ".join(check.name for check in each.found), f"{each.mean_return:.4g}"]
            writer.writerow([*row, *(_cell(each, check.name) for check in CHECKS)])


def _cell(examination: Examination, name: str) -> str:
    """As ``value`` or ``value part``."""
    if name not in examination.worst:
        return ""
    return f"{examination.worst[name]:.4g} {examination.parts.get(name, '')}".rstrip()


def read(path: Path, patients: Sequence[Patient]) -> list[Examination]:
    """
    :param path: CSV file
    :param patients: The models
    :return: What is in the file of them
    """
    if not path.exists():
        return []
    by_name = {patient.name: patient for patient in patients}
    with open(path, newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["model"] in by_name]
    examinations = []
    for row in rows:
        cells = {check.name: row[check.name].split(" ") for check in CHECKS if row.get(check.name)}
        worst = {name: float(cell[0]) for name, cell in cells.items()}
        parts = {name: cell[1] for name, cell in cells.items() if len(cell) > 1}
        examinations.append(Examination(by_name[row["model"]], float(row["mean_return"]), worst, parts))
    return examinations


def confusion_table(examinations: Sequence[Examination]) -> str:
    """
    :param examinations: What was measured
    :return: For each finding how often it was right and wrong, on the models that thresholds were chosen on and on the others.
        Sick models count for what their settings must lead to; healthy ones for all findings
    """
    groups = [[e for e in examinations if e.patient.is_held_out == held_out] for held_out in (False, True)]
    rows = []
    for check in CHECKS:
        cells = []
        for group in groups:
            sick = [e for e in group if check.name in e.patient.case.expected]
            healthy = [e for e in group if e.is_healthy]
            cells += [_share(sum(check in e.found for e in sick), len(sick))]
            cells += [_share(sum(check in e.found for e in healthy), len(healthy))]
        rows.append([f"`{check.name}`", check.certainty, *cells])
    for title, kinds in (("**any, likely**", ("likely",)), ("**any**", ("likely", "possible"))):
        cells = []
        for group in groups:
            for is_healthy in (False, True):
                models = [e for e in group if e.is_healthy == is_healthy]
                hits = sum(any(check.certainty in kinds for check in e.found) for e in models)
                cells.append(_share(hits, len(models)))
        rows.append([title, "", *cells])
    header = [
        "finding",
        "certainty",
        "chosen on: found",
        "chosen on: false alarms",
        "held out: found",
        "held out: false alarms",
    ]
    return markdown_table(header, rows)


def _share(count: int, total: int) -> str:
    return f"{count} of {total}" if total else ""


def wrong_table(examinations: Sequence[Examination]) -> str:
    """
    :param examinations: What was measured
    :return: Each false alarm, and each finding that was missed
    """
    rows = []
    for each in examinations:
        patient = each.patient
        where = "held out" if patient.is_held_out else "chosen on"
        about = f"{patient.case.algorithm.__name__}, {patient.case.env}, {patient.steps} steps"
        wrong = [(check, "false alarm") for check in each.found if each.is_healthy]
        wrong += [
            (c, f"missed: {patient.case.cause}") for c in CHECKS if c.name in patient.case.expected and c not in each.found
        ]
        for check, kind in wrong:
            value = f"{each.worst[check.name]:.3g}" if check.name in each.worst else "not measured"
            rows.append([about, where, kind, f"`{check.name}`", f"{value} ({check.healthy_range()})"])
    return markdown_table(["model", "set", "wrong", "finding", "measured (healthy)"], rows) if rows else "None."


def models_table(examinations: Sequence[Examination]) -> str:
    """
    :param examinations: What was measured
    :return: Each training that should make a model sick, and what was found in it
    """
    rows = []
    for each in examinations:
        case = each.patient.case
        if not each.is_healthy:
            found = [f"**`{c.name}`**" if c.name in case.expected else f"`{c.name}`" for c in each.found]
            missed = [f"~~`{name}`~~" for name in case.expected if name not in {check.name for check in each.found}]
            where = "held out" if each.patient.is_held_out else "chosen on"
            about = f"{case.algorithm.__name__}, {case.env}"
            rows.append([about, case.cause, where, ", ".join([*found, *missed]) or "nothing"])
    return markdown_table(["model", "what is wrong", "set", "found"], rows)


def findings_table() -> str:
    """
    :return: All findings: a table, and a list of what they mean
    """
    header = ["finding", "what is wrong", "measure", "healthy", "certainty"]
    rows = [
        [f"`{check.name}`", check.title, check.measure.replace("_", " "), check.healthy_range(), check.certainty]
        for check in CHECKS
    ]
    items = []
    for check in CHECKS:
        remedies = "; ".join(dict.fromkeys(remedy.title for remedy in check.remedies))
        text = f"- `{check.name}`: {check.meaning} *Threshold*: {check.source}. *Try* {remedies}."
        items.append(fill(text, LINE_LENGTH, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False))
    return "\n\n".join([markdown_table(header, rows), "\n".join(items)])
