"""
How churn, the neural tangent kernel and the networks develop over the tasks, of PPO and of C-CHAIN, and of C-CHAIN with one
component of its gradient alone (the figures and the ablation of Section 5.2 of the paper): trains with the monitors, and
writes a table and a picture. The same command goes on where it was interrupted.

    python -m benchmarks.plasticity --env Continual/Acrobot-v1 --n-tasks 4 --steps-per-task 32000 --seeds 0 1
"""

import argparse
from dataclasses import replace

from benchmarks.grid.arguments import add_variant_arguments
from benchmarks.grid.executor import train_all
from benchmarks.grid.run import Run, make_run, shipped_hyperparameters, suite_methods
from benchmarks.grid.suites import SUITES
from benchmarks.report.figures import plot_quantities
from benchmarks.report.quantities import PLASTICITY
from benchmarks.report.task_tables import quantities_table

SUITE = "gym_control"
MONITORS = ("sb3_cchain.ChurnMonitor", "sb3_cchain.analysis.NTKCallback", "sb3_cchain.analysis.NetworkHealth")
PPO, CCHAIN = (suite_methods(SUITE)[name] for name in ("vanilla", "cchain"))

# What is compared: label and colour of each, and how it differs from the shipped hyperparameters
LINES = {
    "ppo": PPO,
    "ppo_cchain": CCHAIN,
    "projection": replace(CCHAIN, label="projection alone", color="tab:orange"),
    "orthogonal": replace(CCHAIN, label="orthogonal alone", color="tab:green"),
}
OVERRIDES = {name: (f"churn_component:'{name}'",) for name in ("projection", "orthogonal")}


def variant_run(name: str, env_id: str, seed: int, n_tasks: int, steps: int) -> Run:
    """
    :param name: One of ``LINES``
    :param env_id: Environment id
    :param seed: Seed
    :param n_tasks: Length of the task sequence
    :param steps: Environment steps per task
    :return: The run, with the monitors after the callbacks of the shipped hyperparameters
    """
    method = LINES[name]
    shipped = shipped_hyperparameters(method.algo, env_id) or {}
    callbacks = f"callback:{[*shipped.get('callback', []), *MONITORS]}"
    run = make_run(SUITE, env_id, method.name, seed, n_tasks, steps, f"plasticity_{n_tasks}x{steps}")
    return replace(run, variant=name, overrides=(callbacks, *OVERRIDES.get(name, ())))


def main() -> None:
    """Parse the command line, train, write and print the table and the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="Continual/Acrobot-v1", choices=SUITES[SUITE].env_ids, help="Environment id")
    add_variant_arguments(parser, LINES, seeds=[0, 1], n_tasks=4, steps_per_task=32_000)
    args = parser.parse_args()

    try:
        runs = [
            variant_run(name, args.env, seed, args.n_tasks, args.steps_per_task)
            for seed in args.seeds
            for name in args.variants
        ]
    except ValueError as error:
        parser.error(str(error))
    results = train_all(runs, args.output, args.jobs)

    table = quantities_table(results, LINES, PLASTICITY, per_seed=True)
    folder = results[0].path.parents[1]
    (folder / "table.md").write_text(table + "\n")
    title = f"{args.env}, {len(args.seeds)} seeds" if len(args.seeds) > 1 else args.env
    plot_quantities(results, folder / "plasticity.png", LINES, PLASTICITY, title, window=5)
    print(f"{table}\n\nWritten: {folder}/table.md, {folder}/plasticity.png")


if __name__ == "__main__":
    main()
