"""A progress bar that shows the tasks."""

import atexit
import threading
import time
from collections import deque
from datetime import timedelta
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cchain.callbacks.learn_call import LearnCall
from sb3_cchain.tasks.continual import is_continual
from sb3_cchain.tasks.names import task_names
from sb3_cchain.tasks.sequence import sequence_start
from sb3_cchain.tasks.signal import TaskSwitch, active_signal, displayed_task

SECONDS_BETWEEN_DRAWINGS = 0.25

# The bars in the terminal, with the learn() that each of them belongs to
_open_bars: dict["TaskProgressBar", LearnCall] = {}


class TaskProgressBar(BaseCallback):
    """
    Shows in the terminal how far training is, as ``learn(..., progress_bar=True)`` does, and which task it is in:

    .. code-block:: text

        task 1 (2 of 3) run, next in 28,400 steps (0:01:20), return 24.3
         36% ━━━━━━━━━━━━╸━━━━━━━━━━━━━━━━ 171,600/480,000 0:04:10 < 0:10:20, 780 steps/s

    Tasks are numbered from 0, as everywhere, and have their names where they have some. They are those of a
    :class:`~sb3_cchain.ContinualEnv` or of a :class:`~sb3_cchain.TaskSignal`; when the next one begins is shown where it is
    known before. The return is the mean over the last episodes of the task, 100 at most, before any scaling of the rewards
    where the environment tells it. Without tasks, the first line has the return alone.

    The time that is left follows from the steps per second so far, updates included. The bar begins at the step at which
    training begins. It is closed when ``learn()`` ends, by an error or Ctrl-C, too. Where the output is no terminal, such as
    a log file, the last state is printed once, at the end.
    """

    def __init__(self) -> None:
        super().__init__()
        self._live: Live | None = None
        self._lock = threading.RLock()
        self._closed = threading.Event()

    def __reduce__(self) -> tuple[type["TaskProgressBar"], tuple[()]]:
        # A copy, such as in a saved model, is a new bar: what is in the terminal cannot be copied
        return type(self), ()

    def state_dict(self) -> dict[str, Any]:
        """
        :return: Nothing: training that is resumed has a bar of its own
        """
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: What :meth:`state_dict` returned
        """

    def _on_training_start(self) -> None:
        self.close()
        env = self.training_env
        self._names = task_names(env)
        self._switches: list[int] = []
        self._n_tasks: int | None = None
        if is_continual(env):
            clock = env.get_attr("clock", indices=0)[0]
            self._switches, self._n_tasks = clock.switches, clock.n_tasks
        self._switch = TaskSwitch()
        self._returns: deque[float] = deque(maxlen=100)
        self._mean_return: float | None = None
        self._started = time.monotonic()
        # Environment steps and time: at the start of the first rollout, and of the present one
        self._first: tuple[int, float] | None = None
        self._present = (self.num_timesteps, self._started)
        self._open()

    def _open(self) -> None:
        # One that an error has just left: rich does not show a bar that is opened before another one is closed
        for bar, call in list(_open_bars.items()):
            if call.is_over():
                bar.close()
        _open_bars[self] = LearnCall()
        self._closed = threading.Event()
        self._live = Live(get_renderable=self.render, auto_refresh=False)
        self._live.start()
        threading.Thread(target=self._draw, args=(self._closed, _open_bars[self]), daemon=True).start()
        atexit.register(self.close)

    def _draw(self, closed: threading.Event, call: LearnCall) -> None:
        while not closed.wait(SECONDS_BETWEEN_DRAWINGS):
            with self._lock:
                if call.is_over():
                    self.close()
                elif self._live is not None:
                    self._live.refresh()

    def close(self) -> None:
        """Close the bar, which happens by itself when ``learn()`` ends."""
        with self._lock:
            self._closed.set()
            live, self._live = self._live, None
            if live is not None:
                live.stop()
                if not live.console.is_terminal:
                    live.console.line()
        _open_bars.pop(self, None)
        atexit.unregister(self.close)

    def _on_rollout_start(self) -> None:
        self._present = (self.num_timesteps, time.monotonic())
        self._first = self._first or self._present

    def _on_step(self) -> bool:
        # ARS tells nothing of its steps
        for info, done in zip(self.locals.get("infos", ()), self.locals.get("dones", ()), strict=True):
            if done and ("episode_return" in info or "episode" in info):
                self._returns.append(info["episode_return"] if "episode_return" in info else info["episode"]["r"])
                self._mean_return = float(np.mean(self._returns))
        if self._switch.happened(displayed_task(self.model)):
            self._mean_return = None
            self._returns.clear()
        return True

    def _on_training_end(self) -> None:
        self.close()

    def seconds_to(self, step: int) -> float | None:
        """
        :param step: Environment steps
        :return: Seconds until training is there, by the speed so far; None in the first rollout, when it is not known
        """
        speed, (present_step, present_time) = self.steps_per_second, self._present
        if speed is None:
            return None
        return max((step - present_step) / speed - (time.monotonic() - present_time), 0.0)

    @property
    def steps_per_second(self) -> float | None:
        """Environment steps per second of whole rollouts with their updates; None in the first rollout."""
        first_step, first_time = self._first or self._present
        present_step, present_time = self._present
        if present_step == first_step or present_time == first_time:
            return None
        return (present_step - first_step) / (present_time - first_time)

    def render(self) -> RenderableType:
        """
        :return: What the bar shows now
        """
        step, total = self.model.num_timesteps, self.locals["total_timesteps"]
        speed = self.steps_per_second
        elapsed, left = as_clock(time.monotonic() - self._started), as_clock(self.seconds_to(total))
        bar = Table.grid(padding=(0, 1), expand=True)
        bar.add_column()
        bar.add_column(ratio=1)
        bar.add_column(no_wrap=True)
        bar.add_row(
            f"{min(step / total, 1) if total else 1:4.0%}",
            ProgressBar(total=total, completed=step),
            f"{step:,}/{total:,} {elapsed} < {left}, {'-' if speed is None else f'{speed:,.0f}'} steps/s",
        )
        words = self.describe()
        return Group(Text(words, no_wrap=True, overflow="ellipsis"), bar) if words else bar

    def describe(self) -> str:
        """
        :return: The task under way, when the next one begins, and the return; what is not known is left out
        """
        words, task = [], self._switch.task_id
        if task is not None:
            words.append(f"task {task}")
            if active_signal(self.training_env) is None and self._n_tasks is not None:  # else the signal numbers them
                words[0] += f" ({task + 1} of {self._n_tasks})" + (f" {self._names[task]}" if self._names else "")
            if (switch := self._next_switch()) is not None:
                words.append(f"next in {switch - self.model.num_timesteps:,} steps ({as_clock(self.seconds_to(switch))})")
        if self._mean_return is not None:
            words.append(f"return {self._mean_return:.4g}")
        return ", ".join(words)

    def _next_switch(self) -> int | None:
        signal = active_signal(self.training_env)
        if signal is not None and signal.next_switch is not None:
            return signal.next_switch
        start = sequence_start(self.model)
        return next((start + step for step in self._switches if start + step > self.model.num_timesteps), None)


def as_clock(seconds: float | None) -> str:
    """
    :param seconds: A duration, None where it is not known
    :return: In hours, minutes and seconds
    """
    return "-:--:--" if seconds is None else str(timedelta(seconds=round(seconds)))
