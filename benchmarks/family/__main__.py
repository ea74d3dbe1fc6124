"""
Does churn reduction help or harm outside the paper's suites? Trains base algorithms and their C-CHAIN variants, evaluates
them as they go, and makes tables and pictures. Runs that are done are not made again; others go on where they were.

    python -m benchmarks.family                                             # the cases, and how many of their runs are done
    python -m benchmarks.family --case her_bit_flipping dqn_cartpole        # makes their missing runs, prints their tables
    python -m benchmarks.family --case ppo_cartpole --variant ppo --seeds 0 1
    python -m benchmarks.family --case a2c_betas sac_betas                  # several β, from which the defaults come
    python -m benchmarks.family --write                                     # trains nothing; all tables and pictures
"""

import argparse
from collections.abc import Sequence
from typing import Any

from benchmarks.family.cases import CASES, EVIDENCE
from benchmarks.family.picture import plot
from benchmarks.family.tables import about, case_table, falls_table, read_all, summary_table
from benchmarks.family.training import runs_of, train_all
from benchmarks.grid.arguments import add_folder_arguments
from benchmarks.report.places import write_tables


def main(arguments: Sequence[str] | None = None) -> None:
    """
    :param arguments: Arguments of the command line
    """
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.family", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--case", nargs="+", choices=list(CASES), metavar="NAME", help=f"Some of {', '.join(CASES)}")
    parser.add_argument("--variant", nargs="+", help="Some of the cases' variants, by default all")
    parser.add_argument("--seeds", nargs="+", type=int, help="Some of the cases' seeds, by default all")
    parser.add_argument("--jobs", type=int, default=1, help="Runs at a time")
    parser.add_argument("--write", action="store_true", help="Put tables and pictures into the documentation")
    add_folder_arguments(parser, "benchmarks/results/family", "logs/family")
    args = parser.parse_args(arguments)
    all_runs = {name: runs_of(name, args.results, args.logs) for name in CASES}
    chosen = [run for name in args.case or () for run in all_runs[name]]
    _check(parser, "--variant", args.variant, [run.variant_name for run in chosen])
    _check(parser, "--seeds", args.seeds, [run.seed for run in chosen])
    if args.variant is not None:
        chosen = [run for run in chosen if run.variant_name in args.variant]
    if args.seeds is not None:
        chosen = [run for run in chosen if run.seed in args.seeds]
    for run in train_all(chosen, args.jobs):
        print(f"{run.name}: done", flush=True)

    if not args.case:
        for name, runs in all_runs.items():
            n_done = sum(run.result.exists() for run in runs)
            print(f"{name:34} {n_done:2} of {len(runs):2} runs  {CASES[name].title}; {CASES[name].source}")
    results = {name: (CASES[name], read_all(runs)) for name, runs in all_runs.items()}
    tables = {}
    for name in args.case or CASES:
        case, evaluations = results[name]
        tables[f"family_{name}"] = case_table(case, evaluations)
        if case.solved is not None:
            tables[f"falls_{name}"] = falls_table(case, evaluations)
    if args.case:
        print(*(f"\n{name}\n\n{table}" for name, table in tables.items()), sep="\n")
    if args.write:
        for name in args.case or CASES:
            case, evaluations = results[name]
            parts = [about(case), tables[f"family_{name}"]]
            if name in EVIDENCE and any(evaluations.values()):
                picture = f"images/family/{name}.png"
                plot(case, evaluations, args.docs / picture)
                parts.append(f"![Learning curves: {case.title}](../{picture})")
            tables[f"family_{name}"] = "\n\n".join(parts)
        evidence = {name: result for name, result in results.items() if name in EVIDENCE}
        write_tables({**tables, "family_evidence": summary_table(evidence)}, args.docs)


def _check(parser: argparse.ArgumentParser, option: str, asked: Sequence[Any] | None, known: Sequence[Any]) -> None:
    if unknown := [str(each) for each in asked or () if each not in known]:
        choices = ", ".join(map(str, dict.fromkeys(known))) or "none without --case"
        parser.error(f"{option} must be of the cases: {choices}; got {', '.join(unknown)}")


if __name__ == "__main__":
    main()
