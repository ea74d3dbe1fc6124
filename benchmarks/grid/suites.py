"""The suites of the paper, a row each: everything that the benchmarks know of a suite stands here."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import gymnasium as gym

from benchmarks.grid.released_code import Evaluation, Score
from sb3_cchain.analysis.eval_trained_task import EVALUATION
from sb3_cchain.envs.registration import CONTINUAL_ENVS

PROCGEN_ENVS = tuple(f"Continual/{name}" for name, row in CONTINUAL_ENVS.items() if row["entry_point"].endswith("Procgen"))


@dataclass(frozen=True)
class Demo:
    """What ``benchmarks.demo`` shows of a suite by default: an environment, its length, and a sentence on what one sees."""

    env_id: str
    n_tasks: int
    steps_per_task: int
    explanation: str


@dataclass(frozen=True)
class Suite:
    """
    One suite. Which methods the paper compares in it is said by ``sb3_cchain/methods/registry.py``.

    :param title: Human-readable name
    :param env_ids: Its environments
    :param task_name: Name of a task, from the unwrapped environment and the task's number
    :param rates: Measured environment steps per second on one core, by method; of methods that are missing, Vanilla's
    :param smoke_steps: Environment steps per task of a smoke run, enough for a return in each of two tasks
    :param demo: What the demo shows
    :param checkpoint_freq: Environment steps from one checkpoint of a run to the next, so that saving takes less than 2 % of a
        run
    :param algo: Name on the command line of its algorithm without churn reduction
    :param n_paper_seeds: Number of seeds in the paper
    :param reduce_length: From the paper's number of tasks and steps per task to those of the budget ``reduced``
    :param evaluation: How the agent is evaluated, None where the paper does not evaluate
    :param evaluates: Whether the returns that count in J(T) are those of the evaluations, not of training
    :param score: How the released code of the paper scores a run, None where that is J(T)
    :param recording: What makes training log the score, as after ``--hyperparams``
    :param env_kwargs: Further arguments of the environment, from the number of tasks and the seed
    :param own_scales: Whether tasks differ in the size of their returns
    :param visible: Whether a frame shows what the task is
    """

    title: str
    env_ids: tuple[str, ...]
    task_name: Callable[[Any, int], str]
    rates: Mapping[str, float]
    smoke_steps: int
    demo: Demo
    checkpoint_freq: int
    algo: str = "ppo"
    n_paper_seeds: int = 6
    # All tasks, a tenth of their lengths; not claimed to be long enough for the paper's effects
    reduce_length: Callable[[int, int], tuple[int, int]] = lambda n_tasks, steps: (n_tasks, steps // 10)
    evaluation: Evaluation | None = None
    evaluates: bool = False
    score: Score | None = None
    recording: tuple[str, ...] = ()
    env_kwargs: Callable[[int, int], dict[str, int]] = lambda n_tasks, seed: {}
    own_scales: bool = False
    visible: bool = True

    @property
    def smoothing(self) -> int:
        """Rollouts that the running mean of learning curves goes over; evaluations are not smoothed."""
        return 1 if self.evaluates else 5


SUITES = {
    "gym_control": Suite(
        title="Continual Gym Control",
        env_ids=("Continual/CartPole-v1", "Continual/Acrobot-v1", "Continual/LunarLander-v3", "Continual/MountainCar-v0"),
        task_name=lambda env, task: f"task {task}",
        # Acrobot on a quiet machine of two cores, and by the ratios of docs/results/speed.md
        rates={"vanilla": 500, "cchain": 510, "trac": 400, "l2_init": 480},
        smoke_steps=800,
        demo=Demo(
            *("Continual/Acrobot-v1", 4, 32_000),
            "After each switch the same swing-up is seen through observations with another offset. The worst return is -400.",
        ),
        checkpoint_freq=20_000,
        # Two fifths of the tasks and of their lengths: 4 x 64 000, and 2 x 128 000 in MountainCar. Four tasks of 80 rollouts
        # are enough for Vanilla to collapse far more often than C-CHAIN (docs/results/gym_control.md). A run takes 9 to 10
        # minutes of a core: 72 runs (4 environments, 6 methods, 3 seeds) take less than 12 core-hours
        reduce_length=lambda n_tasks, steps: (n_tasks * 2 // 5, steps * 2 // 5),
        # All methods meet the same offsets under the same seed
        env_kwargs=lambda n_tasks, seed: {"n_tasks": n_tasks, "offset_seed": seed},
        visible=False,
        score=Score(
            "continual/mean_return_with_cut",
            "The released code also counts the episode that the end of a rollout cuts, with its return so far.",
        ),
    ),
    "procgen": Suite(
        title="Continual ProcGen",
        env_ids=PROCGEN_ENVS,
        task_name=lambda env, task: f"level {env.levels[task].start}",
        rates={"vanilla": 55, "cchain": 27},  # Starpilot on a quiet machine (docs/results/procgen.md)
        smoke_steps=500,  # both tasks are in one rollout
        demo=Demo(
            *("Continual/Starpilot-v0", 3, 3000),
            "After each switch it is another level of the same game. Learning takes 100 times longer than this.",
        ),
        checkpoint_freq=10_000,
        env_kwargs=lambda n_tasks, seed: {"n_tasks": n_tasks},
        score=Score(
            "rollout/ep_rew_mean",
            "The released code takes the mean return of the last five episodes that ended, also of those before a switch, at "
            "every tenth iteration.",
            interval=10_000,
        ),
        recording=("stats_window_size:5",),  # SB3's mean return is of the last five episodes then, not of 100
    ),
    "dmc": Suite(
        title="Continual DeepMind Control",
        env_ids=("Continual/Walker-v0", "Continual/Quadruped-v0", "Continual/Dog-v0"),
        task_name=lambda env, task: env.task_names[task],
        rates={"vanilla": 180},  # Walker, C-CHAIN's rate beside other programs: a lower bound (docs/results/dm_control.md)
        smoke_steps=2048,
        demo=Demo(
            *("Continual/Walker-v0", 3, 16_384),
            "After each switch the same robot has another goal, which only the rewards tell it. At this length C-CHAIN's "
            "coefficient stays at its warm-up value.",
        ),
        checkpoint_freq=60_000,
        n_paper_seeds=12,
        own_scales=True,
        # 10 000 steps of evaluation every 20 000 of training, also in shorter tasks
        evaluation=Evaluation(per_task=50, deterministic=False, least_interval=20_000),
        score=Score(
            EVALUATION,
            "The released code evaluates on the task being trained every 20,000 steps, by ten episodes with sampled actions "
            "and the statistics of training. Whether the paper's numbers are of these or of training is not known.",
        ),
    ),
    "minatar": Suite(
        title="Continual MinAtar",
        env_ids=("Continual/MinAtar-v0",),
        task_name=lambda env, task: env.games[task],
        rates={"vanilla": 125, "cchain": 82},  # beside other programs: lower bounds (docs/results/minatar.md)
        smoke_steps=200,
        demo=Demo(
            *("Continual/MinAtar-v0", 3, 20_000),
            "After each switch it is another game. The first 10 000 actions in each are random. The returns are those of "
            "greedy evaluations. Learning takes 50 times longer than this.",
        ),
        checkpoint_freq=50_000,
        algo="double_dqn",
        n_paper_seeds=12,
        evaluation=Evaluation(per_task=30, deterministic=True),
        evaluates=True,
        own_scales=True,
    ),
}


def check_env_id(suite: str, env_id: str) -> None:
    """
    :param suite: Name of a suite
    :param env_id: Environment id
    :raises ValueError: When it is none of the suite
    """
    if env_id not in SUITES[suite].env_ids:
        raise ValueError(f"`env_id` must be one of {', '.join(SUITES[suite].env_ids)}; got {env_id}")


@cache
def paper_length(env_id: str) -> tuple[int, int]:
    """
    :param env_id: Environment id
    :return: The paper's number of tasks, and environment steps per task: the environment's defaults
    :raises ImportError: When a package that the environment needs is not installed
    """
    env = gym.make(env_id)
    task_sequence: Any = env.unwrapped
    length = task_sequence.n_tasks, task_sequence.steps_per_task[0]
    env.close()
    return length


def make_env(suite: str, env_id: str, n_tasks: int, seed: int, task: int, **kwargs: Any) -> gym.Env:
    """
    :param suite: Name of a suite
    :param env_id: One of its environments
    :param n_tasks: Length of the task sequence
    :param seed: Seed of the run
    :param task: Number of a task
    :param kwargs: Further arguments of the environment
    :return: The run's environment, which stays on that task
    """
    kwargs = {**SUITES[suite].env_kwargs(n_tasks, seed), **kwargs}
    return gym.make(env_id, first_task=task, steps_per_task=10**9, **kwargs)


@cache
def task_names(suite: str, env_id: str, n_tasks: int) -> tuple[str, ...]:
    """
    :param suite: Name of a suite
    :param env_id: One of its environments
    :param n_tasks: Length of the task sequence
    :return: Names of the tasks
    """
    env = make_env(suite, env_id, n_tasks, seed=0, task=0)
    names = tuple(SUITES[suite].task_name(env.unwrapped, task) for task in range(n_tasks))
    env.close()
    return names
