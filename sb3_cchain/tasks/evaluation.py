"""Evaluation on the task being trained."""

from collections.abc import Sequence

from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_cchain.tasks.callback_tree import iterate_callbacks
from sb3_cchain.tasks.continual import is_continual
from sb3_cchain.tasks.sequence import differing_task
from sb3_cchain.tasks.single_envs import share_envs


def find_eval_envs(callback: BaseCallback | None) -> list[VecEnv]:
    """
    :param callback: All callbacks of ``learn()``
    :return: The continual environments of every ``EvalCallback`` among them
    """
    return [
        found.eval_env
        for found in iterate_callbacks(callback)
        if isinstance(found, EvalCallback) and is_continual(found.eval_env)
    ]


def evaluate_on(task_id: int, eval_envs: Sequence[VecEnv]) -> None:
    """
    :param task_id: The task being trained
    :param eval_envs: Evaluation environments, which stay on that task from their next reset on
    """
    for eval_env in eval_envs:
        eval_env.env_method("set_task", task_id)


def check_apart(env: VecEnv, eval_env: VecEnv) -> None:
    """
    :param env: The training environment
    :param eval_env: An evaluation environment
    :raises ValueError: When both are the same
    """
    if share_envs(env, eval_env):
        raise ValueError(
            "An EvalCallback must have an environment of its own, because it keeps that on the task being trained. Got the "
            "training environment, whose tasks would not switch any more."
        )


def check_same_tasks(env: VecEnv, eval_env: VecEnv) -> None:
    """
    :param env: The training environment
    :param eval_env: An evaluation environment
    :raises ValueError: When their tasks differ
    """
    tasks, eval_tasks = (an_env.get_attr("task_sequence", indices=0)[0] for an_env in (env, eval_env))
    difference = differing_task(tasks, eval_tasks)
    if difference is not None:
        raise ValueError(
            f"The evaluation environment must have the tasks of the training environment, but {difference}. Make both with "
            "the same arguments (RL Zoo: give them as --env-kwargs, or repeat those of the YAML file as --eval-env-kwargs)."
        )
