"""The paper's grid: which runs there are in a suite under a budget, and how long a run will take."""

from collections.abc import Iterable, Sequence

from benchmarks.grid.results import Result
from benchmarks.grid.run import Run, available_methods, make_run, paper_methods, suite_methods
from benchmarks.grid.strengths import paper_lines, split_line
from benchmarks.grid.suites import SUITES, paper_length
from sb3_cchain.methods.registry import METHOD_NAMES
from sb3_cchain.validation import check_number

BUDGETS = ("paper", "reduced", "smoke")
# Seeds of a budget; the paper's own stand in the suite's row
N_SEEDS = {"reduced": 3, "smoke": 1}

# Experiments whose runs tell nothing about the time of others: smoke runs are mostly start-up, and monitors take their time
APART = ("smoke", "plasticity")

# Where all methods of the registry are compared with each other, those of the paper and the others
SHELF_SUITES = ("gym_control", "dmc")
SHELF_ENVS = ("Continual/Acrobot-v1", "Continual/LunarLander-v3", "Continual/Walker-v0")
SHELF_SEEDS = (0, 1)


def run_length(suite: str, env_id: str, budget: str) -> tuple[int, int]:
    """
    :param suite: Name of the suite
    :param env_id: One of its environments
    :param budget: One of ``BUDGETS``
    :return: Number of tasks, and environment steps per task
    """
    return budget_length(suite, paper_length(env_id), budget)


def budget_length(suite: str, length: tuple[int, int], budget: str) -> tuple[int, int]:
    """
    :param suite: Name of the suite
    :param length: The paper's number of tasks, and environment steps per task
    :param budget: One of ``BUDGETS``
    :return: Those of the budget
    """
    if budget == "smoke":
        return 2, SUITES[suite].smoke_steps
    return length if budget == "paper" else SUITES[suite].reduce_length(*length)


def grid_runs(
    suites: Sequence[str],
    env_ids: Sequence[str] | None = None,
    methods: Sequence[str] | None = None,
    seeds: Sequence[int] | None = None,
    budget: str = "paper",
) -> list[Run]:
    """
    One seed of all cells is worth more than all seeds of some, so the seeds change last.

    :param suites: Names of suites
    :param env_ids: Environments, by default all of the suites
    :param methods: Methods, in the order in which they are to run, by default all that the paper compares in the suite. A
        method runs in those of the environments for which it has hyperparameters. ``cchain@1e3`` is C-CHAIN with β 1e3,
        ``weight_clipping@0.5`` weight clipping with κ 0.5, ``l2_init@10`` L2 Init with c 10; ``@all`` stands for all of which
        the paper takes the best
    :param seeds: Seeds, by default as many as the budget has, from 0 on
    :param budget: One of ``BUDGETS``
    :return: The runs, in the order in which they are to run
    :raises ValueError: For an environment or a method that none of the suites has, a strength that cannot be, a seed less
        than 0, or when nothing is left
    """
    all_envs = [(suite, env_id) for suite in suites for env_id in SUITES[suite].env_ids]
    available = {name for suite, env_id in all_envs for name in available_methods(suite, env_id)}
    _check_names("env", env_ids, [env_id for _, env_id in all_envs], suites)
    lines = _same_once([line for method in methods or () for line in paper_lines(method, suites)])
    _check_names("method", [method for method, _ in lines], [name for name in METHOD_NAMES if name in available], suites)
    for seed in seeds or ():
        check_number("seeds", seed, 0, integer=True)
    grid: dict[Run, tuple[int, int]] = {}
    for suite, env_id in all_envs:
        if env_ids is not None and env_id not in env_ids:
            continue
        there = available_methods(suite, env_id)
        chosen = [line for line in lines or _same_once(paper_methods(suite)) if line[0] in there]
        n_tasks, steps = run_length(suite, env_id, budget)
        # At other budgets as in the paper
        eval_freq = steps if budget == "smoke" else None
        for seed in seeds or range(N_SEEDS.get(budget, SUITES[suite].n_paper_seeds)):
            for rank, (method, strength) in enumerate(chosen):
                line = method if strength is None else f"{method}@{strength}"
                run = make_run(suite, env_id, line, seed, n_tasks, steps, budget, eval_freq)
                # The shipped strength may be given beside the method's plain name
                grid.setdefault(run, (seed, rank))
    if not grid:
        raise ValueError(
            f"--method must be one with hyperparameters for {', '.join(env_ids or suites)}; got {', '.join(methods or ())}"
        )
    return sorted(grid, key=grid.__getitem__)


def shelf_runs(
    env_ids: Sequence[str] | None = None,
    methods: Sequence[str] | None = None,
    seeds: Sequence[int] | None = None,
    budget: str = "reduced",
) -> list[Run]:
    """
    All methods that there are, beside each other: the arguments narrow it down.

    :param env_ids: Environments, by default ``SHELF_ENVS``
    :param methods: Methods, by default all that have hyperparameters there
    :param seeds: Seeds, by default ``SHELF_SEEDS``
    :param budget: One of ``BUDGETS``
    :return: As :func:`grid_runs`
    :raises ValueError: As :func:`grid_runs`
    """
    methods = methods or list(suite_methods(SHELF_SUITES[0]))
    return grid_runs(SHELF_SUITES, env_ids or SHELF_ENVS, methods, seeds or SHELF_SEEDS, budget)


def _same_once(lines: Iterable[str] | None) -> list[tuple[str, str | None]]:
    """Methods and strengths, each pair once, however the strength is written."""
    return list(dict.fromkeys(split_line(line) for line in lines or ()))


def _check_names(option: str, given: Iterable[str] | None, allowed: Sequence[str], suites: Sequence[str]) -> None:
    for name in given or ():
        if name not in allowed:
            raise ValueError(f"--{option} must be one of {', '.join(allowed)} in {', '.join(suites)}; got {name}")


class Rates:
    """
    How long a run will take: from the results in its environment with its method, else in its suite with its method, else
    from the suite's row. Those of ``APART`` are used for each other only, and those on a GPU for none.

    :param results: Results of any experiment
    """

    def __init__(self, results: Iterable[Result]):
        self._totals: dict[tuple, tuple[int, float]] = {}
        for result in results:
            if any(word.startswith("cuda") for word in result.command):
                continue
            for key in self._keys(result):
                steps, seconds = self._totals.get(key, (0, 0.0))
                self._totals[key] = (steps + result.total_steps, seconds + result.seconds)

    @staticmethod
    def _keys(run: Run) -> tuple[tuple, tuple]:
        experiment = run.experiment.partition("_")[0]
        # Another strength takes no other time
        kind = experiment if experiment in APART else "", run.line.partition("@")[0]
        return (*kind, run.env_id), (*kind, run.suite)

    def seconds(self, run: Run) -> float:
        """
        :param run: A run
        :return: Seconds that it will take on one core
        """
        for key in self._keys(run):
            if key in self._totals:
                steps, seconds = self._totals[key]
                return run.total_steps * seconds / steps
        rates = SUITES[run.suite].rates
        return run.total_steps / rates.get(run.method, rates["vanilla"])
