"""The callback that says where the signal of task switches comes from."""

import warnings
from bisect import bisect_right
from collections.abc import Sequence
from copy import deepcopy
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cchain.tasks.callback_tree import require_every_rollout, require_single
from sb3_cchain.tasks.drift import Drift
from sb3_cchain.tasks.signal import (
    TASK_KEY,
    count_before_step,
    episode_goes_on,
    first_reset_info,
    has_other_env,
    known_numbers,
    register_signal,
    remember_episode,
    task_count,
)
from sb3_cchain.validation import check_list, check_number


class TaskSignal(BaseCallback):
    """
    Says when the world changes, for any algorithm and any environment. Each switch begins the next task; tasks are numbered 0,
    1, 2, ... in the order in which they come, also where a former world comes back.

    Everything that follows the tasks hears of it: the methods that act at a switch, the reset of λ,
    :class:`~sb3_cchain.envs.TaskVecNormalize`, :class:`~sb3_cchain.ContinualMetrics` and its ``returns.csv``. Give it to
    ``learn()`` before them, and behind a callback that changes the world. The algorithms with churn reduction then add
    ``ContinualMetrics`` by themselves.

    It has one source, by default ``key``. In addition, each other environment that ``set_env()`` gives and each call of
    :func:`~sb3_cchain.task_switched` begins a task. Two reports at the same step are one switch. Sources are asked of the
    first environment; environments side by side switch together.

    - ``key``: the task stands in the info of each step, as ``info[key]``. A value that differs from the last one is a switch;
      values may be of any type. By default ``"task_id"``, which may be absent.
    - ``attribute``: it is an attribute of the environment or of a wrapper, and is read after each step. In ``SubprocVecEnv``
      that costs a message to the process per step; ``key`` costs nothing.
    - ``switch_every``, ``switch_at``: tasks begin after so many environment steps. A task that would begin at the end of
      ``learn()`` or in what its last rollout adds to ``total_timesteps`` begins with the next ``learn()``.
    - ``drift``: nobody says so, and a detector finds out. ``"adwin"`` is ADWIN of the package ``river``
      (https://doi.org/10.1137/1.9781611972771.42, Bifet & Gavaldà, 2007), which compares the older with the newer values of
      a window, of any length, and cuts it where their means differ. It is a switch when the newer values are worse: smaller
      returns, or otherwise greater values. What gets better is taken for learning. After each switch the detector starts
      over with the next rollout, when the methods have acted.

    The state is kept with the model, as ``model.task_signal``: a saved model that is trained further goes on counting, and
    hears of a change in the meantime. A model that was trained without a TaskSignal goes on with the last number that other
    callbacks know. The detector starts over then, except where training is resumed exactly, from a
    :class:`~sb3_cchain.TrainingCheckpoint`.

    :param key: Key of the info that holds the task
    :param attribute: Name of the attribute that tells the task
    :param switch_every: Environment steps per task
    :param switch_at: Environment steps at which the second and further tasks begin
    :param drift: Detector of changes, ``"adwin"``
    :param drift_of: What the detector watches: ``"return"`` for the return of each episode, or the name of a value that is
        logged at each update, such as ``"train/value_loss"`` (PPO), ``"train/loss"`` (DQN) or ``"churn/value_churn"``
    :param drift_delta: Threshold δ of the detector. A smaller one makes false alarms rarer and detection later
    :raises ValueError: When several sources are given, or naming the argument that is out of its range; during training, when
        the source is not there: an info without ``key``, an environment without ``attribute`` or, for ``drift``, ``Monitor``
    :raises ImportError: With ``drift``, when ``river`` is not installed
    """

    def __init__(
        self,
        *,
        key: str | None = None,
        attribute: str | None = None,
        switch_every: int | None = None,
        switch_at: Sequence[int] | None = None,
        drift: str | None = None,
        drift_of: str = "return",
        drift_delta: float = 0.002,
    ):
        super().__init__()
        sources = dict(key=key, attribute=attribute, switch_every=switch_every, switch_at=switch_at, drift=drift)
        given = {name: value for name, value in sources.items() if value is not None}
        if len(given) > 1:
            words = ", ".join(f"{name}={value!r}" for name, value in given.items())
            raise ValueError(f"TaskSignal has one source, got {words}: give one of {', '.join(sources)}")
        for name in {"key", "attribute"} & given.keys():
            if not isinstance(given[name], str):
                raise TypeError(f"`{name}` must be a string, got {given[name]!r}")
        if switch_every is not None:
            check_number("switch_every", switch_every, 1, integer=True)
        self.key = key
        self.attribute = attribute
        self.switch_every = switch_every
        self.switch_at = None if switch_at is None else _check_steps(switch_at)
        self.drift = drift
        self.drift_of = drift_of
        self._has_default_source = not given
        self._detector = (
            None if drift is None else Drift(drift, drift_delta, worse="smaller" if drift_of == "return" else "greater")
        )
        self._starts_over = False  # the detector, at the next rollout
        self._step_task = 0

    @property
    def is_active(self) -> bool:
        """Whether the ``learn()`` that it was given to goes on, or was the model's last one."""
        return self.model.start_time == self._start_time

    @property
    def step_task(self) -> int:
        """The task that the last step was made in."""
        return self._step_task

    @property
    def next_task(self) -> int:
        """The task that the next step will be made in."""
        return self.model.task_signal["task"]  # type: ignore[attr-defined]

    @property
    def next_switch(self) -> int | None:
        """Environment steps after which the next task of this ``learn()`` begins; None where none does, or it is not known."""
        if self.switch_every is not None:
            step: int | None = (self.num_timesteps // self.switch_every + 1) * self.switch_every
        else:
            step = next((step for step in self.switch_at or () if step > self.num_timesteps), None)
        return step if step is not None and step < self.model._total_timesteps else None

    def _on_training_start(self) -> None:
        require_every_rollout(self)
        require_single(self)
        if self.attribute is not None and not self.training_env.has_attr(self.attribute):
            raise ValueError(f"`attribute` must be one of the environment or of a wrapper, but none has {self.attribute!r}")
        if self.num_timesteps == 0 and has_other_env(self.model):
            warnings.warn(
                "`set_env()` gave another environment, but this `learn()` begins anew, at step 0 of task 0. To go on in it as "
                "the next task, call `learn(..., reset_num_timesteps=False)`."
            )
        self._start_time = self.model.start_time
        register_signal(self)
        task_count(self.model)  # set_env() may have given another environment
        if self.num_timesteps == 0 or not hasattr(self.model, "task_signal"):
            self.model.task_signal = self._first_state()  # type: ignore[attr-defined]
        # In an episode that goes on, steps have told more than the info that it began with
        began = {} if episode_goes_on(self.model) else first_reset_info(self.training_env)
        self._hear(self._in_info(began), self._between_steps())
        self._step_task = self.next_task

    def _first_state(self) -> dict[str, Any]:
        """The model may have been trained without this callback, and the task have switched since its last step."""
        count, numbers = count_before_step(self.model), known_numbers(self.model)
        reports: dict[str, Any] = {"count": count}
        if numbers and self._has_default_source:
            reports["info"] = max(numbers)  # where the environment numbers its tasks
        return {"task": max([count, *numbers]), "reports": reports}

    def _on_rollout_start(self) -> None:
        self._hear(self._between_steps())
        if self._detector is not None and self._starts_over:
            # Only now: methods act here, and what they do to the agent is no drift
            self._detector.reset()
            self._starts_over = False
        if self._detector is not None and self.drift_of in self.logger.name_to_value:
            self._watch(self.logger.name_to_value[self.drift_of])  # what the update before this rollout logged

    def _on_step(self) -> bool:
        infos, dones = self.locals["infos"], self.locals["dones"]
        if self.key is not None and self.key not in infos[0]:
            raise ValueError(f"`key`: the environment's info must have {self.key!r}, but it has {sorted(infos[0])}")
        # The info tells of the step that was made, everything else of the next one
        if self._hear(self._in_info(infos[0])):
            # Whoever calls task_switched() at this step means the same
            self.model.task_signal["reports"]["count"] = task_count(self.model)  # type: ignore[attr-defined]
        self._step_task = self.next_task
        self._hear(self._in_info(first_reset_info(self.training_env)) if dones[0] else {}, self._between_steps())
        if self._detector is not None and self.drift_of == "return" and any(dones.tolist()):
            for index in np.flatnonzero(dones):
                self._watch(_episode_return(infos[index]))
        remember_episode(self.model)
        return True

    def _in_info(self, info: dict[str, Any]) -> dict[str, Any]:
        key = TASK_KEY if self._has_default_source else self.key
        return {"info": info[key]} if key in info else {}

    def _between_steps(self) -> dict[str, Any]:
        reports: dict[str, Any] = {"count": self.model.task_count}  # type: ignore[attr-defined]
        if self.attribute is not None:
            # A copy: the environment may change it in place
            reports["attribute"] = deepcopy(self.training_env.get_attr(self.attribute, indices=0)[0])
        # The last rollout goes beyond the steps that were asked for, and begins no task there
        step = min(self.num_timesteps, self.model._total_timesteps - 1)
        if self.switch_every is not None:
            reports["schedule"] = step // self.switch_every
        if self.switch_at is not None:
            reports["schedule"] = bisect_right(self.switch_at, step)
        return reports

    def _hear(self, *reports: dict[str, Any]) -> bool:
        """
        :param reports: What the sources report
        :return: Whether the task has switched, because a report is another one than the last time
        """
        last, has_switched = self.model.task_signal["reports"], False  # type: ignore[attr-defined]
        for name, report in [pair for each in reports for pair in each.items()]:
            has_switched |= name in last and not _equal(last[name], report)
            last[name] = report
        if has_switched:
            self._begin_task()
        return has_switched

    def _watch(self, value: float) -> None:
        assert self._detector is not None
        if self._detector.update(value):
            self._begin_task()

    def _begin_task(self) -> None:
        self.model.task_signal["task"] += 1  # type: ignore[attr-defined]
        self._starts_over = True


def _equal(a: Any, b: Any) -> bool:
    if a is b:
        return True
    if hasattr(a, "shape") or hasattr(b, "shape"):  # arrays, tensors and NumPy's numbers
        return np.array_equal(a, b)
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(_equal(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)) and isinstance(b, (list, tuple)):
        return len(a) == len(b) and all(map(_equal, a, b))
    return bool(a == b)


def _episode_return(info: dict[str, Any]) -> float:
    if "episode" not in info:
        raise ValueError(
            '`drift_of="return"` reads the returns of episodes from Monitor, which the environment lacks: wrap it in '
            "stable_baselines3.common.monitor.Monitor, make it by make_vec_env(), or put VecMonitor around it"
        )
    return float(info["episode"]["r"])


def _check_steps(steps: Sequence[int]) -> list[int]:
    checked = check_list("switch_at", steps, of="environment steps")
    if not checked:
        raise ValueError("`switch_at` must name at least one environment step, got an empty list")
    for position, step in enumerate(checked):
        minimum = 1 if position == 0 else checked[position - 1] + 1
        check_number(f"switch_at[{position}]", step, minimum, integer=True)
    return [int(step) for step in checked]
