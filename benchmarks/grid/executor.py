"""Brings runs to their end, with the processes of this machine or with Ray, so that they survive what dies meanwhile."""

import os
import signal
import subprocess
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from rich.console import Console

from benchmarks.grid.attempts import remove_checkpoints
from benchmarks.grid.plan import Rates
from benchmarks.grid.results import Result, find_result, read_results, write_result
from benchmarks.grid.run import ROOT, Run
from benchmarks.grid.training import SECONDS_TO_STOP, WAITING, Finished, Training, TrainingFailed
from benchmarks.grid.view import Failure, Progress, View

# How often a run that dies, by itself or with its machine, is started again
RETRIES = 2


SelfBackend = TypeVar("SelfBackend", bound="Backend")


class Backend(ABC):
    """Where runs are executed. A context manager: at its end nothing of it is left running."""

    def __enter__(self: SelfBackend) -> SelfBackend:
        return self

    @abstractmethod
    def __exit__(self, *error: object) -> None: ...

    @abstractmethod
    def slots(self) -> int:
        """
        :return: How many runs it can execute at a time now; at least one, which waits if need be
        """

    @abstractmethod
    def start(self, run: Run, logs: Path) -> None:
        """
        :param run: Run to start
        :param logs: Folder of all logs, on the machine that the run is on
        """

    @abstractmethod
    def wait(self, seconds: float) -> list[tuple[Run, Finished | Failure]]:
        """
        :param seconds: How long to wait at most, roughly
        :return: Runs that have ended, and how
        """

    def progress(self) -> dict[Run, Progress]:
        """
        :return: How far each running run is, where that is known here
        """
        return {}

    def seconds_before(self) -> dict[Run, float]:
        """
        :return: Seconds that running runs were trained for in earlier attempts, where that is known here
        """
        return {}

    def forget(self, run: Run, logs: Path) -> None:
        """
        Remove the checkpoints of a run that has a result.

        :param run: The run
        :param logs: Folder of all logs, on the machine that the run was on
        """
        remove_checkpoints(run, logs)


def complete(
    runs: Sequence[Run],
    results: Path,
    logs: Path,
    backend: Backend,
    console: Console | None = None,
    retries: int = RETRIES,
) -> list[Failure]:
    """
    Bring all runs to their end. Those that have a result are left as they are, and those that have a checkpoint go on from it,
    so the same call goes on after an interruption. Results are written here, whole and one by one, so machines need share no
    files; where they share the logs, a run goes on from its checkpoint on another machine, too.

    :param runs: The runs, in the order in which they are to run
    :param results: Folder of all results
    :param logs: Folder of all logs
    :param backend: Where they are executed
    :param console: Where the progress is shown
    :param retries: How often a run that failed is started again
    :return: The runs that failed at each attempt
    """
    runs = list(dict.fromkeys(runs))
    waiting = [run for run in runs if find_result(run, results) is None]
    view = View(waiting, len(runs) - len(waiting), Rates(read_results(results)[0]), console or Console())
    n_failures: Counter[Run] = Counter()
    with view.live:
        while view.waiting or view.running:
            view.slots = backend.slots()
            # No more than can run at once, so that it is seen when another process finishes a run meanwhile
            while view.waiting and len(view.running) < view.slots:
                run = view.waiting[0]
                if find_result(run, results) is not None:
                    view.skip(run)
                    continue
                backend.start(run, logs)
                view.start(run)
            for run, outcome in backend.wait(1.0):
                if isinstance(outcome, Failure):
                    n_failures[run] += 1
                    view.fail(outcome, again=n_failures[run] <= retries)
                else:
                    write_result(replace(outcome.result, path=run.path_in(results)), outcome.returns, outcome.metrics)
                    view.finish(run, outcome.result.seconds)
                    backend.forget(run, logs)
            view.progress, view.seconds_before = backend.progress(), backend.seconds_before()
    return view.failures


def train_all(
    runs: Sequence[Run], output: Path, n_jobs: int = 2, logs: Path | None = None, gpus_per_run: float = 0.0
) -> list[Result]:
    """
    Bring all runs of a command to their end on this machine, each tried once, and leave the process when runs failed, on
    Ctrl-C, and when the machine lacks the GPUs that they need.

    :param runs: The runs
    :param output: Folder of the results
    :param n_jobs: Runs at a time
    :param logs: Folder of the logs, by default ``training`` in that of the results
    :param gpus_per_run: As of :class:`LocalBackend`
    :return: Their results
    """
    try:
        backend = LocalBackend(n_jobs, gpus_per_run)
    except ValueError as error:
        sys.exit(str(error))
    try:
        with ended_by_sigterm(), backend:
            failures = complete(runs, output, logs or output / "training", backend, retries=0)
    except KeyboardInterrupt:
        sys.exit("Interrupted. The same command goes on.")
    if failures:
        sys.exit("\n".join(map(str, failures)))
    return [result for run in dict.fromkeys(runs) if (result := find_result(run, output))]


@contextmanager
def ended_by_sigterm() -> Iterator[None]:
    """End the block by ``SystemExit`` on SIGTERM, so that trainings are told to save themselves, as on Ctrl-C."""

    def leave(number: int, frame: object) -> None:
        sys.exit(128 + number)

    if threading.current_thread() is not threading.main_thread():  # Python allows it nowhere else
        yield
        return
    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def stop_all(trainings: Sequence[Training]) -> None:
    """
    Have trainings save themselves and end. Those that take too long are killed, and all of them when this is interrupted.

    :param trainings: Trainings
    """
    try:
        for training in trainings:
            training.stop()
        end = time.monotonic() + SECONDS_TO_STOP
        while any(training.is_running() for training in trainings) and time.monotonic() < end:
            time.sleep(0.1)
    finally:
        for training in trainings:
            training.kill()


class LocalBackend(Backend):
    """
    Processes of this machine, children of this process that do not outlive it. When it is left early, they are given time to
    save themselves.

    :param n_jobs: Runs at a time, None for one per core
    :param gpus_per_run: GPUs of a run, e.g. 0.25; runs that have one train on it
    :param program: The training command before its arguments, by default ``sb3-cchain``
    :raises ValueError: For less than one run at a time, or fewer GPUs than a run needs
    """

    def __init__(self, n_jobs: int | None = None, gpus_per_run: float = 0.0, program: Sequence[str] | None = None):
        if n_jobs is not None and n_jobs < 1:
            raise ValueError(f"`n_jobs` must be at least 1; got {n_jobs}")
        n_jobs = n_jobs or (len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
        gpus = _visible_gpus() if gpus_per_run > 0 else []
        if len(gpus) < gpus_per_run:
            raise ValueError(f"--gpus-per-run must be at most the GPUs of this machine, {len(gpus)}; got {gpus_per_run}")
        self.program = program
        self._free = gpu_places(gpus, gpus_per_run)[:n_jobs] if gpus_per_run > 0 else [""] * n_jobs
        self._n_slots = len(self._free)
        self._git_commit = checkout_commit()
        self._running: dict[Run, tuple[Training, str]] = {}
        self._not_started: list[tuple[Run, Failure]] = []

    def __exit__(self, *error: object) -> None:
        if self._running:
            print(WAITING, flush=True)
        stop_all([training for training, _ in self._running.values()])

    def slots(self) -> int:
        """See :class:`Backend`."""
        return self._n_slots

    def start(self, run: Run, logs: Path) -> None:
        """See :class:`Backend`."""
        gpu = self._free[-1]
        device, environment = ("cuda", {"CUDA_VISIBLE_DEVICES": gpu}) if gpu else ("cpu", {})
        try:
            training = Training(run, logs, device, self._git_commit, self.program, environment)
        except OSError as error:
            self._not_started.append((run, Failure(run, f"could not be started: {error}", str(run.path_in(logs)))))
        else:
            self._running[run] = training, self._free.pop()

    def wait(self, seconds: float) -> list[tuple[Run, Finished | Failure]]:
        """See :class:`Backend`."""
        ended: list[tuple[Run, Finished | Failure]] = [*self._not_started]
        self._not_started.clear()
        end = time.monotonic() + seconds
        while not ended and time.monotonic() < end:
            time.sleep(0.1)
            for run, (training, gpu) in list(self._running.items()):
                if training.is_running():
                    continue
                del self._running[run]
                self._free.append(gpu)
                try:
                    ended.append((run, training.finish()))
                except TrainingFailed as error:
                    ended.append((run, Failure(run, *error.args)))
        return ended

    def progress(self) -> dict[Run, Progress]:
        """See :class:`Backend`."""
        found = {run: training.progress() for run, (training, _) in self._running.items()}
        return {run: progress for run, progress in found.items() if progress is not None}

    def seconds_before(self) -> dict[Run, float]:
        """See :class:`Backend`."""
        return {run: training.seconds_before for run, (training, _) in self._running.items()}


def _visible_gpus() -> list[str]:
    """The GPUs that this process may use, as ``CUDA_VISIBLE_DEVICES`` names them."""
    import torch as th

    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    return named.split(",") if named else [str(i) for i in range(th.cuda.device_count())]


def gpu_places(gpus: Sequence[str], gpus_per_run: float) -> list[str]:
    """
    :param gpus: Names of the GPUs
    :param gpus_per_run: GPUs of a run
    :return: The GPUs of each run that has a place on them, as ``CUDA_VISIBLE_DEVICES`` names them
    """
    if gpus_per_run > 1:
        n = int(gpus_per_run)
        return [",".join(gpus[i : i + n]) for i in range(0, len(gpus) - n + 1, n)]
    return [gpu for _ in range(int(1 / gpus_per_run + 1e-9)) for gpu in gpus]


def checkout_commit() -> str | None:
    """
    :return: The checkout's git commit, with ``-dirty`` after it where files differ from it; None outside a checkout
    """
    command = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, check=True, text=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
