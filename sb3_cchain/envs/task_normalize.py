"""Normalisation whose statistics restart at each task."""

from copy import deepcopy
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvStepReturn

from sb3_cchain.tasks.signal import TASK_KEY, TaskSwitch, active_signal, first_reset_info, warn_of_half_told_tasks
from sb3_cchain.validation import check_bool

Observation = NDArray[Any] | dict[str, NDArray[Any]]


class TaskVecNormalize(VecNormalize):
    """
    Stable-Baselines3's ``VecNormalize``, whose statistics restart when the task of a continual environment changes.

    Nothing is carried over a switch: not the mean and variance of the observations, not the variance of the returns, not
    the discounted returns so far. The last step's reward and the ``terminal_observation`` in its info belong to the old task
    and are normalised with its statistics. The observation that comes with that step is already the first of the next task,
    and the first in the new statistics.

    It reads the task from ``task_id`` in the infos of the first environment's resets; environments side by side switch
    together. With a :class:`~sb3_cchain.TaskSignal` in ``learn()``, it restarts one step after the signal says so.
    Without either, while the task stays the same, and with ``restart=False`` it is ``VecNormalize``. With
    ``training=False`` statistics are neither updated nor restarted, so that an evaluation environment has the statistics of
    training (``EvalCallback`` copies them).

    After a switch the statistics of the task before are ``last_task_obs_rms``.

    Saved statistics belong to a task. When training is resumed with them, they go on if the environment is put on that task
    (:class:`~sb3_cchain.TaskSync` does so) and restart otherwise.

    :param venv: The vectorised environment
    :param args: Further arguments of ``VecNormalize``
    :param restart: Whether the statistics restart at a switch
    :param returns_over_cuts: Whether the discounted return that scales the rewards goes on over an episode that is cut, by a
        limit of time, into the next one, as in Gymnasium's ``NormalizeReward``. It starts over at a switch in any case
    :param kwargs: Further keyword arguments of ``VecNormalize``
    :raises TypeError: When ``training``, ``norm_obs``, ``norm_reward``, ``restart`` or ``returns_over_cuts`` is not a boolean
    """

    # Attributes that a saved TaskVecNormalize goes on with; the switches know the task that the statistics are of
    statistics: ClassVar[frozenset[str]] = frozenset({"obs_rms", "ret_rms", "_switch", "_signal_switch"})

    venv: VecEnv

    def __init__(self, venv: VecEnv, *args: Any, restart: bool = True, returns_over_cuts: bool = False, **kwargs: Any):
        super().__init__(venv, *args, **kwargs)
        self.restart = restart
        self.returns_over_cuts = returns_over_cuts
        for name in ("training", "norm_obs", "norm_reward", "restart", "returns_over_cuts"):
            check_bool(name, getattr(self, name))
        # Of no task before the first step, and where tasks have no number
        self._switch = TaskSwitch()
        # The same by the word of a TaskSignal, which may number tasks otherwise
        self._signal_switch = TaskSwitch()
        self._before_reset: dict[str, Any] | None = None

    def forget_task(self) -> None:
        """Go on with the same statistics in any task that comes next."""
        switches = {"_switch": TaskSwitch(), "_signal_switch": TaskSwitch()}
        vars(self).update(switches)
        if self._before_reset is not None:
            self._before_reset.update(switches)

    def reset(self) -> Observation:
        """
        Reset all environments.

        :return: Normalised observation
        """
        if self._follows_tasks():
            # Resumed training begins with a reset into the first task and another reset into the task that is due. A reset
            # that is not followed by a step must leave nothing behind, or loaded statistics would be lost.
            if self._before_reset is not None:
                vars(self).update(self._before_reset)
            # Without normalisation of observations there is no `obs_rms`
            names = self.statistics.intersection(vars(self))
            self._before_reset = {name: deepcopy(vars(self)[name]) for name in names}
        observation = super().reset()
        if self._enters_task():
            self._restart()
            self._update_obs(self.old_obs)
            observation = self.normalize_obs(self.old_obs)
        return observation

    def step_wait(self) -> VecEnvStepReturn:
        """
        :return: Normalised observations and rewards, dones, infos
        """
        obs, rewards, dones, infos = self.venv.step_wait()
        self._before_reset = None
        self.old_obs, self.old_reward = obs, rewards  # type: ignore[assignment]
        if self.training:
            self._update_reward(rewards)
        rewards = self.normalize_reward(rewards)
        # At a switch the statistics restart between the old task's values and the new task's, which VecNormalize's own
        # method has no place for
        if self._follows_tasks():
            warn_of_half_told_tasks(self.venv, infos[0])
        switch = self._enters_task()
        if switch:
            self._normalize_terminal(dones, infos)
            self._restart()
        if self.training:
            self._update_obs(self.old_obs)
        observations = self.normalize_obs(self.old_obs)
        if not switch:
            self._normalize_terminal(dones, infos)
        self.returns[switch | self._ends_return(dones, infos)] = 0
        return observations, rewards, dones, infos

    def _follows_tasks(self) -> bool:
        return self.training and self.restart

    def _enters_task(self) -> bool:
        if not self._follows_tasks():
            return False
        # The vectorised environment has begun the next episode by itself; the info of the step is still that of the old one
        switched = self._switch.happened(first_reset_info(self.venv).get(TASK_KEY))
        signal = active_signal(self.venv)
        return switched if signal is None else self._signal_switch.happened(signal.next_task)

    def _ends_return(self, dones: NDArray[np.bool_], infos: list[dict[str, Any]]) -> NDArray[np.bool_]:
        """Which environments begin a new return."""
        if not self.returns_over_cuts or not any(dones.tolist()):
            return dones
        return dones & ~np.array([info.get("TimeLimit.truncated", False) for info in infos])

    def _restart(self) -> None:
        if self.norm_obs:
            self.last_task_obs_rms: Any = self.obs_rms
            rms: Any = self.obs_rms
            if isinstance(rms, dict):
                self.obs_rms = {key: _fresh(part) for key, part in rms.items()}
            else:
                self.obs_rms = _fresh(rms)  # type: ignore[assignment]
        self.ret_rms = _fresh(self.ret_rms)

    def _update_obs(self, observation: Observation) -> None:
        if not self.norm_obs:
            return
        if isinstance(observation, dict):
            for key, rms in self.obs_rms.items():  # pyright: ignore[reportAttributeAccessIssue]
                rms.update(observation[key])
        else:
            self.obs_rms.update(observation)

    def _normalize_terminal(self, dones: NDArray[np.bool_], infos: list[dict[str, Any]]) -> None:
        if not any(dones.tolist()):
            return
        for position in np.flatnonzero(dones):
            info = infos[position]
            if "terminal_observation" in info:
                info["terminal_observation"] = self.normalize_obs(info["terminal_observation"])


def _fresh(rms: RunningMeanStd) -> RunningMeanStd:
    return RunningMeanStd(shape=rms.mean.shape)
