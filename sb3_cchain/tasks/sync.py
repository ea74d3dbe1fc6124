"""Keeps continual environments in step with training, and evaluation on the task being trained."""

from collections.abc import Iterator

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback, EventCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_cchain.tasks.signal import TaskSwitch, episode_task, is_continual, require_continual, step_task


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


class TaskSync(BaseCallback):
    """
    Keeps continual environments in step with training.

    - The training environments switch tasks together, in total environment steps: they are told their number and how
      many steps the model was trained for. Training that is resumed in a new environment goes on with the right task.
    - The environments of every ``EvalCallback`` given to ``learn()`` are put on the task being trained. Otherwise they would
      count their own few steps and stay on the first task.

    ``CChainPPO`` adds it by itself in a continual environment; give it to other algorithms, before any ``EvalCallback``.

    It raises a ``TypeError`` when the training environment is not continual, and a ``ValueError`` when environments side by
    side do not have the same tasks at the same times, or an evaluation environment has other tasks than they.
    """

    def _on_training_start(self) -> None:
        require_continual(self)
        self._eval_envs = [
            callback.eval_env
            for callback in iterate_callbacks(self.locals.get("callback"))
            if isinstance(callback, EvalCallback) and is_continual(callback.eval_env)
        ]
        env = self.training_env
        _check_side_by_side(env)
        for eval_env in self._eval_envs:
            _check_same_tasks(env, eval_env)
        if any(env.env_method("set_clock", self.num_timesteps, env.num_envs)):
            # The environments were reset before they were told the time, into an episode of the wrong task
            self.model._last_obs = env.reset()  # type: ignore[assignment]
            self.model._last_episode_starts = np.ones(env.num_envs, dtype=bool)
            vec_normalize = self.model.get_vec_normalize_env()
            if vec_normalize is not None:
                self.model._last_original_obs = vec_normalize.get_original_obs()
        self._switch = TaskSwitch(episode_task(self.model))
        self._evaluate_on(self._switch.task_id)

    def _on_step(self) -> bool:
        task_id = step_task(self.model, self.locals["infos"])
        if self._switch.happened(task_id):
            self._evaluate_on(task_id)
        return True

    def _evaluate_on(self, task_id: int) -> None:
        for eval_env in self._eval_envs:
            eval_env.env_method("set_task", task_id)


def _check_side_by_side(env: VecEnv) -> None:
    for name in ("task_sequence", "steps_per_task", "first_task"):
        first, *others = env.get_attr(name)
        for position, other in enumerate(others, start=1):
            if other != first:
                raise ValueError(
                    f"Environments side by side must have the same `{name}`, because they switch together, but environment 0 "
                    f"has {first} and environment {position} has {other}"
                )


def _check_same_tasks(env: VecEnv, eval_env: VecEnv) -> None:
    tasks, eval_tasks = (an_env.get_attr("task_sequence", indices=0)[0] for an_env in (env, eval_env))
    if tasks == eval_tasks:
        return
    if len(tasks) != len(eval_tasks):
        difference = f"it has {len(eval_tasks)} tasks instead of {len(tasks)}"
    else:
        position = next(i for i, (task, eval_task) in enumerate(zip(tasks, eval_tasks, strict=True)) if task != eval_task)
        difference = f"task {position} differs: {eval_tasks[position]} instead of {tasks[position]}"
    raise ValueError(
        f"The evaluation environment must have the tasks of the training environment, but {difference}. Make both with the "
        "same arguments (RL Zoo: give them as --env-kwargs, or repeat those of the YAML file as --eval-env-kwargs)."
    )
