"""
How much C-CHAIN PPO depends on β and on the size of its reference batch, on Acrobot and LunarLander: J(T) and cost. Runs that
are done are not made again, others go on where they were. PPO and C-CHAIN with the paper's β are runs of the grid.

    python -m benchmarks.sensitivity --dry-run                     # what there is, and what the rest will cost
    python -m benchmarks.sensitivity --jobs 2                      # makes the runs that are missing
    python -m benchmarks.sensitivity --parameter reference --value 0.25 8 --env Continual/Acrobot-v1 --seeds 0
    python -m benchmarks.sensitivity --time                        # measures the cost, some minutes
    python -m benchmarks.sensitivity --write                       # trains nothing; tables and picture, into the documentation
"""

import argparse
from collections.abc import Sequence

from rich.console import Console

from benchmarks.grid.arguments import add_folder_arguments
from benchmarks.grid.executor import train_all
from benchmarks.grid.plan import BUDGETS
from benchmarks.number_text import thousands
from benchmarks.report.places import write_tables
from benchmarks.run import list_grid
from benchmarks.sensitivity.costs import measure, read_costs
from benchmarks.sensitivity.picture import plot
from benchmarks.sensitivity.runs import ENVS, PARAMETERS, all_runs, read_scores
from benchmarks.sensitivity.tables import cost_table, sensitivity_table

PICTURE = "images/sensitivity.png"
COSTS = "sensitivity_costs.csv"


def main(arguments: Sequence[str] | None = None) -> None:
    """
    :param arguments: Arguments of the command line
    """
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.sensitivity", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--parameter", nargs="+", default=list(PARAMETERS), choices=list(PARAMETERS), help="What is varied")
    parser.add_argument("--value", nargs="+", help="Some of its values, by default all, and PPO")
    parser.add_argument("--env", nargs="+", default=list(ENVS), choices=ENVS, help="Environment ids")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1], help="Seeds of agents and of the offsets")
    parser.add_argument("--budget", default="reduced", choices=BUDGETS, help="Length of the runs, as of benchmarks.run")
    parser.add_argument("--jobs", type=int, default=1, help="Runs at a time")
    parser.add_argument("--dry-run", action="store_true", help="List the runs and what they will cost, and train nothing")
    parser.add_argument("--time", action="store_true", help="Measure what an iteration costs, and train nothing")
    parser.add_argument("--write", action="store_true", help="Put tables and picture into the documentation, train nothing")
    add_folder_arguments(parser, logs="logs/grid")
    args = parser.parse_args(arguments)
    try:
        runs = all_runs(args.parameter, args.value, args.env, args.seeds, args.budget)
    except (ValueError, ImportError) as error:
        parser.error(str(error))
    if args.dry_run:
        list_grid(runs, args.results, args.logs, Console())
        return
    if args.time:
        measure(args.results / COSTS)
    elif not args.write:
        train_all(runs, args.results, args.jobs, args.logs)

    costs = read_costs(args.results / COSTS)
    scores = {name: read_scores(name, args.seeds, args.budget, args.results) for name in PARAMETERS}
    tables = {
        f"sensitivity_{name}": sensitivity_table(name, values, base, args.seeds) for name, (values, base) in scores.items()
    }
    # β costs nothing
    tables["sensitivity_cost"] = cost_table("reference", list(scores["reference"][0]), costs)
    print("\n\n".join(tables.values()))
    if args.write:
        title = f"{runs[0].n_tasks} tasks of {thousands(runs[0].steps_per_task)} steps"
        plot(scores, costs, args.docs / PICTURE, title)
        write_tables(tables, args.docs)


if __name__ == "__main__":
    main()
