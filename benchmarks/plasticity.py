"""
How churn, the neural tangent kernel and the networks develop over the tasks, of PPO and of C-CHAIN, and of C-CHAIN with one
component of its gradient alone (the figures and the ablation of Section 5.2 of the paper): trains with the monitors, and
writes a table and a picture. The same command goes on where it was interrupted.

    python -m benchmarks.plasticity --env Continual/Acrobot-v1 --n-tasks 4 --steps-per-task 32000 --seeds 0 1
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.curves import smoothed
from benchmarks.markdown import markdown_table
from benchmarks.runs import Run, complete, shipped_hyperparameters
from benchmarks.suites import SUITES

MONITORS = [
    "sb3_cchain.ChurnMonitor",
    "sb3_cchain.analysis.NTKCallback",
    "sb3_cchain.analysis.NetworkHealth",
]


# Of a run, environment steps and values of each scalar, ``(2, n)``, by its tag
Series = dict[str, np.ndarray]


class Variant(NamedTuple):
    """What is compared: an algorithm, and how it differs from the shipped hyperparameters."""

    algo: str
    hyperparams: tuple[str, ...]
    label: str
    color: str


VARIANTS = {
    "ppo": Variant("ppo", (), "PPO", "tab:gray"),
    "ppo_cchain": Variant("ppo_cchain", (), "C-CHAIN PPO", "tab:blue"),
    "projection": Variant("ppo_cchain", ("churn_component:'projection'",), "projection alone", "tab:orange"),
    "orthogonal": Variant("ppo_cchain", ("churn_component:'orthogonal'",), "orthogonal alone", "tab:green"),
}


class Figure(NamedTuple):
    """What is drawn and tabled: a scalar of TensorBoard, or one of its kind."""

    tag: str
    label: str
    logarithmic: bool = False


FIGURES = [
    Figure("continual/mean_return", "return per episode"),
    Figure("ntk/srank", "NTK: srank"),
    Figure("ntk/off_diagonal_sum", "NTK: off-diagonal sum", logarithmic=True),
    Figure("ntk/diagonal_sum", "NTK: diagonal sum", logarithmic=True),
    Figure("churn_monitor/fresh/policy_churn", "policy churn, KL", logarithmic=True),
    Figure("health/dormant_share", "dormant units, share"),
]


def series_of(run: Run) -> Series:
    """
    :param run: A finished run
    :return: Of each figure, by its tag, environment steps of the rollouts that the values belong to, and values, ``(2, n)``;
        none where it was not logged
    """
    logged: dict[str, list[tuple[int, float]]] = {figure.tag: [] for figure in FIGURES}
    for row in run.scalars(tuple(logged)):
        if row["name"] in logged:  # and does not only begin like one of them
            logged[row["name"]].append((row["timesteps"], float(row["value"])))
    series = {tag: np.array(rows).reshape(-1, 2).T for tag, rows in logged.items()}
    for tag, (steps, _) in series.items():
        if tag.startswith("churn") and len(steps):
            # SB3 writes what `train()` logs at the end of the next rollout
            steps -= np.diff(series["ntk/srank"][0]).min()
    return series


def table(runs: dict[str, list[Run]], series: Mapping[Run, Series]) -> str:
    """
    :param runs: Finished runs of each variant
    :param series: What each of them logged
    :return: For each figure and variant its mean over the logs of each task, for each of the seeds
    """
    run = next(iter(runs.values()))[0]
    rows = []
    for figure in FIGURES:
        for name, of_variant in runs.items():
            per_seed = []
            for run in of_variant:
                steps, values = series[run][figure.tag]
                task = (steps - 1) // run.steps_per_task  # the rollout that ends a task is still of that task
                per_seed.append([values[task == i].mean() if (task == i).any() else np.nan for i in range(run.n_tasks)])
            cells = [" / ".join(f"{mean:.3g}" for mean in of_task) for of_task in zip(*per_seed, strict=True)]
            rows.append([figure.label, VARIANTS[name].label, *cells])
    return markdown_table(["", "", *(f"task {task}" for task in range(run.n_tasks))], rows)


def plot(runs: dict[str, list[Run]], series: Mapping[Run, Series], path: Path, title: str, window: int = 5) -> None:
    """
    A panel for each figure: a line per run, and the task switches.

    :param runs: Finished runs of each variant
    :param series: What each of them logged
    :param path: PNG file
    :param title: Title
    :param window: Logs that the running mean goes over
    """
    plt.style.use("default")  # RL Zoo's plots leave seaborn's behind
    shape, axes = plt.subplots(len(FIGURES) // 2, 2, figsize=(11, 2.6 * len(FIGURES) // 2), sharex=True, layout="constrained")
    run = next(iter(runs.values()))[0]
    for panel, figure in zip(axes.T.flat, FIGURES, strict=True):
        for name, of_variant in runs.items():
            curves = [(steps, smoothed(values, window)) for steps, values in (series[run][figure.tag] for run in of_variant)]
            curves = [curve for curve in curves if len(curve[0])]
            if not curves:
                continue
            variant = VARIANTS[name]
            for i, curve in enumerate(curves):
                label = variant.label if i == 0 else None
                panel.plot(*curve, color=variant.color, linewidth=1.6, alpha=0.9 if i == 0 else 0.6, label=label)
        if figure.logarithmic:
            panel.set_yscale("log")
            # What a policy that has become certain is left with would take most of the scale
            panel.set_ylim(bottom=1e-4 * max(np.max(line.get_ydata()) for line in panel.get_lines()))
        for task in range(1, run.n_tasks):
            panel.axvline(task * run.steps_per_task, color="0.35", linestyle="--", linewidth=1)
        panel.set_ylabel(figure.label)
        panel.set_xlim(0, run.total_steps)
        panel.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}k" if value else "0")
        panel.spines[["top", "right"]].set_visible(False)
    for panel in axes[-1]:
        panel.set_xlabel("environment steps")
    shape.suptitle(title)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    shape.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    shape.savefig(path, dpi=110)
    plt.close(shape)


def make_runs(
    variant: Variant, name: str, env_id: str, seeds: Sequence[int], n_tasks: int, steps: int, folder: Path
) -> list[Run]:
    """
    :param variant: What is trained
    :param name: Its name
    :param env_id: Environment id
    :param seeds: Seeds
    :param n_tasks: Length of the task sequence
    :param steps: Environment steps per task
    :param folder: Parent of the runs' folders
    :return: A run for each seed, with the monitors after the callbacks that the shipped hyperparameters have
    """
    shipped = shipped_hyperparameters(variant.algo, env_id) or {}
    callbacks = f"callback:{[*shipped.get('callback', []), *MONITORS]}"
    env_kwargs = SUITES["gym_control"].env_kwargs
    return [
        Run(
            *(variant.algo, env_id, seed, n_tasks, steps, folder / f"{name}_seed{seed}"),
            env_kwargs=env_kwargs(n_tasks, seed),
            hyperparams=(callbacks, *variant.hyperparams),
        )
        for seed in seeds
    ]


def main() -> None:
    """Parse the command line, train, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="Continual/Acrobot-v1", choices=SUITES["gym_control"].env_ids, help="Environment id")
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=list(VARIANTS), help="What is compared")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1], help="Seeds of agents and of the offsets")
    parser.add_argument("--n-tasks", type=int, default=4, help="Length of the task sequence")
    parser.add_argument("--steps-per-task", type=int, default=32_000, help="Environment steps per task")
    parser.add_argument("--jobs", type=int, default=2, help="Processes at a time")
    parser.add_argument("--output", type=Path, default=Path("logs"), help="Folder of the runs")
    args = parser.parse_args()

    folder = args.output / "plasticity" / f"{args.env.replace('/', '-')}_{args.n_tasks}x{args.steps_per_task}"
    runs = {
        name: make_runs(VARIANTS[name], name, args.env, args.seeds, args.n_tasks, args.steps_per_task, folder)
        for name in args.variants
    }
    complete([of_variant[i] for i in range(len(args.seeds)) for of_variant in runs.values()], args.jobs)
    series = {run: series_of(run) for of_variant in runs.values() for run in of_variant}
    means = table(runs, series)
    (folder / "table.md").write_text(means + "\n")
    title = f"{args.env}, {len(args.seeds)} seeds" if len(args.seeds) > 1 else args.env
    plot(runs, series, folder / "plasticity.png", title)
    print(f"{means}\n\nWritten: {folder}/table.md, {folder}/plasticity.png")


if __name__ == "__main__":
    main()
