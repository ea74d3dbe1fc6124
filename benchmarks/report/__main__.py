"""
What the runs of a budget say beside the paper's numbers: verdicts, what is missing, tables, learning curves, rliable's metrics
and NTK figures, as ``report.md`` with pictures and as ``report.html``, one page that needs nothing beside it. With runs of
several strengths of a method there is ``best_of.csv``, the best of them in each environment. Everything is made anew from the
result folders.

    python -m benchmarks.report --budget reduced
    python -m benchmarks.report --budget reduced paper
"""

import argparse
from pathlib import Path

from benchmarks.grid.results import read_results
from benchmarks.report.document import write_report


def main() -> None:
    """Parse the command line, read the results, write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results"), help="Folder of all results")
    parser.add_argument("--budget", nargs="+", default=["reduced"], help="Names of budgets: each has a report of its own")
    parser.add_argument(
        "--output", type=Path, help="The reports go into a folder of each budget in it, by default the results'"
    )
    args = parser.parse_args()

    results, unreadable = read_results(args.results)
    for budget in args.budget:
        chosen = [result for result in results if result.experiment == budget]
        # A run that cannot be read is of the budget in whose folder it is
        reasons = [reason for path, reason in unreadable.items() if path.is_relative_to(args.results / budget)]
        folder = (args.output or args.results) / budget
        try:
            if not chosen:
                budgets = ", ".join(sorted({result.experiment for result in results})) or "none"
                reasons.insert(0, f"no results of --budget {budget} in {args.results}; the budgets there: {budgets}")
                raise ValueError("; ".join(reasons))
            left_out = write_report(chosen, budget, folder, reasons)
        # Runs that are not comparable, too
        except ValueError as error:
            parser.error(str(error))
        for reason in left_out:
            print(f"Left out: {reason}")
        print(f"Written: {folder}/report.md, {folder}/report.html")


if __name__ == "__main__":
    main()
