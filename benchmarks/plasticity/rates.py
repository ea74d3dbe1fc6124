"""How long a watched run will take: the training as without monitors, and each look at the network."""

from collections.abc import Iterable
from dataclasses import replace

from benchmarks.grid.plan import Rates
from benchmarks.grid.results import Result
from benchmarks.grid.run import Run
from benchmarks.plasticity.runs import EXPERIMENT, n_looks


class WatchedRates(Rates):
    """
    As :class:`~benchmarks.grid.plan.Rates`, for runs with monitors. Long runs are looked at as often as shorter ones, so what
    the looks take does not grow with the steps.

    :param results: Results of any experiment
    """

    def __init__(self, results: Iterable[Result]):
        results = list(results)
        super().__init__(results)
        # By environment, and by suite: looks, and the seconds that they took
        self._looks: dict[str, tuple[int, float]] = {}
        for result in results:
            if result.experiment.startswith(EXPERIMENT):
                watching = max(result.seconds - super().seconds(_without_monitors(result)), 0.0)
                for key in (result.env_id, result.suite):
                    looks, seconds = self._looks.get(key, (0, 0.0))
                    self._looks[key] = (looks + n_looks(result), seconds + watching)

    def seconds(self, run: Run) -> float:
        """
        :param run: A run with monitors
        :return: Seconds that it will take on one core
        """
        looks, seconds = self._looks.get(run.env_id) or self._looks.get(run.suite) or (1, 0.0)
        return super().seconds(_without_monitors(run)) + n_looks(run) * seconds / looks


def _without_monitors(run: Run) -> Run:
    return replace(run, experiment="paper", variant=None, overrides=())
