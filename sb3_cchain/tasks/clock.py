"""Which task of a sequence is due, counted in environment steps."""

import math
from bisect import bisect_right
from collections.abc import Sequence
from itertools import accumulate

from sb3_cchain.validation import check_number


class TaskClock:
    """
    Counts environment steps and says which task is due. The last task does not end.

    The due task and the present one may differ: a task begins with an episode, so the present task stays until ``begin()``.

    :param steps_per_task: Environment steps of each task
    :param n_envs: How many environments step together; one step of each of them counts as ``n_envs`` environment steps
    :param first_task: The task to begin with; the tasks before it are left out
    :raises ValueError: When there is no such first task, or ``n_envs`` is not positive
    """

    def __init__(self, steps_per_task: Sequence[int], n_envs: int = 1, first_task: int = 0):
        self.n_tasks: int = len(steps_per_task)
        check_number("first_task", first_task, 0, self.n_tasks - 1, integer=True)
        # Total steps at which each task ends, except for the last task, which does not end
        self._ends = list(accumulate(steps_per_task))[:-1]
        self._first_step = [0, *self._ends][first_task]
        self.first_task: int = int(first_task)
        self.task_id: int = self.first_task
        self._pinned_task: int | None = None
        self.set(0, n_envs)

    @property
    def due_task(self) -> int:
        """The task that the next episode is of."""
        return bisect_right(self._ends, self._total_steps) if self._pinned_task is None else self._pinned_task

    @property
    def n_steps(self) -> int:
        """Environment steps made since the first task began, over all environments."""
        return self._total_steps - self._first_step

    @property
    def is_pinned(self) -> bool:
        """Whether it stays on one task."""
        return self._pinned_task is not None

    @property
    def switches(self) -> list[int]:
        """Environment steps since the first task began at which each further task begins; none when pinned to a task."""
        return [] if self.is_pinned else [end - self._first_step for end in self._ends[self.first_task :]]

    @property
    def task_steps(self) -> float:
        """Environment steps made since the present task began, over all environments; infinite when pinned to a task."""
        return math.inf if self.is_pinned else self._total_steps - [0, *self._ends][self.task_id]

    @property
    def is_over(self) -> bool:
        """Whether the present task's time is over. It never is when the clock is pinned to a task."""
        return not self.is_pinned and self.due_task != self.task_id

    def set(self, total_steps: int, n_envs: int | None = None) -> None:
        """
        Set the time. The clock is no longer pinned.

        :param total_steps: Environment steps made since the first task began, over all environments
        :param n_envs: How many environments step together; None leaves the number as it is
        :raises ValueError: When ``total_steps`` is negative or ``n_envs`` is not positive
        """
        check_number("total_steps", total_steps, 0, integer=True)
        if n_envs is not None:
            check_number("n_envs", n_envs, 1, integer=True)
            self.n_envs: int = int(n_envs)
        self._total_steps = self._first_step + int(total_steps)
        self._pinned_task = None

    def pin(self, task_id: int) -> None:
        """
        Make one task due at all times.

        :param task_id: The task, counted from 0
        :raises ValueError: When there is no such task
        """
        check_number("task_id", task_id, 0, self.n_tasks - 1, integer=True)
        self._pinned_task = int(task_id)

    def advance(self) -> bool:
        """
        Count one step of each environment.

        :return: Whether the present task's time is over
        """
        self._total_steps += self.n_envs
        return self.is_over

    def begin(self) -> bool:
        """
        Begin an episode of the task that is due.

        :return: Whether it is another task than before
        """
        previous, self.task_id = self.task_id, self.due_task
        return previous != self.task_id
