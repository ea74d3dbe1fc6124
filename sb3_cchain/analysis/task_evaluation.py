"""Evaluates on tasks of a continual environment during training."""

import warnings
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces, wrappers
from gymnasium.envs.registration import WrapperSpec, load_env_creator
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_cchain.callbacks.log_folder import log_path
from sb3_cchain.callbacks.returns_file import ReturnsFile
from sb3_cchain.checkpoint.random_state import unchanged_random_state
from sb3_cchain.checkpoint.resumable_env import ResumableEnv
from sb3_cchain.envs import TaskCaption
from sb3_cchain.masked_evaluation import evaluate_policy
from sb3_cchain.tasks.callback_tree import require_every_rollout, require_single, require_unchanged_network
from sb3_cchain.tasks.continual import is_continual, require_continual
from sb3_cchain.tasks.evaluation import check_same_tasks
from sb3_cchain.tasks.signal import TASK_KEY, TaskSwitch, active_signal, first_reset_info
from sb3_cchain.tasks.single_envs import share_envs
from sb3_cchain.tasks.sync import warn_without_sync
from sb3_cchain.tensorboard.overview import add_overview
from sb3_cchain.validation import check_bool, check_number, check_path

# Wrappers that change neither observations nor actions, nor the length of episodes
NEEDLESS = (
    gym.RewardWrapper,
    wrappers.HumanRendering,
    wrappers.NormalizeReward,
    wrappers.RecordEpisodeStatistics,
    wrappers.RecordVideo,
    wrappers.RenderCollection,
    Monitor,
    ResumableEnv,
    TaskCaption,
)

# Steps of an episode after which a warning says that it may never end
LONG_EPISODE = 100_000


class TaskEvaluation(BaseCallback):
    """
    What :class:`EvalAllTasks`, which has the arguments, and :class:`EvalTrainedTask` have in common: when they evaluate, in
    which environment, and that training stays the same. Subclasses say on which tasks, and what is logged and written.
    """

    # Name and columns of the CSV file, and the attribute of the model that keeps its rows
    file_name: ClassVar[str]
    columns: ClassVar[tuple[str, ...]]
    kept_as: ClassVar[str]

    def __init__(
        self,
        eval_env: gym.Env | VecEnv | None = None,
        *,
        n_eval_episodes: int = 5,
        interval: int | None = None,
        deterministic: bool = True,
        seed: int = 0,
        path: str | Path | None = None,
    ):
        super().__init__()
        check_number("n_eval_episodes", n_eval_episodes, 1, integer=True)
        if interval is not None:
            check_number("interval", interval, 1, integer=True)
        check_bool("deterministic", deterministic)
        check_number("seed", seed, 0, integer=True)
        self.eval_env: Any = eval_env  # vectorised, once there is a model
        self.n_eval_episodes = n_eval_episodes
        self.interval = interval
        self.deterministic = deterministic
        self.seed = seed
        self.path: Path | None = None if path is None else check_path("path", path)
        self._file: ReturnsFile | None = None
        self._last_step = 0
        # Of the last rollout, whose task is evaluated when training ends
        self._trained_task: int | None = None

    def _init_callback(self) -> None:
        require_continual(self)
        env = _make_eval_env(self.model) if self.eval_env is None else self.eval_env
        self.eval_env = self.model._wrap_env(env, verbose=0)
        _check_fits(self.eval_env, self.training_env)
        normalize = unwrap_vec_normalize(self.eval_env)
        if normalize is not None:
            normalize.training = False  # its statistics are those of training
        if not is_continual(self.eval_env):
            raise TypeError(f"`eval_env` must be a continual environment, got {self.eval_env.unwrapped}")
        check_same_tasks(self.training_env, self.eval_env)

    def _on_training_start(self) -> None:
        require_every_rollout(self)
        require_single(self)
        require_unchanged_network(self)
        warn_without_sync(self)
        add_overview(self.model)
        is_new = self.num_timesteps == 0
        past = [] if is_new else getattr(self.model, self.kept_as, [])
        self.rows: list[dict[str, Any]] = [row for row in past if row["timesteps"] <= self.num_timesteps]
        setattr(self.model, self.kept_as, self.rows)
        path = self.path or log_path(self.model, self.file_name)
        self._file = None if path is None else ReturnsFile(path, self.rows, keep_old=is_new, columns=self.columns)
        self._switch = TaskSwitch()
        self._trained_task = None
        self._last_step = self.num_timesteps

    def _on_rollout_start(self) -> None:
        before, now = self._switch.task_id, first_reset_info(self.training_env)[TASK_KEY]
        if self._switch.happened(now):
            self._evaluate(before, at_switch=True)
            self._trained_task = None  # nothing is left to evaluate if training ends before it is trained on the next
        elif self._is_due():
            self._evaluate(now)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self._trained_task = self._switch.task_id  # the task that the rollout began in

    def _on_training_end(self) -> None:
        if self._trained_task is not None:
            # The environment may have begun the next task already
            self._evaluate(self._trained_task, at_switch=first_reset_info(self.training_env)[TASK_KEY] != self._trained_task)
            self.logger.dump(self.num_timesteps)
            self._trained_task = None  # RL Zoo tells the first callback twice that training has ended
        if self._file is not None:
            self._file.close()

    def _is_due(self) -> bool:
        if self.num_timesteps == 0:
            return True
        return self.interval is not None and self.num_timesteps // self.interval > self._last_step // self.interval

    def _evaluate(self, trained_task: int, at_switch: bool = False) -> None:
        self._last_step = self.num_timesteps
        self._copy_statistics(at_switch)
        with _unchanged(self.model):
            new = self._new_rows(trained_task)
        self.rows += new
        if self._file is not None:
            self._file.append(new)
        for name, value in self._figures(trained_task).items():
            self.logger.record(name, value)

    @abstractmethod
    def _new_rows(self, trained_task: int) -> list[dict[str, float]]:
        """Evaluate, and return the rows of the CSV file."""

    @abstractmethod
    def _figures(self, trained_task: int) -> dict[str, float]:
        """What is logged of the last evaluation, which is in the rows, by its name."""

    def _copy_statistics(self, at_switch: bool) -> None:
        source, target = self.model.get_vec_normalize_env(), unwrap_vec_normalize(self.eval_env)
        if source is None or target is None or not source.norm_obs:
            return
        statistics = source.obs_rms
        if at_switch and active_signal(self.training_env) is None:
            statistics = getattr(source, "last_task_obs_rms", statistics)
        target.obs_rms = deepcopy(statistics)

    def _mean_return(self, task: int) -> float:
        """The mean return on a task."""
        self.eval_env.env_method("set_task", task)
        self.eval_env.seed(self.seed)
        returns: list[float] = []

        def collect(step: Mapping[str, Any], _: Any) -> None:
            if step["done"]:
                returns.append(step["info"]["episode_return"])
            elif step["current_lengths"][step["i"]] == LONG_EPISODE:
                warnings.warn(
                    f"{type(self).__name__}: an episode on task {task} goes on after {LONG_EPISODE} steps. If episodes do not "
                    "end by themselves, give an `eval_env` with a TimeLimit."
                )

        evaluate_policy(self.model, self.eval_env, self.n_eval_episodes, self.deterministic, callback=collect, warn=False)
        return float(np.mean(returns))


def _check_fits(eval_env: VecEnv, training_env: VecEnv) -> None:
    """Whether a model that is trained in one environment can be evaluated in the other, without touching the training."""
    if share_envs(eval_env, training_env):
        raise ValueError("`eval_env` must be another environment than that of training, got the same: make a second one")
    for kind, plural in (("observation_space", "observations"), ("action_space", "actions")):
        expected, given = getattr(training_env, kind), getattr(eval_env, kind)
        if _measures(given) != _measures(expected):
            raise ValueError(
                f"`eval_env` must have the {plural} of the training environment, {expected}, got {given}. Wrap it as the "
                "training environment"
            )
    expected, given = (_normalises(env) for env in (training_env, eval_env))
    if given != expected:
        raise ValueError(
            f"`eval_env` must be wrapped as the training environment: {'only that' if expected else 'it alone'} has a "
            "VecNormalize of observations"
        )


def _measures(space: gym.Space[Any]) -> Any:
    """What two spaces must have in common: shapes, and the numbers of discrete choices. Limits may differ."""
    if isinstance(space, spaces.Dict):
        return {key: _measures(part) for key, part in space.items()}
    return type(space), space.shape, np.asarray(getattr(space, "nvec", getattr(space, "n", 0))).tolist()


def _normalises(env: VecEnv) -> bool:
    normalize = unwrap_vec_normalize(env)
    return normalize is not None and normalize.norm_obs


def _make_eval_env(model: BaseAlgorithm) -> VecEnv:
    """An environment like that of training, wrapped as far as Stable-Baselines3 does it."""
    training_env = model.get_env()
    assert training_env is not None
    spec = training_env.get_attr("spec", indices=0)[0]
    if spec is None:
        raise ValueError("The training environment was not made by gymnasium.make(): give the callback an `eval_env`")
    lost = [wrapper.name for wrapper in spec.additional_wrappers if not _is_needless(wrapper)]
    if lost:
        raise ValueError(
            f"The training environment is wrapped in {', '.join(lost)}, which may change what the agent sees or does. Give "
            "the callback an `eval_env` with the same wrappers, or wrap each task inside the continual environment. A wrapper "
            "of rewards alone may be derived from gymnasium.RewardWrapper"
        )
    env = model._wrap_env(gym.make(replace(spec, additional_wrappers=())), verbose=0)
    normalize = model.get_vec_normalize_env()
    if normalize is None:
        return env
    return VecNormalize(
        env,
        training=False,
        norm_obs=normalize.norm_obs,
        norm_reward=False,
        clip_obs=normalize.clip_obs,
        epsilon=normalize.epsilon,
        norm_obs_keys=normalize.norm_obs_keys,
    )


def _is_needless(wrapper: WrapperSpec) -> bool:
    """Whether an evaluation is the same without a wrapper, since it counts the environment's own rewards."""
    try:
        wrapper_class = load_env_creator(wrapper.entry_point)
    except (ImportError, AttributeError):  # a class inside a function
        return False
    return isinstance(wrapper_class, type) and issubclass(wrapper_class, NEEDLESS)


@contextmanager
def _unchanged(model: BaseAlgorithm) -> Iterator[None]:
    """Leave a model as it was: random numbers and the mode of its networks."""
    was_training = model.policy.training
    actions = model.action_space.np_random.bit_generator  # of DQN's random actions
    state = deepcopy(actions.state)
    try:
        with unchanged_random_state():
            yield
    finally:
        actions.state = state
        model.policy.set_training_mode(was_training)
