"""The quantities that are drawn and tabled over the tasks, a row each."""

from typing import NamedTuple

from benchmarks.grid.results import Result
from sb3_cchain.analysis.curves import Series

RETURN = "return"


class Quantity(NamedTuple):
    """
    A quantity that runs log.

    :param name: ``RETURN``, or the name of a scalar in ``metrics.csv``
    :param label: Human-readable name
    :param logarithmic: Whether its axis is logarithmic
    :param delay: Rollouts between the one that a value belongs to and the one at whose end it is logged: SB3 writes what
        ``train()`` logs at the end of the next rollout
    """

    name: str
    label: str
    logarithmic: bool = False
    delay: int = 0

    def series(self, result: Result, task: int) -> Series:
        """
        :param result: A finished run
        :param task: Number of one of its tasks
        :return: Environment steps and values in that task
        """
        if self.name == RETURN:
            return result.returns_in_task(task)
        return result.metric_in_task(self.name, task, self.delay)


RETURNS = Quantity(RETURN, "return per episode")
NTK = (
    Quantity("ntk/srank", "NTK: srank"),
    Quantity("ntk/off_diagonal_sum", "NTK: off-diagonal sum", logarithmic=True),
    Quantity("ntk/diagonal_sum", "NTK: diagonal sum", logarithmic=True),
)
PLASTICITY = (
    RETURNS,
    *NTK,
    Quantity("churn_monitor/fresh/policy_churn", "policy churn, KL", logarithmic=True, delay=1),
    Quantity("health/dormant_share", "dormant units, share"),
)
