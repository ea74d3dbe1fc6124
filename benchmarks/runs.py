"""Training runs as processes: each is the command that a user would type, and is never repeated once it is done."""

import json
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_cchain.callbacks import read_returns
from sb3_cchain.callbacks.continual_metrics import RETURNS_CSV
from sb3_cchain.zoo.cli import hyperparams_folder

DONE = "done.json"
# Whose versions determine a run
PACKAGES = ("sb3-cchain", "stable-baselines3", "gymnasium", "torch")


@dataclass(frozen=True)
class Run:
    """
    One training run under the shipped hyperparameters.

    :param algo: Name of the algorithm on the command line
    :param env_id: Environment id
    :param seed: Seed of the agent
    :param n_tasks: Length of the task sequence
    :param steps_per_task: Environment steps per task
    :param folder: Where the run's files go
    :param env_kwargs: Further arguments of the environment, as on the command line
    :param eval_freq: Environment steps between two evaluations (ten greedy episodes of the task being trained), or -1
    :param hyperparams: What differs from the shipped hyperparameters, as on the command line
    :param device: PyTorch device
    """

    algo: str
    env_id: str
    seed: int
    n_tasks: int
    steps_per_task: int
    folder: Path
    env_kwargs: tuple[str, ...] = ()
    eval_freq: int = -1
    hyperparams: tuple[str, ...] = ()
    device: str = "cpu"

    @property
    def total_steps(self) -> int:
        """Environment steps of the whole run."""
        return self.n_tasks * self.steps_per_task

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.env_id.removeprefix('Continual/')} {self.algo} seed {self.seed}"

    @property
    def arguments(self) -> list[str]:
        """The command after ``sb3-cchain``."""
        return [
            *("train", "--algo", self.algo, "--env", self.env_id, "--seed", str(self.seed)),
            *("--n-timesteps", str(self.total_steps), "--num-threads", "1", "--device", self.device),
            *("--eval-freq", str(self.eval_freq), "--eval-episodes", "10"),
            *("--log-folder", str(self.folder), "--tensorboard-log", str(self.folder / "tensorboard"), "--verbose", "0"),
            *("--env-kwargs", f"steps_per_task:{self.steps_per_task}", *self.env_kwargs),
            *(("--hyperparams", *self.hyperparams) if self.hyperparams else ()),
        ]

    @property
    def is_done(self) -> bool:
        """Whether the run came to its end, with the present settings."""
        path = self.folder / DONE
        return path.exists() and json.loads(path.read_text())["settings"] == self.settings

    @property
    def settings(self) -> dict[str, Any]:
        """What determines the run: its hyperparameters and versions."""
        arguments = [self.env_id, self.seed, self.n_tasks, self.steps_per_task, self.eval_freq]
        return {
            "arguments": [*arguments, *self.env_kwargs, *self.hyperparams],
            "hyperparameters": shipped_hyperparameters(self.algo, self.env_id),
            "versions": {name: version(name) for name in PACKAGES},
        }

    def start(self) -> subprocess.Popen:
        """
        :return: The running process, whose output goes to ``log.txt``. It does not outlive this one (on Linux)
        """
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        with open(self.folder / "log.txt", "w") as log:
            log.write(f"sb3-cchain {shlex.join(self.arguments)}\n")
            log.flush()
            # As many threads as --num-threads for the libraries that read the environment, too
            environment = {**os.environ, "OMP_NUM_THREADS": "1"}
            command = [sys.executable, "-m", "benchmarks.child", str(os.getpid()), *self.arguments]
            return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment)

    @property
    def cost(self) -> tuple[float, float]:
        """Environment steps per second, start included, and peak memory in GB (NaN where the system does not tell it)."""
        done = json.loads((self.folder / DONE).read_text())
        return self.total_steps / done["seconds"], (done.get("peak_memory") or math.nan) / 1e9

    def returns(self) -> list[dict[str, float]]:
        """
        :return: Rows of the run's CSV file so far
        """
        files = list(self.folder.glob(f"tensorboard/*/*/{RETURNS_CSV}"))
        return read_returns(files[0]) if files else []

    def evaluations(self) -> list[dict[str, float]]:
        """
        :return: For each evaluation so far, environment steps, task, number of episodes and mean return
        """
        files = list(self.folder.glob("*/*/evaluations.npz"))
        if not files:
            return []
        logged = np.load(files[0])
        return [
            # The step that ends a task is still of that task
            {
                "timesteps": int(steps),
                "task_id": (int(steps) - 1) // self.steps_per_task,
                "n_episodes": len(returns),
                "mean_return": float(np.mean(returns)),
            }
            for steps, returns in zip(logged["timesteps"], logged["results"], strict=True)
        ]

    def scalars(self, prefixes: tuple[str, ...]) -> list[dict[str, Any]]:
        """
        :param prefixes: Of scalars in TensorBoard
        :return: Environment steps, name and value of all that was logged under them so far, to six digits
        """
        rows = []
        for folder in sorted({file.parent for file in self.folder.glob("tensorboard/*/*/events.out.tfevents.*")}):
            logged = EventAccumulator(str(folder), size_guidance={"scalars": 0, "images": 1})
            logged.Reload()
            for name in logged.Tags()["scalars"]:
                if name.startswith(prefixes):
                    values = logged.Scalars(name)
                    rows += [{"timesteps": event.step, "name": name, "value": f"{event.value:.6g}"} for event in values]
        return rows


def shipped_hyperparameters(algo: str, env_id: str) -> dict[str, Any] | None:
    """
    :param algo: Name of the algorithm on the command line
    :param env_id: Environment id
    :return: What our YAML file says of it, if anything
    """
    return _settings(hyperparams_folder() / f"{algo}.yml").get(env_id)


@cache
def _settings(path: Path) -> dict[str, Any]:
    return yaml.safe_load(path.read_text())


def peak_memory(pid: int) -> int | None:
    """
    :param pid: A running process
    :return: Bytes that it has had resident at most, where Linux tells
    """
    status = Path(f"/proc/{pid}/status")
    found = re.search(r"VmHWM:\s*(\d+) kB", status.read_text()) if status.exists() else None
    return 1024 * int(found[1]) if found else None


def complete(runs: Sequence[Run], n_jobs: int = 2) -> None:
    """
    Bring all runs to their end, with a progress bar each. Runs that are done are left as they are, so that the same call
    continues after an interruption.

    :param runs: The runs
    :param n_jobs: Processes at a time, of one thread each
    :raises RuntimeError: When a run fails; it names the log
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=20),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[status]}"),
    )
    waiting = [run for run in runs if not run.is_done]
    running: dict[Run, tuple[subprocess.Popen, float]] = {}
    memory: dict[Run, int | None] = {}
    with Progress(*columns, refresh_per_second=2) as progress:
        bars = {run: progress.add_task(run.name, total=run.total_steps, start=False, status="") for run in runs}
        for run in runs:
            if run.is_done:
                progress.update(bars[run], completed=run.total_steps, status="done before")
        try:
            while waiting or running:
                while waiting and len(running) < n_jobs:
                    run = waiting.pop(0)
                    running[run] = (run.start(), time.time())
                    progress.start_task(bars[run])
                time.sleep(0.5)
                for run, (process, start) in list(running.items()):
                    if rows := run.returns():
                        status = f"task {rows[-1]['task_id']:g}, return {rows[-1]['mean_return']:.0f}"
                        progress.update(bars[run], completed=rows[-1]["timesteps"], status=status)
                    memory[run] = peak_memory(process.pid) or memory.get(run)
                    if process.poll() is None:
                        continue
                    del running[run]
                    if process.returncode != 0:
                        raise RuntimeError(f"{run.name} failed with exit code {process.returncode}, see {run.folder}/log.txt")
                    progress.update(bars[run], completed=run.total_steps)
                    done = {"seconds": round(time.time() - start), "peak_memory": memory[run], "settings": run.settings}
                    (run.folder / DONE).write_text(json.dumps(done, indent=1))
        finally:
            for process, _ in running.values():
                process.terminate()
