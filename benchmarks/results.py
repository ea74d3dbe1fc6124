"""
Finished runs, one small folder each, readable without this package:
``<results>/<budget>/<suite>/<environment>/<method>/seed_<seed>/`` with

- ``run.json``: what was run (:class:`Result` names the fields)
- ``returns.csv``: ``timesteps,task_id,n_episodes,mean_return`` of each rollout or, where the suite evaluates, each evaluation
- ``metrics.csv``: ``timesteps,name,value``, the scalars of TensorBoard that begin with one of ``METRIC_PREFIXES``; the
  header alone where none was logged
"""

import csv
import errno
import json
import math
import os
import shutil
import uuid
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from sb3_cchain.callbacks import read_returns
from sb3_cchain.callbacks.continual_metrics import COLUMNS, task_averages

# Of a suite, those that the paper compares in it
METHODS = ("oracle", "vanilla", "trac", "weight_clipping", "l2_init", "layer_norm", "redo", "adam_rel", "cchain")
METRIC_PREFIXES = ("churn/", "churn_monitor/", "ntk/", "health/")
METRICS_COLUMNS = ("timesteps", "name", "value")

# Of a result's fields, those that determine the run. Not the versions, which are recorded: a result of another version is one
SETTINGS = ("env_id", "algo", "seed", "n_tasks", "steps_per_task", "hyperparameters")

# Environment steps and values of one run
Series = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Result:
    """
    One finished run, as ``run.json`` describes it, without a word of the machine that it ran on.

    :param path: Its folder (not in the file)
    :param suite: Suite
    :param env_id: Environment id
    :param method: One of ``METHODS``
    :param algo: The method's name on the command line
    :param seed: Seed
    :param budget: Name of the budget
    :param n_tasks: Length of the task sequence
    :param steps_per_task: Environment steps per task
    :param task_names: What the tasks are called
    :param task_boundaries: Environment steps at which each task ends
    :param hyperparameters: What the shipped YAML file says; numbers that JSON lacks as strings, ``"inf"``
    :param command: The command, as a user would type it
    :param versions: Versions of the packages that it depends on
    :param git_commit: Commit of the checkout, None outside one
    :param started: Date and time, ISO 8601, UTC
    :param finished: Date and time, ISO 8601, UTC
    :param seconds: Wall time
    :param steps_per_second: Environment steps per second of it
    :param peak_memory: Bytes resident at most, None where the system does not tell
    """

    path: Path
    suite: str
    env_id: str
    method: str
    algo: str
    seed: int
    budget: str
    n_tasks: int
    steps_per_task: int
    task_names: list[str]
    task_boundaries: list[int]
    hyperparameters: dict[str, Any]
    command: list[str]
    versions: dict[str, str]
    git_commit: str | None
    started: str
    finished: str
    seconds: float
    steps_per_second: float
    peak_memory: int | None

    @property
    def settings(self) -> dict[str, Any]:
        """What determines the run."""
        return {name: getattr(self, name) for name in SETTINGS}

    @cached_property
    def returns(self) -> list[dict[str, float]]:
        """Rows of ``returns.csv``, read once."""
        return read_returns(self.path / "returns.csv")

    @cached_property
    def metrics(self) -> dict[str, list[tuple[int, float]]]:
        """``metrics.csv``, read once: environment steps and values of each scalar, by its name."""
        metrics: dict[str, list[tuple[int, float]]] = {}
        with open(self.path / "metrics.csv", newline="") as file:
            for row in csv.DictReader(file):
                metrics.setdefault(row["name"], []).append((int(row["timesteps"]), float(row["value"])))
        return metrics

    def task_averages(self) -> list[float]:
        """
        :return: J(T_i) of each task: the mean over its rows of their mean return; NaN where it has none
        """
        averages = task_averages(self.returns)
        return [averages.get(task, math.nan) for task in range(self.n_tasks)]

    def returns_of_task(self, task: int) -> Series:
        """
        :param task: Number of one of its tasks
        :return: Its rows of ``returns.csv``: of a rollout in which the task changes, each task has its own, at the rollout's
            end
        """
        rows = [row for row in self.returns if row["task_id"] == task]
        return np.array([row["timesteps"] for row in rows]), np.array([row["mean_return"] for row in rows])

    def metric_of_task(self, name: str, task: int) -> Series:
        """
        :param name: Name of a scalar in ``metrics.csv``
        :param task: Number of one of its tasks
        :return: What was logged in the task: the step that ends it is still of it; of the last task, what the last rollout
            logged beyond its end, too
        """
        logged = np.array(self.metrics.get(name, [])).reshape(-1, 2)
        chosen = logged[np.searchsorted(self.task_boundaries[:-1], logged[:, 0]) == task]
        return chosen[:, 0], chosen[:, 1]


def result_path(folder: Path, budget: str, suite: str, env_id: str, method: str, seed: int) -> Path:
    """
    :param folder: Folder of all results
    :param budget: Name of the budget
    :param suite: Suite
    :param env_id: Environment id
    :param method: One of ``METHODS``
    :param seed: Seed
    :return: Where that run's result goes
    """
    return folder / budget / suite / env_id.replace("/", "-") / method / f"seed_{seed}"


def in_json(value: Any) -> Any:
    """
    :param value: A value read from YAML
    :return: As JSON holds it, which knows no infinity
    """
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): in_json(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [in_json(entry) for entry in value]
    return value


def read_result(path: Path) -> Result | None:
    """
    :param path: Folder of a result
    :return: The result, None where there is none
    :raises ValueError: When it is damaged
    """
    file = path / "run.json"
    try:
        return Result(path=path, **json.loads(file.read_text()))
    except FileNotFoundError:
        return None
    except (ValueError, TypeError) as error:
        raise ValueError(f"{file} is not a result ({error}); delete its folder to repeat the run") from error


def read_results(folder: Path) -> list[Result]:
    """
    :param folder: A folder of results, of any level
    :return: All results in it, by their paths
    """
    paths = sorted(file.parent for file in folder.rglob("run.json") if not file.parent.name.startswith("."))
    return [result for path in paths if (result := read_result(path)) is not None]


def write_result(result: Result, returns: Iterable[Mapping[str, Any]], metrics: Iterable[Mapping[str, Any]]) -> None:
    """
    Write a result's folder under a hidden name beside ``result.path`` and rename it, so that there is a whole result or none,
    whenever the process or the machine dies, and never two. A result of the same settings that is there already is left as it
    is, one of others is replaced.

    :param result: What ``run.json`` says
    :param returns: Rows of ``returns.csv``
    :param metrics: Rows of ``metrics.csv``
    """
    fields = {name: in_json(value) for name, value in asdict(result).items() if name != "path"}
    hidden = _hidden(result.path)
    hidden.mkdir(parents=True)
    with _on_disk(hidden / "run.json") as file:
        file.write(json.dumps(fields, indent=1, allow_nan=False) + "\n")
    for name, columns, rows in (("returns.csv", COLUMNS, returns), ("metrics.csv", METRICS_COLUMNS, metrics)):
        with _on_disk(hidden / name) as file:
            writer = csv.DictWriter(file, columns, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    while True:
        try:
            return os.rename(hidden, result.path)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                raise
        there = read_result(result.path)
        if there is not None and there.settings == {name: fields[name] for name in SETTINGS}:
            return shutil.rmtree(hidden)
        replaced = _hidden(result.path)
        # Missing: another process replaces it, too
        with suppress(FileNotFoundError):
            os.rename(result.path, replaced)
            shutil.rmtree(replaced)


@contextmanager
def _on_disk(path: Path) -> Iterator[TextIO]:
    """A new file that, once it is closed, outlives a power cut: a rename alone may do so without what is in it."""
    with open(path, "w", newline="") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


def _hidden(path: Path) -> Path:
    """A name of one's own beside it, which no reader looks into."""
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}")
