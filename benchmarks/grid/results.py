"""
Finished runs, one small folder each, readable without this package:
``<results>/<experiment>/<suite>/<environment>/<method or variant>/seed_<seed>/`` with

- ``run.json``: what was run (:class:`Result` and :class:`~benchmarks.grid.run.Run` name the fields)
- ``returns.csv``: ``timesteps,task_id,n_episodes,mean_return`` of each rollout or, in MinAtar, each evaluation
- ``metrics.csv``: ``timesteps,name,value``, the scalars of TensorBoard that begin with one of ``METRIC_PREFIXES``, and what
  the released code of the paper scores a run by (``released_code.py``); the header alone where none was logged
"""

import csv
import errno
import json
import math
import os
import shutil
import uuid
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np

from benchmarks.grid.run import Run, as_json, suite_methods
from benchmarks.grid.suites import SUITES
from sb3_cchain.analysis.curves import Series
from sb3_cchain.callbacks.continual_metrics import COLUMNS, task_averages
from sb3_cchain.checkpoint import write_safely

METRIC_PREFIXES = ("churn/", "churn_monitor/", "ntk/", "health/", "continual_eval/")
METRICS_COLUMNS = ("timesteps", "name", "value")

# No run has so many steps, seeds or seconds
LARGEST = 2**53


@dataclass(frozen=True, kw_only=True)
class Result(Run):
    """
    A finished run, as ``run.json`` describes it, without a word about the machine that it ran on. The file also has, for its
    readers, what follows from the other fields: ``algo``, ``task_boundaries`` and ``steps_per_second``.

    :param path: Its folder (not in the file)
    :param task_names: Names of the tasks
    :param hyperparameters: What the shipped YAML file said; numbers that JSON lacks as strings, ``"inf"``
    :param command: The command, as a user would type it
    :param versions: Versions of the packages that it depends on
    :param git_commit: Commit of the checkout, None outside one
    :param started: Date and time, ISO 8601, UTC
    :param finished: Date and time, ISO 8601, UTC
    :param seconds: Wall time
    :param peak_memory: Bytes resident at most, None where the system does not tell
    """

    path: Path
    task_names: list[str]
    hyperparameters: dict[str, Any]
    command: list[str]
    versions: dict[str, str]
    git_commit: str | None
    started: str
    finished: str
    seconds: float
    peak_memory: int | None

    @property
    def settings(self) -> dict[str, Any]:
        """What determined the run."""
        return self._settings(self.hyperparameters)

    @property
    def steps_per_second(self) -> float:
        """Environment steps per second of wall time."""
        return self.total_steps / self.seconds

    @cached_property
    def returns(self) -> list[dict[str, float]]:
        """
        Rows of ``returns.csv``, read once.

        :raises ValueError: When the file is missing or damaged
        """
        types = (int, int, int, float)
        return [dict(zip(COLUMNS, row, strict=True)) for row in _read_rows(self.path / "returns.csv", COLUMNS, types)]

    @cached_property
    def metrics(self) -> dict[str, list[tuple[int, float]]]:
        """
        ``metrics.csv``, read once: environment steps and values of each scalar, by its name.

        :raises ValueError: When the file is missing or damaged
        """
        metrics: dict[str, list[tuple[int, float]]] = {}
        for timesteps, name, value in _read_rows(self.path / "metrics.csv", METRICS_COLUMNS, (int, str, float)):
            metrics.setdefault(name, []).append((timesteps, value))
        return metrics

    def task_averages(self) -> list[float]:
        """
        :return: J(T_i) of each task: the mean over its rows of their mean return; NaN where it has none
        """
        averages = task_averages(self.returns)
        return [averages.get(task, math.nan) for task in range(self.n_tasks)]

    def released_averages(self) -> list[float]:
        """
        :return: As :meth:`task_averages`, by the rule of the released code; NaN for a task without a point of it
        """
        score = SUITES[self.suite].score
        if score is None:
            return [math.nan] * self.n_tasks
        return [score.average(*self.metric_in_task(score.metric, task)) for task in range(self.n_tasks)]

    def returns_in_task(self, task: int) -> Series:
        """
        :param task: Number of one of its tasks
        :return: Its rows of ``returns.csv``: a rollout in which the task changes has a row for each of the tasks, both at the
            rollout's end
        """
        rows = [row for row in self.returns if row["task_id"] == task]
        return np.array([row["timesteps"] for row in rows]), np.array([row["mean_return"] for row in rows])

    def metric_in_task(self, name: str, task: int, delay: int = 0) -> Series:
        """
        :param name: Name of a scalar in ``metrics.csv``
        :param task: Number of one of its tasks
        :param delay: Rollouts after the one that a value belongs to at whose end it was logged
        :return: What was logged in the task. The step that ends a task is still part of it. What the last rollout logged
            beyond the end of the last task counts for the last task
        """
        logged = np.array(self.metrics.get(name, [])).reshape(-1, 2)
        ends = np.unique([row["timesteps"] for row in self.returns])  # a rollout may have a row for each of two tasks
        if delay and len(ends) > 1:
            logged[:, 0] -= delay * np.diff(ends).min()
        chosen = logged[np.searchsorted(self.task_boundaries[:-1], logged[:, 0]) == task]
        return chosen[:, 0], chosen[:, 1]


# --- Reading ------------------------------------------------------------------------------------------------------------


def read_result(path: Path) -> Result | None:
    """
    :param path: Folder of a result
    :return: The result, None where there is none
    :raises ValueError: When its ``run.json`` is damaged
    """
    file = path / "run.json"
    try:
        result = Result(path=path, **_fields(json.loads(file.read_text())))
        _check(result)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (ValueError, TypeError, AttributeError, LookupError, RecursionError, OSError) as error:
        raise ValueError(f"{file} is not a result ({error}); delete its folder to repeat the run") from error
    return result


def find_result(run: Run, results: Path) -> Result | None:
    """
    :param run: A run
    :param results: Folder of all results
    :return: The run's result, None where there is none with the present settings
    :raises ValueError: When it is damaged
    """
    result = read_result(run.path_in(results))
    return result if result is not None and result.settings == run.settings else None


def read_results(folder: Path) -> tuple[list[Result], dict[Path, str]]:
    """
    :param folder: A folder of results, of any level
    :return: All whole results in it, in the order of their paths; and by path why each of the others is left out, in one line
    """
    results: list[Result] = []
    left_out: dict[Path, str] = {}
    for path in sorted(file.parent for file in folder.rglob("run.json") if not file.parent.name.startswith(".")):
        try:
            result = read_result(path)
            if result is None:
                continue
            if result.suite not in SUITES:
                raise ValueError(f"{path}: unknown suite {result.suite!r}")
            if result.method not in suite_methods(result.suite):
                raise ValueError(f"{path}: unknown method {result.method!r} in {result.suite}")
            result.returns, result.metrics  # noqa: B018 (read now, so that damage is found now)
        except ValueError as error:
            left_out[path] = " ".join(str(error).split())
        else:
            results.append(result)
    return results, left_out


def _fields(saved: dict[str, Any]) -> dict[str, Any]:
    """
    :param saved: What ``run.json`` holds
    :return: The fields of :class:`Result`, but for its path
    """
    fields = {name: value for name, value in saved.items() if name not in ("algo", "task_boundaries", "steps_per_second")}
    return {**fields, "overrides": tuple(fields.get("overrides", ()))}


def _check(result: Result) -> None:
    """
    :raises ValueError: When a field has a wrong type, or a value that no run has
    """
    for name, hint in get_type_hints(Result).items():
        if name != "path" and not _matches(getattr(result, name), hint):
            raise ValueError(f"`{name}` must be {getattr(hint, '__name__', hint)}; got {getattr(result, name)!r}")
    for name in ("seed", "n_tasks", "steps_per_task", "seconds"):
        if not (0 if name == "seed" else 1e-9) <= getattr(result, name) < LARGEST:
            raise ValueError(f"`{name}` is out of range: {getattr(result, name)}")
    if len(result.task_names) != result.n_tasks:
        raise ValueError(f"`task_names` must be {result.n_tasks}; got {len(result.task_names)}")


def _matches(value: Any, hint: Any) -> bool:
    """Whether a value read from JSON has the type of a field."""
    arguments = get_args(hint)
    if get_origin(hint) is UnionType:
        return any(_matches(value, kind) for kind in arguments)
    if get_origin(hint) in (list, tuple):
        return isinstance(value, (list, tuple)) and all(_matches(entry, arguments[0]) for entry in value)
    if get_origin(hint) is dict:
        return isinstance(value, dict) and all(_matches(entry, arguments[1]) for entry in value.values())
    if hint is Any:
        return True
    kinds = {float: (int, float), NoneType: (NoneType,)}.get(hint, (hint,))
    return isinstance(value, kinds) and not isinstance(value, bool)


def _read_rows(path: Path, columns: Sequence[str], types: Sequence[type]) -> list[tuple]:
    """
    :raises ValueError: When the file is missing or damaged; it names the file
    """
    try:
        text = path.read_text()
        lines = list(csv.reader(text.splitlines()))
        if lines[:1] != [list(columns)]:
            raise ValueError(f"its first line must be {','.join(columns)}")
        if not text.endswith("\n"):
            raise ValueError("its last line is torn")
        rows = [tuple(kind(cell) for kind, cell in zip(types, line, strict=True)) for line in lines[1:]]
        if any(isinstance(value, int) and not 0 <= value < LARGEST for row in rows for value in row):
            raise ValueError("it has counts that are out of range")
        return rows
    except (OSError, ValueError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ValueError(f"{path} is missing or damaged ({reason}); delete its folder to repeat the run") from error


# --- Writing ------------------------------------------------------------------------------------------------------------


def write_result(result: Result, returns: Iterable[Mapping[str, Any]], metrics: Iterable[Mapping[str, Any]]) -> None:
    """
    Write a result's folder under a hidden name beside ``result.path`` and rename it, so that there is a whole result or none,
    whenever the process or the machine dies, and never two. A result of the same settings that is there already is left as it
    is; one of other settings is replaced.

    :param result: What ``run.json`` says
    :param returns: Rows of ``returns.csv``
    :param metrics: Rows of ``metrics.csv``
    """
    fields = {name: as_json(value) for name, value in asdict(result).items() if name != "path"}
    fields |= {
        "algo": result.algo,
        "task_boundaries": result.task_boundaries,
        "steps_per_second": round(result.steps_per_second, 1),
    }
    hidden = _hidden_name(result.path)
    with write_safely(hidden / "run.json") as path:
        path.write_text(json.dumps(fields, indent=1, allow_nan=False) + "\n")
    for name, columns, rows in (("returns.csv", COLUMNS, returns), ("metrics.csv", METRICS_COLUMNS, metrics)):
        with write_safely(hidden / name) as path, open(path, "w", newline="") as file:
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
        if there is not None and there.settings == as_json(result.settings):
            return shutil.rmtree(hidden)
        replaced = _hidden_name(result.path)
        # Missing when another process replaces it at the same time
        with suppress(FileNotFoundError):
            os.rename(result.path, replaced)
            shutil.rmtree(replaced)


def _hidden_name(path: Path) -> Path:
    """A unique name beside the path, which no reader looks into."""
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}")
