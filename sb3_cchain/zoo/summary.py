"""What ``sb3-cchain train`` says at its end: how each task went, where everything lies, and what to type next."""

import shlex
import time
from argparse import Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_cchain.analysis.metrics.continual import average_performance
from sb3_cchain.callbacks import task_averages
from sb3_cchain.callbacks.log_folder import log_folder
from sb3_cchain.callbacks.returns_file import RETURNS_CSV
from sb3_cchain.callbacks.task_progress_bar import as_clock
from sb3_cchain.checkpoint.saved_checkpoint import step_folders
from sb3_cchain.tasks.clock import TaskClock
from sb3_cchain.tasks.continual import is_continual
from sb3_cchain.tasks.names import task_names
from sb3_cchain.tasks.signal import active_signal
from sb3_cchain.zoo.checkpoint_options import CHECKPOINTS
from sb3_cchain.zoo.outputs import print_line

# Episodes that the return at the end of a task is the mean of, at least
LAST_EPISODES = 10


class TaskSummary(NamedTuple):
    """
    How a task went.

    :param task_id: The task, counted from 0
    :param steps: Environment steps in it
    :param episodes: Episodes that ended in it
    :param mean_return: :math:`J(\\mathcal{T}_i)`, the mean over its rollouts
    :param last_return: Mean return of its last episodes: of the last rollouts that hold ten of them
    """

    task_id: int
    steps: int
    episodes: int
    mean_return: float
    last_return: float


def summarise_tasks(rows: Sequence[Mapping[str, float]], steps: Mapping[int, int]) -> list[TaskSummary]:
    """
    :param rows: Rows of ``returns.csv``
    :param steps: Environment steps in each task
    :return: The tasks that have rows
    """
    averages = task_averages(rows)
    return [
        TaskSummary(task_id, n_steps, _n_episodes(rows, task_id), averages[task_id], _last_return(rows, task_id))
        for task_id, n_steps in steps.items()
        if task_id in averages
    ]


def _n_episodes(rows: Sequence[Mapping[str, float]], task_id: int) -> int:
    return sum(int(row["n_episodes"]) for row in rows if row["task_id"] == task_id)


def _last_return(rows: Sequence[Mapping[str, float]], task_id: int) -> float:
    last: list[Mapping[str, float]] = []
    for row in reversed([row for row in rows if row["task_id"] == task_id]):
        if sum(other["n_episodes"] for other in last) >= LAST_EPISODES:
            break
        last.append(row)
    # The row of a task without episodes has 0 of them
    return float(np.average([row["mean_return"] for row in last], weights=[max(row["n_episodes"], 1) for row in last]))


def task_steps(rows: Sequence[Mapping[str, float]], clock: TaskClock | None, num_timesteps: int) -> dict[int, int]:
    """
    :param rows: Rows of ``returns.csv``
    :param clock: That of the continual environment, None where there is none
    :param num_timesteps: Environment steps of the training
    :return: Environment steps in each task: as the clock says, otherwise those from one row to the next
    """
    if clock is None:
        ends = [(int(row["task_id"]), int(row["timesteps"])) for row in rows]
        ends += [(task_id, num_timesteps) for task_id, _ in ends[-1:]]  # after the last row the task is the same
    else:
        switches = [step for step in clock.switches if step < num_timesteps]
        ends = list(enumerate([*switches, num_timesteps], start=clock.first_task))
    steps: dict[int, int] = {}
    begin = 0
    for task_id, end in ends:
        steps[task_id] = steps.get(task_id, 0) + end - begin
        begin = end
    return steps


def task_table(tasks: Sequence[TaskSummary], names: Sequence[str]) -> Table:
    """
    :param tasks: The tasks
    :param names: Their names, by their numbers; empty where they have none
    :return: A row for each
    """
    table = Table(box=box.ASCII)
    for title in ("task", *(("name",) if names else ()), "steps", "episodes", "mean return", "last episodes"):
        table.add_column(title, justify="left" if title == "name" else "right", no_wrap=title != "name", overflow="fold")
    for task in tasks:
        name = (names[task.task_id],) if names else ()
        returns = (f"{value:.4g}" for value in (task.mean_return, task.last_return))
        table.add_row(str(task.task_id), *name, f"{task.steps:,}", f"{task.episodes:,}", *returns)
    return table


class TrainingSummary:
    """
    The summary of a training. It is made before the training, after which the environments are closed.

    :param model: The model
    :param args: RL Zoo's arguments
    :param run_folder: Where RL Zoo's files are
    :param name: The environment's name in RL Zoo's folders
    :param resume_command: What goes on from its newest checkpoint, None without checkpoints
    """

    def __init__(self, model: BaseAlgorithm, args: Namespace, run_folder: Path, name: str, resume_command: str | None):
        assert model.env is not None
        self._env = model.env
        self._model, self._args, self._folder, self._name = model, args, run_folder, name
        self._resume_command = resume_command
        self._clock = model.env.get_attr("clock", indices=0)[0] if is_continual(model.env) else None
        self._names = task_names(model.env)
        self._first_step, self._started = model.num_timesteps, time.monotonic()

    def print(self, console: Console | None = None) -> None:
        """
        :param console: Where to
        """
        console = console or Console()
        if active_signal(self._env) is not None:  # which numbers the tasks in its own way
            self._clock, self._names = None, []
        rows = getattr(self._model, "continual_returns", [])
        tasks = summarise_tasks(rows, task_steps(rows, self._clock, self._model.num_timesteps))
        print_line(console, self._steps())
        if tasks:
            console.print(task_table(tasks, self._names))
            performance = average_performance([task.mean_return for task in tasks])
            print_line(console, f"J(T), the mean over the tasks: {performance:.4g}")
            if any(task.episodes == 0 for task in tasks):
                print_line(console, "Where no episode has ended, the return is the mean reward per step")
        elif episodes := self._model.ep_info_buffer:
            mean = np.mean([episode["r"] for episode in episodes])
            print_line(console, f"Mean return of the last {len(episodes)} episodes: {mean:.4g}")
        places = self._places()
        for title, text in {**places, **self._commands(places)}.items():
            print_line(console, f"{title + ':':13}{text}")

    def _steps(self) -> str:
        model, seconds = self._model, time.monotonic() - self._started
        begin = f"steps {self._first_step:,} to" if self._first_step else "step"
        steps = f"{begin} {model.num_timesteps:,} of {model._total_timesteps:,}"
        return f"{self._args.algo} in {self._args.env}: {steps}, in {as_clock(seconds)}"

    def _places(self) -> dict[str, Path]:
        places = {"Model": self._folder / f"{self._name}.zip", "Best model": self._folder / "best_model.zip"}
        if checkpoints := step_folders(self._folder / CHECKPOINTS):
            places["Checkpoint"] = checkpoints[0]
        if (logs := log_folder(self._model)) is not None:
            places.update({"TensorBoard": logs, "Returns": logs / RETURNS_CSV})
        return {title: path for title, path in places.items() if path.exists()}

    def _commands(self, places: Mapping[str, Path]) -> dict[str, str]:
        args, commands = self._args, {}
        number = self._folder.name.rpartition("_")[2]
        if "Model" in places and number.isdecimal():  # RL Zoo does not find a folder that ends in a uuid
            command = ["sb3-cchain", "enjoy", "--algo", args.algo, "--env", args.env, "-f", args.log_folder]
            command += ["--exp-id", number]
            if args.gym_packages:
                command += ["--gym-packages", *args.gym_packages]
            last = 0 if self._clock is None else max(task_steps([], self._clock, self._model.num_timesteps))
            if last > 0 and args.env.startswith("Continual/"):  # other environments may not have the argument
                command += ["--env-kwargs", f"first_task:{last}"]
            commands["Watch it"] = shlex.join(command)
        if "TensorBoard" in places:
            commands["See curves"] = shlex.join(["tensorboard", "--logdir", args.tensorboard_log])
        if "Checkpoint" in places and self._resume_command and self._model.num_timesteps < self._model._total_timesteps:
            commands["Go on"] = self._resume_command
        return commands
