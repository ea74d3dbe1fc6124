"""One attempt at a run: a training process, and what is read from its logs."""

import math
import os
import platform
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.grid.attempts import Attempt, new_attempt
from benchmarks.grid.results import METRIC_PREFIXES, Result
from benchmarks.grid.run import Run, as_json, shipped_hyperparameters
from benchmarks.grid.suites import SUITES, task_names
from benchmarks.grid.view import Progress
from sb3_cchain.analysis.eval_trained_task import EVALUATION, EVALUATIONS_CSV
from sb3_cchain.callbacks import read_returns
from sb3_cchain.callbacks.continual_metrics import RETURNS_CSV

# How long a training that is told to stop may take to save itself: it first completes its rollout
SECONDS_TO_STOP = 60.0
WAITING = f"Waiting for runs to save themselves, up to {SECONDS_TO_STOP:.0f} s. Ctrl-C again ends them at once"


class TrainingFailed(RuntimeError):
    """
    A training process ended with an error.

    :param reason: In one line
    :param log: Path of its log
    :param node: Name of the machine
    """

    def __init__(self, reason: str, log: str, node: str):
        super().__init__(reason, log, node)


class Finished(NamedTuple):
    """What is kept of a run: the arguments of :func:`benchmarks.grid.results.write_result`."""

    result: Result
    returns: list[dict[str, Any]]
    metrics: list[dict[str, Any]]


class Training:
    """
    Starts a run in a process of its own, with one thread.

    Each attempt has a folder of its own, so two attempts never write to the same one, whatever is left of the first: Ray
    starts a task again when it has lost sight of a machine, which may still be alive. On Linux a process whose parent died
    dies too (``child.py``); that frees its core for the next attempt, but correctness does not depend on it.

    An attempt goes on from the newest checkpoint of the attempts before, as if they had not been interrupted.

    :param run: The run
    :param logs: Folder of all logs
    :param device: PyTorch device
    :param git_commit: Commit to record
    :param program: The command before its arguments, by default ``sb3-cchain`` of this Python
    :param environment: Environment variables to add
    """

    def __init__(
        self,
        run: Run,
        logs: Path,
        device: str = "cpu",
        git_commit: str | None = None,
        program: Sequence[str] | None = None,
        environment: dict[str, str] | None = None,
    ):
        self.run = run
        self._device = device
        self._clock = time.monotonic()
        self._memory: int | None = None
        self.attempt, checkpoint = new_attempt(run, logs, git_commit)
        self.folder = self.attempt.folder
        self.log = self.folder / "log.txt"
        arguments = [*run.arguments(self.folder, device), "--checkpoint-freq", str(SUITES[run.suite].checkpoint_freq)]
        if checkpoint is not None:
            arguments += ["--resume", str(checkpoint)]
        with open(self.log, "w") as log:
            log.write(f"sb3-cchain {shlex.join(arguments)}\n")
            log.flush()
            # As many threads as --num-threads, for the libraries that read the environment too
            variables = {**os.environ, "OMP_NUM_THREADS": "1", **(environment or {})}
            child = [sys.executable, str(Path(__file__).with_name("child.py")), str(os.getpid())]
            program = program or (sys.executable, "-m", "sb3_cchain.zoo")
            # In a session of its own, so that Ctrl-C does not reach it: the parent tells it to stop, once
            self._process = subprocess.Popen(
                [*child, *program, *arguments],
                stdout=log,
                stderr=subprocess.STDOUT,
                env=variables,
                start_new_session=True,
            )

    def is_running(self) -> bool:
        """
        :return: Whether the process is running. To be asked often: it also takes note of the memory
        """
        self._memory = _peak_memory(self._process.pid) or self._memory
        return self._process.poll() is None

    def progress(self) -> Progress | None:
        """
        :return: How far training is; None before the first return
        """
        try:
            last = self._training_returns()[-1]
        except (IndexError, ValueError, TypeError, OSError):
            return None  # nothing there yet, or the line is being written
        share, origin = last["timesteps"] / self.run.total_steps, self.attempt.origin
        words = f"{share:.0%}, task {last['task_id']}, return {last['mean_return']:.4g}"
        return Progress(share, words if origin is None else f"{words}, from {origin.num_timesteps / self.run.total_steps:.0%}")

    @property
    def seconds_before(self) -> float:
        """Seconds that earlier attempts trained up to the checkpoint that this one goes on from."""
        return 0.0 if self.attempt.origin is None else self.attempt.origin.seconds

    def stop(self) -> None:
        """Tell the process to save its training and to end, without waiting for it."""
        self._process.terminate()

    def kill(self) -> None:
        """End the process, if it has not ended yet."""
        self._process.kill()
        self._process.wait()

    def finish(self) -> Finished:
        """
        :return: The result of a process that has ended, not written yet, and its rows
        :raises TrainingFailed: When the process failed
        """
        run, seconds = self.run, time.monotonic() - self._clock + self.seconds_before
        if self._process.returncode != 0:
            if self._process.returncode > 0 and not self._has_trained():
                self.attempt.mark_broken()
            reason = _failure_reason(self.log, self._process.returncode)
            raise TrainingFailed(reason, str(self.log), platform.node())
        try:
            chain = self.attempt.chain()
        except ValueError as error:  # its logs were removed meanwhile
            raise TrainingFailed(str(error), str(self.log), platform.node()) from error
        # In the command the folder that a user would choose, not the attempt's
        command = ["sb3-cchain", *run.arguments(run.path_in(Path("logs/grid")), self._device)]
        result = Result(
            **vars(run),
            path=Path(),
            task_names=list(task_names(run.suite, run.env_id, run.n_tasks)),
            hyperparameters=as_json(shipped_hyperparameters(run.algo, run.env_id)),
            command=command,
            versions={name: _joined(attempt.versions.get(name) for attempt in chain) or "" for name in chain[-1].versions},
            git_commit=_joined(attempt.git_commit for attempt in chain),
            started=chain[0].started,
            finished=datetime.now(timezone.utc).isoformat(timespec="seconds"),
            seconds=max(round(seconds, 1), 0.1),  # by which rates are divided
            peak_memory=self._memory,
        )
        suite, evaluations = SUITES[run.suite], self._rows(EVALUATIONS_CSV)
        if suite.evaluates:
            return Finished(result, evaluations, metrics_rows(chain))
        # Evaluations are in the log at the end of the next rollout, which may be in the next task
        logged = [suite.score.metric] if suite.score and suite.score.metric != EVALUATION else []
        metrics = [*metrics_rows(chain, logged), *evaluation_metrics(evaluations, run)]
        return Finished(result, self._training_returns(), metrics)

    def _has_trained(self) -> bool:
        """Whether there is more than what the checkpoint held that it went on from."""
        try:
            returns = self._training_returns()
        except ValueError:
            return True
        before = 0 if self.attempt.origin is None else self.attempt.origin.num_timesteps
        return any(row["timesteps"] > before for row in returns)

    def _training_returns(self) -> list[dict[str, float]]:
        """Rows of ``returns.csv`` so far."""
        return self._rows(RETURNS_CSV)

    def _rows(self, name: str) -> list[dict[str, float]]:
        files = list(self.folder.glob(f"tensorboard/*/*/{name}"))
        return read_returns(files[0]) if files else []


def evaluation_metrics(evaluations: Iterable[Mapping[str, float]], run: Run) -> list[dict[str, Any]]:
    """
    :param evaluations: Rows of ``evaluations.csv``
    :param run: The run
    :return: Rows of ``metrics.csv``. An evaluation after the last rollout of a task has the step that ended the task
    """
    ends = run.task_boundaries
    return [
        {
            "timesteps": min(int(row["timesteps"]), ends[int(row["task_id"])]),
            "name": EVALUATION,
            "value": f"{row['mean_return']:.6g}",
        }
        for row in evaluations
    ]


def metrics_rows(chain: Sequence[Attempt], further: Sequence[str] = ()) -> list[dict[str, Any]]:
    """
    :param chain: Attempts, each of which goes on from a checkpoint of the one before
    :param further: Names of scalars that are kept besides those that begin with one of ``METRIC_PREFIXES``
    :return: Rows of ``metrics.csv``: what they logged to TensorBoard, to six digits. What an attempt logged after the
        checkpoint that the next one goes on from is left out, because it comes again
    """
    beginnings = (*METRIC_PREFIXES, *further)
    # By name, and by environment steps
    values: dict[str, dict[int, list[str]]] = {}
    for attempt, following in zip(chain, [*chain[1:], None], strict=True):
        last = math.inf if following is None or following.origin is None else following.origin.num_timesteps
        logged: dict[str, dict[int, list[str]]] = {}
        for name, step, value in _logged_scalars(attempt):
            if name.startswith(beginnings) and step <= last:
                logged.setdefault(name, {}).setdefault(step, []).append(f"{value:.6g}")
        for name, by_step in logged.items():
            values.setdefault(name, {}).update(by_step)
    return [
        {"timesteps": step, "name": name, "value": value}
        for name, by_step in values.items()
        for step, logged_values in by_step.items()
        for value in logged_values
    ]


def _logged_scalars(attempt: Attempt) -> Iterator[tuple[str, int, float]]:
    """Name, environment steps and value of all that an attempt logged to TensorBoard."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    for folder in sorted({file.parent for file in attempt.folder.glob("tensorboard/*/*/events.out.tfevents.*")}):
        logged = EventAccumulator(str(folder), size_guidance={"scalars": 0, "images": 1})
        logged.Reload()
        for name in logged.Tags()["scalars"]:
            yield from ((name, event.step, event.value) for event in logged.Scalars(name))


def _joined(texts: Iterable[str | None]) -> str | None:
    """Each text once: what attempts have in common, or in what they differ."""
    return ", ".join(dict.fromkeys(text for text in texts if text is not None)) or None


def _peak_memory(pid: int) -> int | None:
    """Bytes that a running process has had resident at most, where Linux tells."""
    try:
        found = re.search(r"VmHWM:\s*(\d+) kB", Path(f"/proc/{pid}/status").read_text())
    except OSError:
        return None
    return 1024 * int(found[1]) if found else None


def _failure_reason(log: Path, returncode: int) -> str:
    """Why a process ended, in one line: the signal, or the last line of its log."""
    if returncode < 0:
        return f"killed by {signal.Signals(-returncode).name}"
    return [line for line in log.read_text(errors="replace").splitlines() if line.strip()][-1].strip()[:200]
