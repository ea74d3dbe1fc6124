"""The nodes of a Ray cluster."""

import os
import socket
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.grid.attempts import remove_checkpoints
from benchmarks.grid.executor import Backend, checkout_commit, stop_all
from benchmarks.grid.run import ROOT, Run
from benchmarks.grid.training import SECONDS_TO_STOP, WAITING, Finished, Training, TrainingFailed
from benchmarks.grid.view import Failure

# Parts of the checkout that no run needs
NOT_SENT = [".git", "docs", "tests", "benchmarks/results"]


def import_ray() -> Any:
    """
    :return: The module
    :raises ImportError: When it is not installed
    """
    # Sends no report of this use to Ray's authors
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError as error:
        raise ImportError(f'--address needs Ray ({error}): pip install -e ".[cluster]"') from error
    return ray


class RayBackend(Backend):
    """
    Joins a Ray cluster. Its nodes get this checkout and run in a copy of it, so all runs have the same code, and a node's own
    installation matters for the dependencies alone.

    Ray itself retries nothing: its retries are not shown, and are without end when memory ran out.

    :param address: Address of the cluster
    :param gpus_per_run: GPUs of a run; runs that have one train on it
    :param program: The training command before its arguments, by default ``sb3-cchain``
    :raises ImportError: When Ray is not installed
    :raises ConnectionError: When nothing answers at the address
    :raises ValueError: When there are fewer GPUs than a run needs
    """

    def __init__(self, address: str, gpus_per_run: float = 0.0, program: Sequence[str] | None = None):
        self._ray = ray = import_ray()
        self._gpus_per_run, self.program = gpus_per_run, program
        self._git_commit = checkout_commit()
        self._running: dict[Any, Run] = {}
        self._nodes: dict[Run, str] = {}
        self._logs = Path()
        if ":" in address:
            # Ray itself would go on trying for minutes
            host, port = address.removeprefix("ray://").rsplit(":", 1)
            try:
                socket.create_connection((host, int(port)), timeout=10).close()
            except (OSError, ValueError) as error:
                raise ConnectionError(f"--address must be that of a Ray cluster; got {address}: {error}") from error
        runtime_env = {"working_dir": str(ROOT), "excludes": NOT_SENT}
        ray.init(address=address, log_to_driver=False, logging_level="ERROR", runtime_env=runtime_env)
        gpus = ray.cluster_resources().get("GPU", 0)
        if gpus < gpus_per_run:
            ray.shutdown()
            raise ValueError(f"--gpus-per-run must be at most the GPUs that Ray finds, {gpus:g}; got {gpus_per_run}")
        options = dict(num_cpus=1, num_gpus=gpus_per_run, max_retries=0, scheduling_strategy="SPREAD")
        self._task = ray.remote(_train).options(**options)

    def __exit__(self, *error: object) -> None:
        try:
            if self._running:
                print(WAITING, flush=True)
                for reference in self._running:
                    self._ray.cancel(reference)
                self._ray.wait(list(self._running), num_returns=len(self._running), timeout=SECONDS_TO_STOP + 10)
        finally:
            self._ray.shutdown()

    def slots(self) -> int:
        """See :class:`Backend`."""
        return count_slots(self._ray.cluster_resources(), self._gpus_per_run)

    def start(self, run: Run, logs: Path) -> None:
        """See :class:`Backend`."""
        self._logs = logs.absolute()
        device = "cuda" if self._gpus_per_run > 0 else "cpu"
        self._running[self._task.remote(run, self._logs, device, self._git_commit, self.program)] = run

    def wait(self, seconds: float) -> list[tuple[Run, Finished | Failure]]:
        """See :class:`Backend`."""
        if not self._running:
            return []
        ready, _ = self._ray.wait(list(self._running), num_returns=1, timeout=seconds)
        ended: list[tuple[Run, Finished | Failure]] = []
        for reference in ready:
            run = self._running.pop(reference)
            try:
                finished, self._nodes[run] = self._ray.get(reference)
                ended.append((run, Finished(*finished)))
            except self._ray.exceptions.RayError as error:
                ended.append((run, _failure(run, error, self._logs)))
        return ended

    def forget(self, run: Run, logs: Path) -> None:
        """See :class:`Backend`."""
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        # The logs are on the node that the run was on
        there = NodeAffinitySchedulingStrategy(self._nodes.pop(run), soft=False)
        task = self._ray.remote(remove_checkpoints).options(num_cpus=0, max_retries=0, scheduling_strategy=there)
        try:
            self._ray.get(task.remote(run, logs.absolute()), timeout=60)
        except self._ray.exceptions.RayError:
            pass  # the node is gone


def _train(
    run: Run, logs: Path, device: str, git_commit: str | None, program: Sequence[str] | None
) -> tuple[tuple[Any, ...], str]:
    """On a node: train to the end. Returns the result, and the node."""
    training = Training(run, logs, device, git_commit, program)
    try:
        while training.is_running():
            time.sleep(0.2)
    finally:
        stop_all([training])
    return tuple(training.finish()), import_ray().get_runtime_context().get_node_id()


def count_slots(resources: dict[str, float], gpus_per_run: float) -> int:
    """
    :param resources: Resources of the cluster, as Ray counts them
    :param gpus_per_run: GPUs of a run
    :return: How many runs, of one core each, it can execute at a time; at least one
    """
    n_runs = int(resources.get("CPU", 0))
    if gpus_per_run > 0:
        n_runs = min(n_runs, int(resources.get("GPU", 0) / gpus_per_run + 1e-9))
    return max(n_runs, 1)


def _failure(run: Run, error: Exception, logs: Path) -> Failure:
    """The failure that a Ray error stands for."""
    cause = getattr(error, "cause", None) or error
    if isinstance(cause, TrainingFailed):
        return Failure(run, *cause.args)
    return Failure(run, f"{type(cause).__name__}: {' '.join(str(cause).split())}"[:200], str(run.path_in(logs)))
