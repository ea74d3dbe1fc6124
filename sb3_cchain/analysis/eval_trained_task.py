"""Evaluates on the task being trained, as the released code does in DeepMind Control and MinAtar."""

from sb3_cchain.analysis.task_evaluation import TaskEvaluation
from sb3_cchain.callbacks.returns_file import COLUMNS

EVALUATIONS_CSV = "evaluations.csv"
# What is logged
EVALUATION = "evaluation/mean_return"


class EvalTrainedTask(TaskEvaluation):
    """
    Evaluates the agent on the task of a :class:`~sb3_cchain.ContinualEnv` that is being trained: before training, at
    intervals, right after each task and at the end of training. Times, episodes and statistics of normalisation are as with
    :class:`EvalAllTasks`, and training stays the same, to the bit. SB3's ``EvalCallback`` does not evaluate before training,
    shares random numbers with it, and at a switch takes the statistics of the next task.

    Logged is ``evaluation/mean_return``, the mean return. All returns are written to a CSV file with the columns of
    ``returns.csv``: environment steps, task, number of episodes, their mean return. They are kept with the model, as
    ``model.evaluations``, too, so that training that is resumed continues both.

    :param eval_env: As for :class:`EvalAllTasks`
    :param n_eval_episodes: Episodes of an evaluation
    :param interval: Environment steps between evaluations; None for those before training and after each task alone
    :param deterministic: Whether to take the policy's most likely action
    :param seed: Seed of the evaluation episodes
    :param path: The CSV file; by default ``evaluations.csv`` in the folder of the logs, if there is one
    :raises ValueError: As :class:`EvalAllTasks`
    :raises TypeError: As :class:`EvalAllTasks`
    """

    file_name = EVALUATIONS_CSV
    columns = COLUMNS
    kept_as = "evaluations"

    def _new_rows(self, trained_task: int) -> list[dict[str, float]]:
        values = self.num_timesteps, trained_task, self.n_eval_episodes, self._mean_return(trained_task)
        return [dict(zip(COLUMNS, values, strict=True))]

    def _figures(self, trained_task: int) -> dict[str, float]:
        return {EVALUATION: self.rows[-1]["mean_return"]}
