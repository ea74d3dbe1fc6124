"""What a training run is: the command that a user would type, and the settings by which a finished run counts as this one."""

import ast
import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from benchmarks.grid.strengths import read_strength, split_line, strength_override, with_strength
from benchmarks.grid.suites import SUITES, check_env_id, paper_length
from sb3_cchain.methods.registry import BY_ALGO, METHOD_NAMES, REGISTRY, Method, Strength
from sb3_cchain.zoo.settings import read_settings

ROOT = Path(__file__).parents[2]

# Of lines with another strength than the shipped one, in the order of the tables
STRENGTH_COLORS = (
    *("navy", "deepskyblue", "mediumpurple", "turquoise", "slateblue"),
    *("lightcoral", "sienna", "hotpink", "darkgreen", "maroon"),
)


@dataclass(frozen=True)
class Run:
    """
    One training run under the shipped hyperparameters.

    :param suite: Name of the suite
    :param env_id: One of its environments
    :param method: Name of a method (``sb3_cchain/methods/registry.py``)
    :param seed: Seed of the agent, and of the offsets in Gym Control
    :param n_tasks: Length of the task sequence
    :param steps_per_task: Environment steps per task
    :param experiment: What the run is part of: a budget of the grid, or the name of a comparison. Names the folder
    :param eval_freq: Environment steps between two evaluations on the task being trained, or -1
    :param variant: Name of the method's variant, None for the method itself
    :param overrides: What differs from the shipped hyperparameters, as after ``--hyperparams`` on the command line
    """

    suite: str
    env_id: str
    method: str
    seed: int
    n_tasks: int
    steps_per_task: int
    experiment: str
    eval_freq: int = -1
    variant: str | None = None
    overrides: tuple[str, ...] = ()

    @property
    def line(self) -> str:
        """Name of the method or its variant: runs of one line in a figure or row of a table differ in their seed alone."""
        return self.variant or self.method

    @property
    def name(self) -> str:
        """Human-readable name."""
        return f"{short_name(self.env_id)} {self.line} seed {self.seed}"

    @property
    def algo(self) -> str:
        """The method's name on the command line."""
        return suite_methods(self.suite)[self.method].algo

    @property
    def total_steps(self) -> int:
        """Environment steps of the whole run."""
        return self.n_tasks * self.steps_per_task

    @property
    def task_boundaries(self) -> list[int]:
        """Environment steps at which each task ends."""
        return [self.steps_per_task * (task + 1) for task in range(self.n_tasks)]

    @property
    def settings(self) -> dict[str, Any]:
        """
        What determines the run: a finished run with equal settings is this run, done. The versions of the packages are not
        part of them: they are recorded.
        """
        return self._settings(as_json(shipped_hyperparameters(self.algo, self.env_id)))

    def _settings(self, hyperparameters: Mapping[str, Any] | None) -> dict[str, Any]:
        return {
            "env_id": self.env_id,
            "method": self.method,
            "seed": self.seed,
            "n_tasks": self.n_tasks,
            "steps_per_task": self.steps_per_task,
            # Evaluations do not change the training, so they matter only where the returns are theirs
            "eval_freq": self.eval_freq if SUITES[self.suite].evaluates else -1,
            "overrides": list(self.overrides),
            "hyperparameters": hyperparameters,
        }

    @property
    def hyperparams(self) -> list[str]:
        """
        What stands after ``--hyperparams``: the overrides, and what makes training log the scores. The latter does not change
        the training, so it is not part of the settings.
        """
        suite, overrides = SUITES[self.suite], list(self.overrides)
        if suite.evaluation is not None and self.eval_freq > 0:
            given = next((text for text in overrides if text.startswith("callback:")), None)
            if given is None:
                callbacks = (shipped_hyperparameters(self.algo, self.env_id) or {})["callback"]
            else:
                callbacks = ast.literal_eval(given.removeprefix("callback:"))
                overrides.remove(given)
            # After TaskSync, and before what changes the networks at a switch
            sync, *others = callbacks
            overrides.append(f"callback:{[sync, suite.evaluation.callback(self.eval_freq), *others]}")
        return [*overrides, *suite.recording]

    def path_in(self, folder: Path) -> Path:
        """
        :param folder: Folder of all results, or of all logs
        :return: The run's own folder in it
        """
        env = self.env_id.replace("/", "-")
        return folder / self.experiment / self.suite / env / self.line / f"seed_{self.seed}"

    def arguments(self, folder: Path, device: str = "cpu") -> list[str]:
        """
        :param folder: Where RL Zoo's files go
        :param device: PyTorch device
        :return: The command after ``sb3-cchain``
        """
        env_kwargs = {"steps_per_task": self.steps_per_task, **SUITES[self.suite].env_kwargs(self.n_tasks, self.seed)}
        return [
            *("train", "--algo", self.algo, "--env", self.env_id, "--seed", str(self.seed)),
            *("--n-timesteps", str(self.total_steps), "--num-threads", "1", "--device", device),
            *("--eval-freq", "-1", "--eval-episodes", "10"),
            *("--log-folder", str(folder), "--tensorboard-log", str(folder / "tensorboard"), "--verbose", "0"),
            *("--env-kwargs", *(f"{name}:{value}" for name, value in env_kwargs.items())),
            *(("--hyperparams", *self.hyperparams) if self.hyperparams else ()),
        ]


def make_run(
    suite: str,
    env_id: str,
    method: str,
    seed: int,
    n_tasks: int,
    steps_per_task: int,
    experiment: str,
    eval_freq: int | None = None,
) -> Run:
    """
    :param suite: Name of the suite
    :param env_id: One of its environments
    :param method: Name of a method, with another strength as in ``cchain@1e3``; with the shipped one it is the method itself
    :param seed: Seed
    :param n_tasks: Length of the task sequence
    :param steps_per_task: Environment steps per task
    :param experiment: What the run is part of
    :param eval_freq: Environment steps between evaluations where the suite evaluates, by default as in the paper
    :return: The run
    :raises ValueError: When the method has no settings for the environment, for another strength that cannot be, for more
        tasks than the environment has, for no evaluation in a task, or for a negative seed
    :raises ImportError: When a package that the environment needs is not installed
    """
    method, strength = split_line(method)
    for argument, value, least in (("seed", seed, 0), ("n_tasks", n_tasks, 1), ("steps_per_task", steps_per_task, 1)):
        if value < least:
            raise ValueError(f"`{argument}` must be at least {least}; got {value}")
    check_env_id(suite, env_id)
    if method not in (allowed := available_methods(suite, env_id)):
        raise ValueError(f"`method` must be one of {', '.join(allowed)} in {env_id}; got {method}")
    if "n_tasks" not in SUITES[suite].env_kwargs(n_tasks, seed) and n_tasks > paper_length(env_id)[0]:
        raise ValueError(f"`n_tasks` must be at most {paper_length(env_id)[0]}, the tasks of {env_id}; got {n_tasks}")
    run = Run(suite, env_id, method, seed, n_tasks, steps_per_task, experiment)
    if strength is not None and strength != strength_of(run):
        differing = with_strength(_strength(run), run.settings["hyperparameters"], strength)
        run = replace(run, variant=f"{method}@{strength}", overrides=(strength_override(differing, strength),))
    evaluation = SUITES[suite].evaluation
    if evaluation is None:
        return run
    interval = evaluation.interval(steps_per_task) if eval_freq is None else eval_freq
    if not 0 < interval <= steps_per_task:
        raise ValueError(f"`eval_freq` must be between 1 and `steps_per_task`, which is {steps_per_task}; got {eval_freq}")
    return replace(run, eval_freq=interval)


def other_strength(run: Run) -> dict[str, Any]:
    """
    :param run: A run
    :return: The hyperparameter that holds the strength of its method, of a run that differs from the shipped
        hyperparameters in that strength alone and is named so; empty for every other run
    """
    try:
        method, strength = split_line(run.variant or "")
    except ValueError:
        return {}
    if strength is None or method != run.method:
        return {}
    differing = with_strength(_strength(run), run.settings["hyperparameters"], strength)
    return differing if run.overrides == (strength_override(differing, strength),) else {}


def strength_of(run: Run) -> str:
    """
    :param run: A run of a method that has a strength
    :return: The strength in its shortest form
    :raises ValueError: When it is not among the hyperparameters
    """
    return read_strength(_strength(run), {**run.settings["hyperparameters"], **other_strength(run)})


def _strength(run: Run) -> Strength:
    strength = suite_methods(run.suite)[run.method].strength
    assert strength is not None
    return strength


def lines_in_order(lines: Iterable[str]) -> list[str]:
    """
    :param lines: Names of methods, some with another strength
    :return: Each once, in the order of the tables: those with another strength after their method, by the value
    """
    return sorted(set(lines), key=lambda line: (METHOD_NAMES.index(split_line(line)[0]), float(split_line(line)[1] or 0)))


def suite_lines(suite: str, lines: Iterable[str] = ()) -> dict[str, Method]:
    """
    :param suite: Name of a suite
    :param lines: Names of methods, some with another strength
    :return: Label and colour of all methods of the suite and of those with another strength, in the order of the tables
    """
    methods = suite_methods(suite)
    colors = itertools.cycle(STRENGTH_COLORS)
    rows = {}
    for line in lines_in_order([*methods, *lines]):
        name, value = split_line(line)
        rows[line] = method = methods[name]
        if value is not None and method.strength is not None:
            label = f"{method.label}, {method.strength.symbol} = {value}"
            rows[line] = replace(method, label=label, color=next(colors))
    return rows


def paper_methods(suite: str) -> list[str]:
    """
    :param suite: Name of a suite
    :return: The methods that the paper compares in it, in the order of the tables; all that there are for a suite of others
    """
    methods = suite_methods(suite)
    return [name for name, method in methods.items() if suite in method.suites] or list(methods)


def suite_methods(suite: str) -> dict[str, Method]:
    """
    :param suite: Name of a suite
    :return: By name, in the order of the tables, all methods that there are for the suite's algorithm
    """
    algorithm = BY_ALGO[SUITES[suite].algo].algorithm
    return {method.name: method for method in REGISTRY if issubclass(method.algorithm, algorithm)}


def available_methods(suite: str, env_id: str) -> list[str]:
    """
    :param suite: Name of a suite
    :param env_id: One of its environments
    :return: The methods that have shipped hyperparameters for the environment, in the order of the tables
    """
    return [name for name, method in suite_methods(suite).items() if shipped_hyperparameters(method.algo, env_id)]


def shipped_hyperparameters(algo: str, env_id: str) -> dict[str, Any] | None:
    """
    :param algo: Name of the algorithm on the command line
    :param env_id: Environment id
    :return: What the shipped YAML file says about the environment, None where it says nothing
    """
    return _read_settings(algo).get(env_id)


_read_settings = cache(read_settings)


def as_json(value: Any) -> Any:
    """
    :param value: A value read from YAML
    :return: The same as JSON holds it, which has no infinity
    """
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): as_json(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_json(entry) for entry in value]
    return value


def short_name(env_id: str) -> str:
    """
    :param env_id: Environment id
    :return: The id without its namespace
    """
    return env_id.removeprefix("Continual/")
