"""Keeps continual environments in step with training."""

import warnings

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_cchain.tasks.callback_tree import iterate_callbacks, require_every_rollout, will_be_restored
from sb3_cchain.tasks.continual import is_continual, require_continual
from sb3_cchain.tasks.evaluation import check_apart, check_same_tasks, evaluate_on, find_eval_envs
from sb3_cchain.tasks.reset import reset_training_env
from sb3_cchain.tasks.sequence import describe_sequence, other_sequence, sequence_start
from sb3_cchain.tasks.signal import TASK_KEY, TaskSwitch, count_other_sequence, first_reset_info
from sb3_cchain.tasks.task_signal import TaskSignal


class TaskSync(BaseCallback):
    """
    Keeps continual environments in step with training.

    - The training environments switch tasks together, in total environment steps: they are told their number and how
      many steps the model was trained for. Training that is resumed in a new environment goes on with the right task.
    - Training that goes on in another task sequence, by the word of a :class:`~sb3_cchain.TaskSignal`, begins it with its
      first task. The sequence is kept with the model, as ``model.trained_sequence``.
    - The environments of every ``EvalCallback`` given to ``learn()`` are put on the task being trained. Otherwise they would
      count their own few steps and stay on the first task.

    The algorithms with churn reduction add it by themselves in a continual environment. Give it to other algorithms, before
    any ``EvalCallback``.

    It raises a ``TypeError`` when the training environment is not continual, and a ``ValueError`` when environments side by
    side do not have the same tasks at the same times, when an evaluation environment has other tasks than they or is one of
    them, or when training goes on in another task sequence without a TaskSignal.
    """

    def _on_training_start(self) -> None:
        require_every_rollout(self)
        require_continual(self)
        eval_envs = find_eval_envs(self.locals.get("callback"))
        env = self.training_env
        _check_side_by_side(env)
        for eval_env in eval_envs:
            check_apart(env, eval_env)
            check_same_tasks(env, eval_env)
        self._enter_sequence()
        if any(env.env_method("set_clock", self.num_timesteps - sequence_start(self.model), env.num_envs)):
            # The environments were reset before they were told the time, into an episode of the wrong task
            reset_training_env(self.model)
        # The environment's own number, whatever the signal is
        self._switch = TaskSwitch(first_reset_info(env)[TASK_KEY])
        self._eval_envs = eval_envs
        evaluate_on(self._switch.task_id, eval_envs)

    def _enter_sequence(self) -> None:
        if self.num_timesteps == 0:
            self.model.trained_sequence = None  # type: ignore[attr-defined]
        start = sequence_start(self.model)
        if not will_be_restored(self):
            difference = other_sequence(self.model, self.training_env)
            if difference is not None:
                start = self.num_timesteps
            if start > 0:
                self._require_signal(difference or f"it began at step {start}, after another one")
            if difference is not None:
                count_other_sequence(self.model)
        self.model.trained_sequence = {**describe_sequence(self.training_env), "start": start}  # type: ignore[attr-defined]

    def _require_signal(self, difference: str) -> None:
        if not any(isinstance(given, TaskSignal) for given in iterate_callbacks(self.locals.get("callback"))):
            raise ValueError(
                f"The environment does not have the task sequence that the training began with: {difference}. To train in all "
                "of its tasks, with numbers that go on, give `learn()` a TaskSignal, behind TaskSync. To begin anew, call "
                "`learn(..., reset_num_timesteps=True)`."
            )

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
    n_steps = callback.num_timesteps - sequence_start(callback.model)
    if clock.n_envs != env.num_envs:
        problem = f"count {clock.n_envs} environment(s) side by side, but there are {env.num_envs}: they switch at other times"
    elif callback.num_timesteps > 0 and n_steps != clock.n_steps:
        problem = f"are at step {clock.n_steps}, but training is at step {n_steps}: they may be in another task"
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
