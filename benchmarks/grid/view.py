"""The live view of runs that are being executed."""

import math
import platform
import time
from collections.abc import Sequence
from typing import NamedTuple

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.markup import escape
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from benchmarks.grid.plan import Rates
from benchmarks.grid.run import Run


class Failure(NamedTuple):
    """
    Why a run failed.

    :param run: The run
    :param reason: In one line
    :param log: Path of its log, or of the folder of its logs
    :param node: Name of the machine that the log is on, None where that is not known
    """

    run: Run
    reason: str
    log: str
    node: str | None = None

    def __str__(self) -> str:
        where = "" if self.node in (None, platform.node()) else f"{self.node}:"
        return f"{self.run.name} failed: {self.reason}; see {where}{self.log}"


class Progress(NamedTuple):
    """
    How far a running run is.

    :param share: Share of its steps that are done
    :param words: In a few words, with the task and the last return
    """

    share: float
    words: str


def duration(seconds: float) -> str:
    """
    :param seconds: A duration
    :return: Human-readable, in about two digits
    """
    if seconds < 60:
        return f"{math.ceil(seconds)} s"
    if seconds < 90 * 60:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h" if seconds < 72 * 3600 else f"{seconds / 86400:.0f} days"


class View:
    """
    Which runs are done, running, waiting and failed, and how long the rest will take. Each end and failure of a run is printed
    on a line of its own, also into a log file; the view itself is for a terminal.

    :param waiting: The runs that are not done, in their order
    :param n_done: Number of runs that are done already
    :param rates: What is known about their speed
    :param console: Where the view is shown
    """

    def __init__(self, waiting: Sequence[Run], n_done: int, rates: Rates, console: Console):
        self.waiting = list(waiting)
        self.running: dict[Run, float] = {}
        self.failures: list[Failure] = []
        self.n_before, self.n_done = n_done, n_done
        self.slots = 1
        self.progress: dict[Run, Progress] = {}
        # Seconds that running runs were trained for in earlier attempts
        self.seconds_before: dict[Run, float] = {}
        self._rates = rates
        # Seconds of the runs that have finished here: estimated, and real
        self._estimated, self._real = 0.0, 0.0
        self.console = console
        self.live = Live(console=console, get_renderable=self.render, refresh_per_second=1, transient=True)

    def start(self, run: Run) -> None:
        """
        :param run: Run that was started
        """
        self.waiting.remove(run)
        self.running[run] = time.monotonic()

    def skip(self, run: Run) -> None:
        """
        :param run: Run that another process has done
        """
        self.waiting.remove(run)
        self.n_done += 1

    def finish(self, run: Run, seconds: float) -> None:
        """
        :param run: Run that has finished
        :param seconds: Seconds that it took
        """
        del self.running[run]
        self.n_done += 1
        self._estimated += self._rates.seconds(run)
        self._real += seconds
        total = self.n_done + len(self.running) + len(self.waiting) + len(self.failures)
        left = f", {duration(self.time_left())} left" if self.running or self.waiting else ""
        self.console.print(
            f"{self.n_done} of {total}: {run.name} done in {duration(seconds)}{left}", soft_wrap=True, highlight=False
        )

    def fail(self, failure: Failure, again: bool) -> None:
        """
        :param failure: Failure of a run
        :param again: Whether the run is tried again
        """
        del self.running[failure.run]
        if again:
            self.waiting.insert(0, failure.run)
        else:
            self.failures.append(failure)
        words = f"{failure}{' (tried again)' if again else ''}"
        self.console.print(f"[red]{escape(words)}[/red]", soft_wrap=True, highlight=False)

    def _seconds(self, run: Run) -> float:
        """How long a running run has been trained, earlier attempts included."""
        started = self.running.get(run, math.inf)  # it may have ended meanwhile
        return max(time.monotonic() - started, 0.0) + self.seconds_before.get(run, 0.0)

    def time_left(self) -> float:
        """
        :return: Seconds: the estimate of the rest, corrected by how long the runs that finished here really took, and divided
            by the number of runs at a time
        """
        # Copies, because the view is drawn by a thread of its own
        running = [self._seconds_left(run) for run in list(self.running)]
        waiting = [self._factor * self._rates.seconds(run) for run in list(self.waiting)]
        # No shorter than the longest of those running
        return max((sum(running) + sum(waiting)) / self.slots, max(running, default=0.0))

    @property
    def _factor(self) -> float:
        return self._real / self._estimated if self._estimated else 1.0

    def _seconds_left(self, run: Run) -> float:
        """Of a running run, by the share that is done, and where that is not known by the rates."""
        seconds, progress = self._seconds(run), self.progress.get(run)
        if progress is not None:
            return seconds * max(1 / progress.share - 1, 0.0)
        return max(self._factor * self._rates.seconds(run) - seconds, 0.0)

    def render(self) -> RenderableType:
        """
        :return: The view now
        """
        total = self.n_done + len(self.running) + len(self.waiting) + len(self.failures)
        counts = Text.assemble(
            f"{self.n_done} done ({self.n_before} before), {len(self.running)} running, {len(self.waiting)} waiting, ",
            (f"{len(self.failures)} failed", "red" if self.failures else ""),
            f", {duration(self.time_left())} left",
        )
        running = Table.grid(padding=(0, 2))
        for run in list(self.running)[:20]:
            progress, left = self.progress.get(run), f"{duration(self._seconds_left(run))} left"
            words = "" if progress is None else progress.words
            running.add_row("", run.name, duration(self._seconds(run)), words, left)
        if len(self.running) > 20:
            running.add_row("", f"and {len(self.running) - 20} more")
        failures = [Text(str(failure), style="red") for failure in self.failures[-5:]]
        head = Table.grid(padding=(0, 1))
        head.add_row(ProgressBar(total=max(total, 1), completed=self.n_done, width=20), counts)
        return Group(head, running, *failures)
