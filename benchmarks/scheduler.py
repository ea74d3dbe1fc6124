"""Runs of the grid on a Ray cluster, or on the cores of this machine, so that they survive what dies meanwhile."""

import os
import platform
import signal
import socket
import subprocess
import time
import uuid
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timezone
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from benchmarks.grid import GridRun, Rates
from benchmarks.grid_view import Failure, GridView
from benchmarks.results import METRIC_PREFIXES, Result, in_json, read_results, write_result
from benchmarks.runs import PACKAGES, peak_memory, shipped_hyperparameters
from benchmarks.suites import SUITES

# How often a run that dies, with its machine or by itself, is begun again. Not by Ray, whose retries nobody sees, and which
# are without end where memory ran out
RETRIES = 2

ROOT = Path(__file__).parent.parent
# Of the checkout, what no run needs
NOT_SENT = [".git", "docs", "tests", "benchmarks/results"]


class RunFailed(RuntimeError):
    """
    A training process ended with an error.

    :param reason: In one line
    :param log: Path of its log
    :param node: Name of the machine
    """

    def __init__(self, reason: str, log: str, node: str):
        super().__init__(reason, log, node)


class Finished(NamedTuple):
    """What is kept of a run: the arguments of :func:`write_result`."""

    result: Result
    returns: list[dict[str, Any]]
    metrics: list[dict[str, Any]]


def train(grid_run: GridRun, logs: Path, device: str = "cpu", git_commit: str | None = None) -> Finished:
    """
    Train in a process of its own, with one thread, to the end.

    Each attempt has a folder of its own. So two attempts never write in the same one, whatever survived of the first: Ray
    begins a task anew when it has lost sight of a machine, which need not have died. A process whose parent died dies, too, on
    Linux (``benchmarks/child.py``); that saves its core for the next attempt, but nothing rests on it.

    :param grid_run: What
    :param logs: Folder of all logs
    :param device: PyTorch device
    :param git_commit: To be written down
    :return: The result, not written yet, and its rows
    :raises RunFailed: When the process fails
    """
    started = datetime.now(timezone.utc)
    attempt = grid_run.path(logs) / f"attempt_{started:%Y%m%dT%H%M%S}_{uuid.uuid4().hex[:8]}"
    run = grid_run.run(attempt, device)
    memory = None
    clock = time.monotonic()
    process = run.start()
    try:
        while process.poll() is None:
            memory = peak_memory(process.pid) or memory
            time.sleep(0.5)
    finally:
        process.kill()
    seconds = time.monotonic() - clock
    log = attempt / "log.txt"
    if process.returncode != 0:
        raise RunFailed(_reason(log, process.returncode), str(log), platform.node())
    result = Result(
        path=Path(),
        suite=grid_run.suite,
        env_id=grid_run.env_id,
        method=grid_run.method,
        algo=grid_run.algo,
        seed=grid_run.seed,
        budget=grid_run.budget,
        n_tasks=grid_run.n_tasks,
        steps_per_task=grid_run.steps_per_task,
        task_names=list(grid_run.task_names),
        task_boundaries=[grid_run.steps_per_task * (task + 1) for task in range(grid_run.n_tasks)],
        hyperparameters=in_json(shipped_hyperparameters(grid_run.algo, grid_run.env_id)),
        # In the folder that a user would choose, not in the attempt's
        command=["sb3-cchain", *grid_run.run(grid_run.path(Path("logs/grid")), device).arguments],
        versions={**{name: version(name) for name in (*PACKAGES, "numpy")}, "python": platform.python_version()},
        git_commit=git_commit,
        started=started.isoformat(timespec="seconds"),
        finished=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        seconds=round(seconds, 1),
        steps_per_second=round(grid_run.total_steps / seconds, 1),
        peak_memory=memory,
    )
    return Finished(result, SUITES[grid_run.suite].returns(run), run.scalars(METRIC_PREFIXES))


def _reason(log: Path, returncode: int) -> str:
    """Why a process ended, in one line: the signal, or the last line of its log."""
    if returncode < 0:
        return f"killed by {signal.Signals(-returncode).name}"
    return [line for line in log.read_text().splitlines() if line.strip()][-1].strip()[:200]


def commit_of_checkout() -> str | None:
    """
    :return: Its git commit, with ``-dirty`` after it where files differ from it; None outside a checkout
    """
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, check=True, text=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def import_ray() -> Any:
    """
    :return: The module, which is imported for the grid alone: it takes a while
    :raises ImportError: When it is not installed
    """
    # No report of this use goes to Ray's authors
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError as error:
        raise ImportError(f'The grid needs Ray ({error}): pip install -e ".[cluster]"') from error
    return ray


def connect(ray: Any, address: str | None, cpus: int | None, gpus_per_run: float) -> None:
    """
    Start Ray on this machine, or join a cluster. Its nodes get this checkout, and run in a copy of it, so that all runs are of
    the same code, and a node needs its own installation for the dependencies alone.

    :param ray: The module
    :param address: Address of a cluster, None for this machine
    :param cpus: Cores to use on this machine, None for all
    :param gpus_per_run: GPUs of a run
    :raises ConnectionError: When nothing answers at the address
    :raises ValueError: When there are no GPUs, which the runs would wait for
    """
    if address is not None and ":" in address:
        # Ray itself goes on trying for minutes
        host, port = address.removeprefix("ray://").rsplit(":", 1)
        try:
            socket.create_connection((host, port), timeout=10).close()
        except OSError as error:
            raise ConnectionError(f"--address must be that of a Ray cluster; got {address}: {error}") from error
    options: dict[str, Any] = {"address": address}
    if address is None:
        # What runs leave is small. "local": whatever cluster runs on this machine otherwise, it is not joined
        options = {"address": "local", "num_cpus": cpus, "include_dashboard": False, "object_store_memory": 200_000_000}
    runtime_env = {"working_dir": str(ROOT), "excludes": NOT_SENT}
    ray.init(**options, log_to_driver=False, logging_level="ERROR", runtime_env=runtime_env)
    gpus = ray.cluster_resources().get("GPU", 0)
    if gpus < gpus_per_run:
        ray.shutdown()
        raise ValueError(f"--gpus-per-run must be at most the GPUs that Ray finds, {gpus:g}; got {gpus_per_run}")


def slots(resources: dict[str, float], gpus_per_run: float) -> int:
    """
    :param resources: Of the cluster, as Ray counts them
    :param gpus_per_run: GPUs of a run
    :return: How many runs, of one core each, it can do at a time; at least one, which waits if need be
    """
    n_runs = int(resources.get("CPU", 0))
    if gpus_per_run > 0:
        n_runs = min(n_runs, int(resources.get("GPU", 0) / gpus_per_run + 1e-9))
    return max(n_runs, 1)


def complete_grid(
    ray: Any, grid: Sequence[GridRun], results: Path, logs: Path, gpus_per_run: float = 0.0, console: Console | None = None
) -> list[Failure]:
    """
    Bring all runs to their end. Those that have a result are left as they are, so the same call goes on after an
    interruption. The results come back here and are written here, whole and one by one, so machines need share no files.

    :param ray: The module, connected
    :param grid: The runs, in the order in which they are to run
    :param results: Folder of all results
    :param logs: Folder of all logs, on the machine that a run is on
    :param gpus_per_run: GPUs of a run; those that have one train on it
    :param console: Where the progress is shown
    :return: The runs that failed, after ``RETRIES`` further attempts each
    """
    waiting = [run for run in grid if run.result(results) is None]
    view = GridView(waiting, len(grid) - len(waiting), Rates(read_results(results)), console or Console())
    task = ray.remote(train).options(num_cpus=1, num_gpus=gpus_per_run, max_retries=0, scheduling_strategy="SPREAD")
    arguments = (logs.absolute(), "cuda" if gpus_per_run > 0 else "cpu", commit_of_checkout())
    running: dict[Any, GridRun] = {}
    n_failures: Counter[GridRun] = Counter()
    with view.live:
        while view.waiting or running:
            # No more than can run, so that what another process has done meanwhile is seen
            view.slots = slots(ray.cluster_resources(), gpus_per_run)
            while view.waiting and len(running) < view.slots:
                run = view.waiting[0]
                if run.result(results) is not None:
                    view.skip(run)
                    continue
                running[task.remote(run, *arguments)] = run
                view.start(run)
            ready, _ = ray.wait(list(running), num_returns=len(running), timeout=1.0) if running else ([], [])
            for reference in ready:
                run = running.pop(reference)
                try:
                    finished = Finished(*ray.get(reference))
                except ray.exceptions.RayError as error:
                    n_failures[run] += 1
                    view.fail(_failure(run, error, logs), again=n_failures[run] <= RETRIES)
                else:
                    result = replace(finished.result, path=run.path(results))
                    write_result(result, finished.returns, finished.metrics)
                    view.finish(run, result.seconds)
    return view.failures


def _failure(run: GridRun, error: Exception, logs: Path) -> Failure:
    """What a Ray error says of a run."""
    cause = getattr(error, "cause", None) or error
    if isinstance(cause, RunFailed):
        return Failure(run, *cause.args)
    return Failure(run, f"{type(cause).__name__}: {' '.join(str(cause).split())}"[:200], str(run.path(logs)))
