"""Keeps continual environments in step with training, and evaluation on the task being trained."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback, EventCallback
from stable_baselines3.common.vec_env import VecEnv


class TaskSwitch:
    """Notices from the ``infos`` of a vectorised environment that its task changed."""

    def __init__(self) -> None:
        self.task_id: int | None = None

    def happened(self, infos: list[dict[str, Any]]) -> bool:
        """
        :param infos: Of one step
        :return: Whether the task is another one than at the step before
        """
        previous, self.task_id = self.task_id, infos[0].get("task_id", self.task_id)
        return previous is not None and previous != self.task_id


def is_continual(env: VecEnv | None) -> bool:
    """
    :param env: A vectorised environment
    :return: Whether it consists of :class:`~sb3_cchain.ContinualEnv`
    """
    return env is not None and env.has_attr("task_id") and env.has_attr("steps_per_task")


def iterate_callbacks(callback: BaseCallback | None) -> Iterator[BaseCallback]:
    """
    :param callback: A callback
    :return: It and all that it contains
    """
    if callback is None:
        return
    yield callback
    children: list[BaseCallback | None] = []
    if isinstance(callback, CallbackList):
        children += callback.callbacks
    if isinstance(callback, EventCallback):
        children += [callback.callback]
    if isinstance(callback, EvalCallback):
        children += [callback.callback_on_new_best]
    for child in children:
        yield from iterate_callbacks(child)


def require_continual(callback: BaseCallback, env: VecEnv) -> None:
    """
    :param callback: A callback for continual environments
    :param env: The training environment
    :raises TypeError: When it is not continual
    """
    if not is_continual(env):
        raise TypeError(
            f"{type(callback).__name__} is for continual environments, but the training environment is not one. "
            'Make it with gymnasium.make("Continual/...") or sb3_cchain.ContinualEnv.'
        )


class TaskSync(BaseCallback):
    """
    Keeps continual environments in step with training.

    - The training environments switch tasks together, in total environment steps: they are told their number and how
      many steps the model was trained for. So training that is resumed in a new environment goes on with the right task.
    - The environments of every ``EvalCallback`` given to ``learn()`` are put on the task being trained. Left alone, they
      would count their own few steps and stay on the first task.

    ``CChainPPO`` adds it by itself in a continual environment; give it to other algorithms, before any ``EvalCallback``.

    It raises a ``TypeError`` when the training environment is not continual, and a ``ValueError`` when an evaluation
    environment has other tasks than it.
    """

    def _on_training_start(self) -> None:
        self._eval_envs = [
            callback.eval_env
            for callback in iterate_callbacks(self.locals.get("callback"))
            if isinstance(callback, EvalCallback) and is_continual(callback.eval_env)
        ]
        env = self.training_env
        require_continual(self, env)
        for eval_env in self._eval_envs:
            _check_same_tasks(env, eval_env)
        if any(env.env_method("set_clock", self.num_timesteps, env.num_envs)):
            # The environments were reset before they were told the time, into an episode of the wrong task
            self.model._last_obs = env.reset()  # type: ignore[assignment]
            self.model._last_episode_starts = np.ones(env.num_envs, dtype=bool)
            vec_normalize = self.model.get_vec_normalize_env()
            if vec_normalize is not None:
                self.model._last_original_obs = vec_normalize.get_original_obs()
        self._follow(env.get_attr("task_id")[0])

    def _on_step(self) -> bool:
        task_id = self.locals["infos"][0]["task_id"]
        if task_id != self._task_id:
            self._follow(task_id)
        return True

    def _follow(self, task_id: int) -> None:
        self._task_id = task_id
        for eval_env in self._eval_envs:
            eval_env.env_method("set_task", task_id)


def _check_same_tasks(env: VecEnv, eval_env: VecEnv) -> None:
    for name in ("n_tasks", "offsets", "games", "game", "levels", "domain", "task_names"):
        if env.has_attr(name) and eval_env.has_attr(name):
            ours, theirs = env.get_attr(name)[0], eval_env.get_attr(name)[0]
            if not np.array_equal(ours, theirs):
                raise ValueError(
                    f"The evaluation environment must have the tasks of the training environment, but `{name}` differs: "
                    f"{theirs} instead of {ours}. Make both with the same arguments (RL Zoo: give them as --env-kwargs, or "
                    "repeat those of the YAML file as --eval-env-kwargs)."
                )
