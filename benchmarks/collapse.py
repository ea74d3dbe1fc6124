"""
Does PPO keep what it has learned in a world that does not change? Trains Stable-Baselines3's PPO and CChainPPO with their
default hyperparameters, evaluates them as they go, and shows how far they fall after they have solved the environment.

    python -m benchmarks.collapse                                  # CartPole-v1, five seeds, goes on where it was interrupted
    python -m benchmarks.collapse --env Acrobot-v1 --solved -100 --worst -500
"""

import argparse
import csv
import shutil
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.report.markdown import markdown_table
from sb3_cchain import CChainPPO, TrainingCheckpoint, resume
from sb3_cchain.analysis.plots import import_matplotlib
from sb3_cchain.checkpoint import has_checkpoint, write_safely

# Algorithm and the arguments that differ from its defaults, by name
VARIANTS: dict[str, tuple[type[PPO], dict[str, Any]]] = {
    "PPO": (PPO, {}),
    "C-CHAIN, β = 1e3": (CChainPPO, {"target_churn_ratio": 1e3}),
    "C-CHAIN, β = 1e4": (CChainPPO, {"target_churn_ratio": 1e4}),
}
COLORS = {"PPO": "tab:gray", "C-CHAIN, β = 1e3": "tab:cyan", "C-CHAIN, β = 1e4": "tab:blue"}


class Run(NamedTuple):
    """
    One training.

    :param env_id: Environment id
    :param variant: Key of ``VARIANTS``
    :param seed: Seed
    :param n_steps: Environment steps
    :param eval_freq: Environment steps between two evaluations
    :param folder: Where its evaluations go, and its checkpoints until it is done
    """

    env_id: str
    variant: str
    seed: int
    n_steps: int
    eval_freq: int
    folder: Path

    @property
    def name(self) -> str:
        """Name of its files."""
        plain = self.variant.replace(", β = ", "_").replace("-", "").lower()
        return f"{plain}_seed_{self.seed}"

    @property
    def result(self) -> Path:
        """Its evaluations."""
        return self.folder / f"{self.name}.csv"

    @property
    def checkpoints(self) -> Path:
        """Its checkpoints, until it is done."""
        return self.folder / f".{self.name}"


def train(run: Run) -> Run:
    """
    Train to the end, from the last checkpoint if there is one, and write down the evaluations.

    :param run: The run
    :return: It
    """
    th.set_num_threads(1)
    algorithm, arguments = VARIANTS[run.variant]
    evaluation = EvalCallback(
        make_vec_env(run.env_id, seed=1000 + run.seed),
        n_eval_episodes=10,
        eval_freq=run.eval_freq,
        log_path=str(run.checkpoints / "evaluations"),
        verbose=0,
    )
    callbacks = [evaluation, TrainingCheckpoint(50_000, run.checkpoints, keep=1)]
    model: BaseAlgorithm
    if has_checkpoint(run.checkpoints):
        model = resume(run.checkpoints, make_vec_env(run.env_id), callbacks, device="cpu")
    else:
        model = algorithm("MlpPolicy", make_vec_env(run.env_id), seed=run.seed, device="cpu", **arguments)
        model.learn(run.n_steps, callbacks)
    _write(run, evaluation)
    return run


def _write(run: Run, evaluation: EvalCallback) -> None:
    with write_safely(run.result) as path, open(path, "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["timesteps", "mean_return"])
        returns = np.mean(evaluation.evaluations_results, axis=1)
        writer.writerows(zip(evaluation.evaluations_timesteps, returns.tolist(), strict=True))


def read(run: Run) -> np.ndarray:
    """
    :param run: A run that is done
    :return: Its evaluations: environment steps and mean return, ``(n_evaluations, 2)``
    """
    return np.loadtxt(run.result, delimiter=",", skiprows=1, ndmin=2)


def falls(evaluations: np.ndarray, solved: float, worst: float) -> tuple[float, float, float] | None:
    """
    :param evaluations: As returned by :func:`read`
    :param solved: Mean return that counts as solved
    :param worst: Return of an agent that can do nothing
    :return: Step of the first evaluation that solved it, the lowest mean return after it, and the share of the evaluations
        after it below half of the way from ``worst`` to ``solved``; None if it was never solved
    """
    first = np.flatnonzero(evaluations[:, 1] >= solved)
    if len(first) == 0:
        return None
    after = evaluations[first[0] :, 1]
    return float(evaluations[first[0], 0]), float(after.min()), float((after < (solved + worst) / 2).mean())


def table_of(runs: Sequence[Run], solved: float, worst: float) -> str:
    """
    :param runs: Runs that are done
    :param solved: See :func:`falls`
    :param worst: See :func:`falls`
    :return: A table with a row per run
    """
    rows = []
    for run in sorted(runs, key=lambda run: (list(VARIANTS).index(run.variant), run.seed)):
        evaluations, fall = read(run), falls(read(run), solved, worst)
        never = ["never", "", ""]
        words = never if fall is None else [f"{fall[0]:.0f}", f"{fall[1]:.0f}", f"{fall[2]:.0%}"]
        rows.append([run.variant, str(run.seed), *words, f"{evaluations[-1, 1]:.0f}", f"{evaluations[:, 1].mean():.0f}"])
    header = ["", "seed", "solved at step", "lowest after it", "below half after it", "at the end", "mean"]
    return markdown_table(header, rows)


def plot(runs: Sequence[Run], solved: float, path: Path) -> None:
    """
    Draw the curve of each run, a panel for each variant.

    :param runs: Runs that are done
    :param solved: Mean return that counts as solved
    :param path: PNG file
    """
    variants = [variant for variant in VARIANTS if any(run.variant == variant for run in runs)]
    figure = import_matplotlib().figure.Figure(figsize=(4 * len(variants), 3))
    panels = figure.subplots(1, len(variants), sharey=True, squeeze=False)
    for variant, panel in zip(variants, panels[0], strict=True):
        for run in runs:
            if run.variant == variant:
                panel.plot(*read(run).T, color=COLORS[variant], alpha=0.7, linewidth=1)
        panel.axhline(solved, color="black", linewidth=0.5, linestyle=":")
        panel.set(title=variant, xlabel="environment steps")
    panels[0, 0].set_ylabel("mean return of 10 episodes")
    figure.suptitle(f"{runs[0].env_id}: each line is a seed")
    figure.tight_layout()
    figure.savefig(path, dpi=150)


def main(arguments: Sequence[str] | None = None) -> None:
    """
    :param arguments: Arguments of the command line
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="CartPole-v1", help="Environment id")
    parser.add_argument("--solved", type=float, default=475.0, help="Mean return that counts as solved")
    parser.add_argument("--worst", type=float, default=0.0, help="Return of an agent that can do nothing")
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=list(VARIANTS), help="What is compared")
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(5)), help="Seeds")
    parser.add_argument("--steps", type=int, default=1_000_000, help="Environment steps of a run")
    parser.add_argument("--eval-freq", type=int, default=10_000, help="Environment steps between two evaluations")
    parser.add_argument("--jobs", type=int, default=2, help="Runs at a time")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results"), help="Folder of all results")
    args = parser.parse_args(arguments)
    folder = args.output / f"collapse_{args.steps}" / args.env
    runs = [
        Run(args.env, variant, seed, args.steps, args.eval_freq, folder) for seed in args.seeds for variant in args.variants
    ]
    folder.mkdir(parents=True, exist_ok=True)
    waiting = [run for run in runs if not run.result.exists()]
    with ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
        for done in as_completed([pool.submit(train, run) for run in waiting]):
            run = done.result()
            shutil.rmtree(run.checkpoints)
            print(f"{run.variant}, seed {run.seed}: done", flush=True)
    table = table_of(runs, args.solved, args.worst)
    (folder / "table.md").write_text(table + "\n")
    plot(runs, args.solved, folder / "curves.png")
    print(f"{table}\n\nWritten: {folder}/table.md, {folder}/curves.png")


if __name__ == "__main__":
    main()
