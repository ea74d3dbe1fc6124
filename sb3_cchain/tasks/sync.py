"""Keeps continual environments in step with training."""

import warnings

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_cchain.tasks.callback_tree import iterate_callbacks
from sb3_cchain.tasks.continual import is_continual, require_continual
from sb3_cchain.tasks.evaluation import check_apart, check_same_tasks, evaluate_on, find_eval_envs
from sb3_cchain.tasks.reset import reset_training_env
from sb3_cchain.tasks.signal import TASK_KEY, TaskSwitch, first_reset_info


class TaskSync(BaseCallback):
    """
    Keeps continual environments in step with training.

    - The training environments switch tasks together, in total environment steps: they are told their number and how
      many steps the model was trained for. Training that is resumed in a new environment goes on with the right task.
    - The environments of every ``EvalCallback`` given to ``learn()`` are put on the task being trained. Otherwise they would
      count their own few steps and stay on the first task.

    The algorithms with churn reduction add it by themselves in a continual environment. Give it to other algorithms, before
    any ``EvalCallback``.

    It raises a ``TypeError`` when the training environment is not continual, and a ``ValueError`` when environments side by
    side do not have the same tasks at the same times, or an evaluation environment has other tasks than they or is
    one of them.
    """

    def _on_training_start(self) -> None:
        require_continual(self)
        eval_envs = find_eval_envs(self.locals.get("callback"))
        env = self.training_env
        _check_side_by_side(env)
        for eval_env in eval_envs:
            check_apart(env, eval_env)
            check_same_tasks(env, eval_env)
        if any(env.env_method("set_clock", self.num_timesteps, env.num_envs)):
            # The environments were reset before they were told the time, into an episode of the wrong task
            reset_training_env(self.model)
        # The environment's own number, whatever the signal is
        self._switch = TaskSwitch(first_reset_info(env)[TASK_KEY])
        self._eval_envs = eval_envs
        evaluate_on(self._switch.task_id, eval_envs)

    def _on_step(self) -> bool:
        if self._eval_envs:
            task_id = self.locals["infos"][0][TASK_KEY]
            if self._switch.happened(task_id):
                evaluate_on(task_id, self._eval_envs)
        return True


def warn_without_sync(callback: BaseCallback) -> None:
    """
    Warn when continual environments do not know the time of the training, and no :class:`TaskSync` tells them.

    :param callback: A callback that follows the tasks, when training starts
    """
    env = callback.training_env
    given = iterate_callbacks(callback.locals.get("callback"))
    if not is_continual(env) or any(isinstance(other, TaskSync) for other in given):
        return
    clock = env.get_attr("clock", indices=0)[0]
    if clock.n_envs != env.num_envs:
        problem = f"count {clock.n_envs} environment(s) side by side, but there are {env.num_envs}: they switch at other times"
    elif callback.num_timesteps not in (0, clock.n_steps):
        problem = f"are at step {clock.n_steps}, but training is at step {callback.num_timesteps}: they may be in another task"
    else:
        return
    warnings.warn(f"The continual environments {problem}. Give `learn()` a TaskSync, before the other callbacks.")


def _check_side_by_side(env: VecEnv) -> None:
    for name in ("task_sequence", "steps_per_task", "first_task"):
        first, *others = env.get_attr(name)
        for position, other in enumerate(others, start=1):
            if other != first:
                raise ValueError(
                    f"Environments side by side must have the same `{name}`, because they switch together, but environment 0 "
                    f"has {first} and environment {position} has {other}"
                )
