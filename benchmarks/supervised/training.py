"""A run: a method that learns the tasks of a problem one after the other, and the files that it leaves."""

import csv
import json
import platform
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

import sb3_cchain
from benchmarks.supervised.images import Images
from benchmarks.supervised.learner import BATCH_SIZE, WIDTH, Learner, Settings
from benchmarks.supervised.tasks import PROBLEMS, Problem, make_task
from sb3_cchain.checkpoint import write_safely
from sb3_cchain.locked_file import open_locked

# Seconds between two saves; a run that is killed loses at most these and the task that it is in
SAVE_INTERVAL = 10.0


@dataclass
class Progress:
    """
    What a run has done.

    :param accuracies: Online accuracy of each task
    :param seconds: Processor time
    """

    accuracies: list[float] = field(default_factory=list)
    seconds: float = 0.0


@dataclass(frozen=True)
class Run:
    """
    A run.

    :param problem_name: Key of ``PROBLEMS``
    :param method: Key of ``METHODS``
    :param seed: Seed
    :param settings: Settings of all methods
    :param n_images: Images of a task
    :param n_epochs: Passes through them
    :param results: Folder of all results
    :param logs: Folder of what runs go on from
    :raises ValueError: When the images cannot be divided into minibatches
    """

    problem_name: str
    method: str
    seed: int
    settings: Settings
    n_images: int
    n_epochs: int
    results: Path
    logs: Path

    def __post_init__(self) -> None:
        # C-CHAIN needs a second minibatch, and the mean over images is the one over minibatches if these are of equal size
        if self.n_images < 2 * BATCH_SIZE or self.n_images % BATCH_SIZE:
            raise ValueError(f"`images` must be a multiple of {BATCH_SIZE}, at least {2 * BATCH_SIZE}, got {self.n_images}")

    @property
    def problem(self) -> Problem:
        """Its problem."""
        return PROBLEMS[self.problem_name]

    @property
    def name(self) -> str:
        """Its name."""
        return f"{self.problem_name}/{self.method}_seed_{self.seed}"

    @property
    def folder(self) -> Path:
        """Its results."""
        return self.results / self.name

    @property
    def state(self) -> Path:
        """What it goes on from."""
        return self.logs / self.name / "state.pt"

    @property
    def updates_per_task(self) -> int:
        """Updates of a task."""
        return self.n_images // BATCH_SIZE * self.n_epochs

    def description(self, images: Images) -> dict[str, Any]:
        """
        :param images: The images
        :return: All that the accuracies depend on
        """
        return {
            **{"problem": self.problem.title, "method": self.method, "seed": self.seed},
            **{"data": images.source, "checksum": images.checksum, "images": self.n_images, "epochs": self.n_epochs},
            **{"batch_size": BATCH_SIZE, "width": WIDTH, **self.settings.of_method(self.method)},
        }


def n_done(run: Run) -> int:
    """
    :param run: A run
    :return: Number of tasks whose accuracies are written down
    """
    return len(read_accuracies(run.folder)) if (run.folder / "accuracy.csv").exists() else 0


def read_accuracies(folder: Path) -> np.ndarray:
    """
    :param folder: Results of a run
    :return: Online accuracy of each task
    :raises ValueError: When the file has other columns
    """
    path = folder / "accuracy.csv"
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    try:
        return np.array([float(row["accuracy"]) for row in rows])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} must have the columns task and accuracy: {error!r}") from error


def read_about(folder: Path) -> dict[str, Any]:
    """
    :param folder: Results of a run
    :return: Its settings, versions, updates and seconds
    """
    return json.loads((folder / "run.json").read_text())


def check_settings(run: Run, images: Images) -> None:
    """
    :param run: A run
    :param images: The images
    :raises ValueError: When its results, or those of another seed, were made with other settings
    """
    wanted = run.description(images)
    for path in sorted(run.folder.parent.glob(f"{run.method}_seed_*/run.json")):
        known = read_about(path.parent)["settings"]
        if path.parent != run.folder:
            # The table shows their mean
            known["seed"] = run.seed
        differing = [name for name in {**known, **wanted} if known.get(name) != wanted.get(name)]
        if differing:
            words = ", ".join(f"{name} {known.get(name)!r} instead of {wanted.get(name)!r}" for name in differing)
            raise ValueError(f"{path.parent} was made with {words}. Delete it, or give other folders by --results and --logs")


def check_state(run: Run, n_tasks: int) -> None:
    """
    :param run: A run
    :param n_tasks: Number of tasks that it is to do
    :raises ValueError: When it has done some of them, but what it would go on from is gone
    """
    n_finished = n_done(run)
    if 0 < n_finished < n_tasks and not run.state.exists():
        raise ValueError(
            f"{run.folder} has {n_finished} tasks, but {run.state}, from which the run would go on, is missing. Delete the "
            "results to begin anew, or give other folders by --results and --logs"
        )


def train(run: Run, images: Images, n_tasks: int, after_task: Callable[[Progress], None] = lambda progress: None) -> Progress:
    """
    Learn tasks until ``n_tasks`` are done, from the last one that was saved on.

    Tasks follow from the seed and their number, so the parameters, the optimiser and the reducer are all that is saved, and a
    run can be prolonged later.

    :param run: The run
    :param images: The images
    :param n_tasks: Number of tasks
    :param after_task: Called after each task, and before the first one
    :return: What has been done
    :raises ValueError: When its results were made with other settings, what it goes on from is gone, or another process is
        making it
    """
    check_settings(run, images)
    check_state(run, n_tasks)
    th.set_num_threads(1)
    run.state.parent.mkdir(parents=True, exist_ok=True)
    with open_locked(run.state.with_name("lock"), f"Another process is making {run.name}"), _without_subnormals():
        learner = Learner(run.method, run.settings, images.pixels.shape[1], run.seed)
        progress = _restore(run, images, learner)
        after_task(progress)
        saved_at = time.monotonic()
        for index in range(len(progress.accuracies), n_tasks):
            started = time.process_time()
            task, generator = make_task(run.problem, images, run.n_images, run.seed, index)
            progress.accuracies.append(learner.learn(task, run.n_epochs, generator))
            progress.seconds += time.process_time() - started
            if time.monotonic() - saved_at > SAVE_INTERVAL or index == n_tasks - 1:
                _save(run, images, learner, progress)
                saved_at = time.monotonic()
            after_task(progress)
    if n_tasks >= run.problem.n_tasks:
        shutil.rmtree(run.state.parent)
    return progress


@contextmanager
def _without_subnormals() -> Iterator[None]:
    """Where units are dead, Adam's moments decay to subnormal numbers, with which processors are many times slower."""
    th.set_flush_denormal(True)
    try:
        yield
    finally:
        th.set_flush_denormal(False)


def _restore(run: Run, images: Images, learner: Learner) -> Progress:
    if not run.state.exists():
        return Progress()
    state = th.load(run.state, weights_only=True)
    if state["settings"] != run.description(images):
        raise ValueError(f"{run.state} was made with other settings. Delete it, or give another folder by --logs")
    learner.load_state_dict(state["learner"])
    return Progress(state["accuracies"], state["seconds"])


def _save(run: Run, images: Images, learner: Learner, progress: Progress) -> None:
    settings = run.description(images)
    with write_safely(run.state) as path:
        th.save({"settings": settings, "learner": learner.state_dict(), **vars(progress)}, path)
    about = {
        "settings": settings,
        "versions": {"python": platform.python_version(), "torch": str(th.__version__), "sb3_cchain": sb3_cchain.__version__},
        "updates": run.updates_per_task * len(progress.accuracies),
        "processor_seconds": round(progress.seconds, 1),
    }
    with write_safely(run.folder / "run.json") as path:
        path.write_text(json.dumps(about, indent=2, ensure_ascii=False) + "\n")
    with write_safely(run.folder / "accuracy.csv") as path, open(path, "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["task", "accuracy"])
        writer.writerows((index, f"{accuracy:.6f}") for index, accuracy in enumerate(progress.accuracies))


def updates_per_second(run: Run, images: Images) -> float:
    """
    :param run: A run
    :param images: The images
    :return: How many of its updates this machine makes in a second now
    """
    th.set_num_threads(1)
    learner = Learner(run.method, run.settings, images.pixels.shape[1], run.seed)
    task, generator = make_task(run.problem, images, 10 * BATCH_SIZE, run.seed, 0)
    learner.learn(task, 1, generator)
    n_updates, started = 0, time.perf_counter()
    while time.perf_counter() < started + 0.5:
        learner.learn(task, 1, generator)
        n_updates += 10
    return n_updates / (time.perf_counter() - started)
