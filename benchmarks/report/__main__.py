"""
What the runs of a budget say beside the paper's numbers: tables, learning curves, rliable's metrics and NTK figures, as
``report.md`` with pictures and as ``report.html``, one page that needs nothing beside it.

    python -m benchmarks.report --budget reduced
"""

import argparse
from pathlib import Path

from benchmarks.grid.results import read_results
from benchmarks.report.document import write_report


def main() -> None:
    """Parse the command line, read the results, write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results"), help="Folder of all results")
    parser.add_argument("--budget", default="reduced", help="Name of the budget")
    parser.add_argument("--output", type=Path, help="Folder of the report, by default the budget's in the results")
    args = parser.parse_args()

    results, unreadable = read_results(args.results)
    chosen = [result for result in results if result.experiment == args.budget]
    # A run that cannot be read is of the budget in whose folder it is
    inside = args.results / args.budget
    reasons = [reason for path, reason in unreadable.items() if path.is_relative_to(inside)]
    folder = args.output or inside
    try:
        if not chosen:
            budgets = ", ".join(sorted({result.experiment for result in results})) or "none"
            reasons.insert(0, f"no results of --budget {args.budget} in {args.results}; the budgets there: {budgets}")
            raise ValueError("; ".join(reasons))
        left_out = write_report(chosen, args.budget, folder, reasons)
    # Runs that are not comparable, too
    except ValueError as error:
        parser.error(str(error))
    for reason in left_out:
        print(f"Left out: {reason}")
    print(f"Written: {folder}/report.md, {folder}/report.html")


if __name__ == "__main__":
    main()
