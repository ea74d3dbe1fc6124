"""The paper's grid: which runs there are in a suite under a budget, which of them are done, and what the others will cost."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.results import METHODS, Result, in_json, read_result, result_path
from benchmarks.runs import Run, shipped_hyperparameters
from benchmarks.suites import SUITES, make_env

BUDGETS = ("paper", "reduced", "smoke")

# Seeds of a budget, where the paper's own are 6, and 12 in the suites named
SEEDS = {"paper": 6, "reduced": 3, "smoke": 1}
PAPER_SEEDS = {"dmc": 12, "minatar": 12}

# Of two tasks, in a rollout each (both in one in ProcGen), or with an evaluation each
SMOKE_STEPS = {"gym_control": 800, "procgen": 500, "dmc": 2048, "minatar": 200}

# Environment steps per second on one core (of methods that are not there, Vanilla's): what is believed without results.
# gym_control: Acrobot on a quiet machine of two cores, and by the ratios of docs/results/speed.md.
# procgen: Starpilot on a quiet machine (docs/results/procgen.md).
# dmc: Walker, C-CHAIN's rate beside other programs, a lower bound (docs/results/dm_control.md).
# minatar: 3 x 100 000 steps (docs/results/minatar.md) beside other programs, lower bounds, too.
MEASURED_RATES = {
    "gym_control": {"vanilla": 500, "cchain": 430, "trac": 410, "l2_init": 450},
    "procgen": {"vanilla": 55, "cchain": 27},
    "dmc": {"vanilla": 180},
    "minatar": {"vanilla": 125, "cchain": 82},
}


@dataclass(frozen=True)
class GridRun:
    """
    One run of the grid, defined by the shipped hyperparameters and nothing else.

    :param suite: Name of the suite
    :param env_id: One of its environments
    :param method: One of its methods
    :param seed: Seed
    :param budget: One of ``BUDGETS``
    :param n_tasks: Length of the task sequence
    :param steps_per_task: Environment steps per task
    :param task_names: What the tasks are called
    """

    suite: str
    env_id: str
    method: str
    seed: int
    budget: str
    n_tasks: int
    steps_per_task: int
    task_names: tuple[str, ...]

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.env_id.removeprefix('Continual/')} {self.method} seed {self.seed}"

    @property
    def algo(self) -> str:
        """The method's name on the command line."""
        return SUITES[self.suite].methods[self.method]

    @property
    def total_steps(self) -> int:
        """Environment steps of the whole run."""
        return self.n_tasks * self.steps_per_task

    def path(self, folder: Path) -> Path:
        """
        :param folder: Folder of all results, or of all logs
        :return: The run's own in it
        """
        return result_path(folder, self.budget, self.suite, self.env_id, self.method, self.seed)

    def run(self, folder: Path, device: str = "cpu") -> Run:
        """
        :param folder: Where the run's files go
        :param device: PyTorch device
        :return: The run
        """
        # At other budgets 30 evaluations in a task, as in the paper
        eval_freq = self.steps_per_task if self.budget == "smoke" else None
        suite = SUITES[self.suite]
        run = suite.run(self.algo, self.env_id, self.seed, self.n_tasks, self.steps_per_task, folder, eval_freq)
        return replace(run, device=device)

    @property
    def settings(self) -> dict[str, Any]:
        """What determines the run, as :attr:`Result.settings` has it."""
        return {
            "env_id": self.env_id,
            "algo": self.algo,
            "seed": self.seed,
            "n_tasks": self.n_tasks,
            "steps_per_task": self.steps_per_task,
            "hyperparameters": in_json(shipped_hyperparameters(self.algo, self.env_id)),
        }

    def result(self, results: Path) -> Result | None:
        """
        :param results: Folder of all results
        :return: The run's, None where there is none with the present settings
        """
        result = read_result(self.path(results))
        return result if result is not None and result.settings == self.settings else None


def length(suite: str, env_id: str, budget: str) -> tuple[int, int]:
    """
    :param suite: Name of the suite
    :param env_id: One of its environments
    :param budget: One of ``BUDGETS``
    :return: Number of tasks, and environment steps per task
    """
    n_tasks, steps = SUITES[suite].length(env_id)
    if budget == "smoke":
        return 2, SMOKE_STEPS[suite]
    if budget == "paper":
        return n_tasks, steps
    if suite == "gym_control":
        # Two fifths of the tasks and of their lengths: 4 x 64 000, and 2 x 128 000 in MountainCar. Four tasks of 80 rollouts
        # are enough for Vanilla to collapse and C-CHAIN not to (docs/results/gym_control.md), and take 9 to 10 core-minutes at
        # 500 to 430 steps per second: 72 runs (4 environments, 6 methods, 3 seeds) in less than 12 core-hours
        return n_tasks * 2 // 5, steps * 2 // 5
    # Elsewhere a tenth of the paper's steps: all its tasks, and no claim to be long enough for what the paper sees in them
    return n_tasks, steps // 10


def grid_runs(
    suites: Sequence[str],
    env_ids: Sequence[str] | None = None,
    methods: Sequence[str] | None = None,
    n_seeds: int | None = None,
    budget: str = "paper",
) -> list[GridRun]:
    """
    All seeds of nothing are worth less than one seed of all, so the seeds change last.

    :param suites: Names of suites
    :param env_ids: Environments, by default all of the suites
    :param methods: Methods, in the order in which they are to run, by default all that the paper compares in the suites. Of
        several suites, each has those that the paper compares in it
    :param n_seeds: Number of seeds, from 0; by default that of the budget
    :param budget: One of ``BUDGETS``
    :return: The runs, in the order in which they are to run
    :raises ValueError: For an environment or a method that none of the suites has, less than one seed, or when nothing is left
    """
    _check("env", env_ids, [env_id for suite in suites for env_id in SUITES[suite].env_ids], suites)
    _check("method", methods, [name for name in METHODS if any(name in SUITES[suite].methods for suite in suites)], suites)
    if n_seeds is not None and n_seeds < 1:
        raise ValueError(f"--seeds must be at least 1; got {n_seeds}")
    grid = []
    for suite in suites:
        seeds = n_seeds or (PAPER_SEEDS.get(suite, SEEDS[budget]) if budget == "paper" else SEEDS[budget])
        of_suite = SUITES[suite].methods
        for env_id in SUITES[suite].env_ids:
            if env_ids is not None and env_id not in env_ids:
                continue
            n_tasks, steps = length(suite, env_id, budget)
            probe = GridRun(suite, env_id, "vanilla", 0, budget, n_tasks, steps, ())
            env = make_env(probe.run(Path()), 0)
            names = tuple(SUITES[suite].task_name(env.unwrapped, task) for task in range(n_tasks))
            env.close()
            order = [method for method in dict.fromkeys(methods or of_suite) if method in of_suite]
            grid += [
                (seed, rank, GridRun(suite, env_id, method, seed, budget, n_tasks, steps, names))
                for seed in range(seeds)
                for rank, method in enumerate(order)
            ]
    if not grid:
        raise ValueError(
            f"--method must be one that is compared in {', '.join(env_ids or suites)}; got {', '.join(methods or ())}"
        )
    return [run for *_, run in sorted(grid, key=lambda entry: entry[:2])]


def _check(what: str, given: Iterable[str] | None, allowed: Sequence[str], suites: Sequence[str]) -> None:
    """
    :raises ValueError: When something is given that is not allowed
    """
    for name in given or ():
        if name not in allowed:
            raise ValueError(f"--{what} must be of {', '.join(allowed)} in {', '.join(suites)}; got {name}")


class Rates:
    """
    How long a run will take: from the results of its environment and method, else of its suite and method, else from
    ``MEASURED_RATES``. Smoke runs, which consist of their start, tell of each other alone.

    :param results: Results there are, of any budget
    """

    def __init__(self, results: Iterable[Result]):
        self._totals: dict[tuple, tuple[int, float]] = {}
        for result in results:
            for key in self._keys(result):
                steps, seconds = self._totals.get(key, (0, 0.0))
                self._totals[key] = (steps + result.n_tasks * result.steps_per_task, seconds + result.seconds)

    @staticmethod
    def _keys(of: Result | GridRun) -> tuple[tuple, tuple]:
        smoke = of.budget == "smoke"
        return (smoke, of.env_id, of.method), (smoke, of.suite, of.method)

    def seconds(self, run: GridRun) -> float:
        """
        :param run: A run of the grid
        :return: Seconds that it will take on one core
        """
        for key in self._keys(run):
            if key in self._totals:
                steps, seconds = self._totals[key]
                return run.total_steps * seconds / steps
        rates = MEASURED_RATES[run.suite]
        return run.total_steps / rates.get(run.method, rates["vanilla"])
