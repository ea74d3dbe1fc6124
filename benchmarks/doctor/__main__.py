"""
Is the doctor right? Trains healthy and sick models in Gymnasium's classic control, inspects them, and shows how often each
finding was right and wrong. Models that are there are not trained again, and those in the results not inspected again.

    python -m benchmarks.doctor             # trains and inspects what is missing; goes on where it was interrupted
    python -m benchmarks.doctor --again     # inspects all models again, after a change of a measure
    python -m benchmarks.doctor --write     # besides, puts the tables into the documentation
"""

import argparse
import warnings
from collections.abc import Sequence
from pathlib import Path

import torch as th

from benchmarks.doctor.cases import CASES
from benchmarks.doctor.results import confusion_table, examine, findings_table, models_table, read, write, wrong_table
from benchmarks.doctor.training import patients, train_missing
from benchmarks.grid.arguments import add_folder_arguments
from benchmarks.grid.run import ROOT
from benchmarks.report.places import write_tables


def main(arguments: Sequence[str] | None = None) -> None:
    """
    :param arguments: Arguments of the command line
    """
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.doctor", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--case", nargs="+", choices=list(CASES), metavar="NAME", help="Some of the trainings, by default all")
    parser.add_argument("--again", action="store_true", help="Inspect all models again")
    parser.add_argument("--write", action="store_true", help="Put the tables into the documentation")
    parser.add_argument("--models", type=Path, default=ROOT / "logs/doctor", help="Folder of the models")
    add_folder_arguments(parser, "benchmarks/results/doctor")
    args = parser.parse_args(arguments)
    th.set_num_threads(1)
    warnings.simplefilter("ignore")  # sick models give many
    all_patients, path = patients(args.models), args.results / "models.csv"
    chosen = args.case or list(CASES)
    # With --again a file of older measures need not be readable, but what is not inspected again stays
    kept = [patient for patient in all_patients if not (args.again and patient.case_name in chosen)]
    known = {e.patient.name: e for e in read(path, kept)}
    for name in chosen:
        missing = [patient for patient in all_patients if patient.case_name == name and patient.name not in known]
        train_missing(missing)
        for patient in missing:
            known[patient.name] = examine(patient)
            write(path, [known[p.name] for p in all_patients if p.name in known])
            print(f"{patient.name}: {', '.join(check.name for check in known[patient.name].found) or 'nothing'}", flush=True)
    examinations = [known[patient.name] for patient in all_patients if patient.name in known]
    write(path, examinations)  # with the findings of the present thresholds
    tables = {
        "doctor_confusion": confusion_table(examinations),
        "doctor_wrong": wrong_table(examinations),
        "doctor_sick": models_table(examinations),
    }
    print(*tables.values(), sep="\n\n")
    if args.write:
        write_tables({"doctor_findings": findings_table(), **tables}, args.docs)


if __name__ == "__main__":
    main()
