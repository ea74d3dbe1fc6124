"""RL Zoo's training, with run folders that are never shared, saves that a kill does not tear, and training that goes on."""

import shutil
import signal
import sys
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from copy import copy
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import optuna
import rl_zoo3.callbacks
import rl_zoo3.exp_manager
import yaml
from rl_zoo3.utils import get_latest_run_id
from sb3_contrib import TQC
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, unwrap_vec_normalize

from sb3_cchain.callbacks import TaskProgressBar
from sb3_cchain.checkpoint import (
    SafeCheckpointCallback,
    SaveBestModel,
    check_model_file,
    load_statistics,
    save_model,
    saved_timesteps,
    write_safely,
)
from sb3_cchain.checkpoint.model_files import save_statistics
from sb3_cchain.checkpoint.resumable_env import ResumableEnv
from sb3_cchain.checkpoint.saved_checkpoint import Checkpoint
from sb3_cchain.checkpoint.training_checkpoint import TrainingCheckpoint
from sb3_cchain.envs import TaskVecNormalize
from sb3_cchain.methods.registry import BY_ALGO
from sb3_cchain.replaced import replaced
from sb3_cchain.zoo.checkpoint_options import CHECKPOINTS, RESUMED_FROM, CheckpointOptions, write_resumed_from
from sb3_cchain.zoo.search import add_to_callback, add_to_policy_kwargs, search_churn_target, suggest_from_grid
from sb3_cchain.zoo.settings import missing_parts, read_saved, settings_path, what_cannot_be_read
from sb3_cchain.zoo.statistics import BEST_STATISTICS, statistics_path
from sb3_cchain.zoo.summary import TrainingSummary
from sb3_cchain.zoo.training_record import differences, plain, write_record


class ExperimentManager(rl_zoo3.exp_manager.ExperimentManager):
    """
    RL Zoo's ``ExperimentManager``, with these differences:

    - Each training has folders of its own, for RL Zoo's files and for TensorBoard, even if several start at once.
    - ``normalize`` in a YAML file is :class:`~sb3_cchain.envs.TaskVecNormalize`, which restarts at each task (with
      ``restart=False`` in it, it does not). Where there are no tasks it is Stable-Baselines3's ``VecNormalize``.
    - Checkpoints, the best and the final model are whole or absent. They come with the statistics of ``VecNormalize``.
    - Training from a saved model (``-i``) goes on at its step, its task and its statistics.
    - Training with checkpoints (``--checkpoint-freq``) goes on exactly (``--resume``).
    - The progress bar (``-P``) shows the tasks, and training ends with a summary.
    - ``-optimize`` searches the grids of the related methods.

    :param args: Arguments of RL Zoo's
    :param checkpoints: The options on checkpoints, None without checkpoints
    :param kwargs: Keyword arguments of RL Zoo's
    """

    def __init__(self, *args: Any, checkpoints: CheckpointOptions | None = None, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.checkpoints = checkpoints
        self.resumed = None if checkpoints is None else checkpoints.checkpoint
        if self.resumed is not None:
            self.trained_agent = str(self.resumed.model_path)
            self.continue_training = True
        self._was_interrupted = False

    @property
    def checkpoint_folder(self) -> Path:
        """Folder of the checkpoints."""
        return Path(self.save_path) / CHECKPOINTS

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """
        :return: The hyperparameters, twice: for use and as they are saved
        :raises SystemExit: When ``--trial-id`` is given without the study
        """
        if self.trial_id is not None:
            if not (self.storage and self.study_name):
                sys.exit(f"--trial-id {self.trial_id} is a trial of a study: give its --storage and --study-name, too")
            if self.trial_id == 0:  # RL Zoo takes it for none
                values = self.load_trial(self.storage, self.study_name, trial_id=0)
                self.custom_hyperparams = {**values, **(self.custom_hyperparams or {})}
        try:
            hyperparams, saved = super().read_hyperparameters()
        except KeyError as error:
            if error.args != ("atari",):
                raise
            # For Atari games RL Zoo asks for a section `atari`. A file without one has `default` for them, too
            self._is_atari = False
            hyperparams, saved = super().read_hyperparameters()
        self._hyperparameters_read = plain(saved)  # what follows changes parts of them in place
        return hyperparams, saved

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> tuple[Any, ...]:
        processed = super()._preprocess_hyperparams(hyperparams)
        hyperparams, _, callbacks, _ = processed
        method = BY_ALGO.get(self.algo)
        if method is not None and (missing := missing_parts(method, hyperparams, callbacks)):
            replaced_parts = {"policy", "policy_kwargs", "callback"} & set(self.custom_hyperparams or ())
            by = f"-params replaces the whole of {' and '.join(sorted(replaced_parts))}. " if replaced_parts else ""
            sys.exit(
                f"{self.algo}: the settings of {self.env_name.gym_id} in {self.config} lack {' and '.join(missing)}, without "
                f"which they are not those of the method. {by}{settings_path(self.algo)} shows how to name it"
            )
        return processed

    def load_trial(self, storage: str, study_name: str, trial_id: int | None = None, convert: bool = True) -> dict[str, Any]:
        """
        :param storage: Where the study is
        :param study_name: Name of the study
        :param trial_id: The trial, counted from 0; None for the best one
        :param convert: Whether its values become hyperparameters of the algorithm
        :return: Its hyperparameters
        :raises SystemExit: When there is no such study or trial, or the trial has no values
        """
        try:
            return super().load_trial(storage, study_name, trial_id, convert)
        except (IndexError, KeyError):
            sys.exit(f"--trial-id {trial_id}: the study {study_name} in {storage} has no such trial with values")

    def create_log_folder(self) -> None:
        """
        Make the folder of this training.

        :raises ValueError: When training is to go on from a file that is no whole model, that lacks its statistics, or that
            was trained to the end
        :raises SystemExit: When training is to go on from a checkpoint of another training, or from one that is at its end
        """
        if self.resumed is not None:
            self._check_resumed(self.resumed)
        elif self.continue_training:
            self._check_trained_agent()
        if not self.args.uuid:
            self.save_path = str(make_run_folder(self.log_path, self.env_name))
            self.params_path = f"{self.save_path}/{self.env_name}"
        super().create_log_folder()
        if self.checkpoints is not None:
            freq, keep = self.checkpoints.freq, self.checkpoints.keep
            write_record(self.checkpoint_folder, freq, keep, self.args, self._hyperparameters_read)
        if self.resumed is not None:
            write_resumed_from(Path(self.save_path), self.resumed.path)
            self._copy_best(self.resumed.folder.parent)

    def _check_resumed(self, checkpoint: Checkpoint) -> None:
        assert self.checkpoints is not None
        if differing := differences(self.checkpoints.record, self.args, self._hyperparameters_read):
            sys.exit(f"--resume: the training in {checkpoint.path} had {'; '.join(differing)}. Give the options that it had")
        try:
            self.device = checkpoint.device(self.device)
        except ValueError as error:
            sys.exit(f"--resume: {error}")
        given = self.checkpoints.resume
        # A run that went on from the checkpoint may be finished without one of its own
        run = given if given is not None and (given / RESUMED_FROM).is_file() else checkpoint.folder.parent
        done, final = checkpoint.num_timesteps, run / f"{self.env_name}.zip"
        # One who names a checkpoint wants to go on from there in any case
        if checkpoint.path != given and final.is_file():
            done = saved_timesteps(final)
        if done >= self.n_timesteps:
            print(
                f"The training in {run} is finished: it made {done} of {self.n_timesteps} steps. "
                "A greater number of steps makes it longer: -n STEPS"
            )
            sys.exit(0)
        self.n_timesteps -= checkpoint.num_timesteps

    def _copy_best(self, folder: Path) -> None:
        """
        Copy what evaluations have left in the run folder that training goes on from. What is of later evaluations than the
        checkpoint will come again.
        """
        best = folder / "best_model.zip"
        for path in (folder / "evaluations.npz", best):
            _copy_if_there(path, f"{self.save_path}/{path.name}")
        if best.is_file():
            _copy_if_there(statistics_path(best, self.env_name), f"{self.params_path}/vecnormalize.pkl")

    def _check_trained_agent(self) -> None:
        check_model_file(self.trained_agent)
        if self.normalize:
            self._find_statistics()
        if self.args.n_timesteps <= 0:  # not given: train up to the number of the settings
            done = saved_timesteps(self.trained_agent)
            if done >= self.n_timesteps:
                raise ValueError(
                    f"{self.trained_agent} was trained for {done} steps, and the settings have {self.n_timesteps}. "
                    "Say how many more are to come: -n STEPS"
                )
            self.n_timesteps -= done

    def _find_statistics(self) -> Path:
        """The file with the statistics of ``VecNormalize`` that belong to the saved model."""
        path = statistics_path(self.trained_agent, self.env_name)
        if not path.is_file():
            raise ValueError(
                f"Training with normalisation goes on from {self.trained_agent} with the statistics that were saved with it, "
                f"but there is no file {path}"
            )
        return path

    def _save_config(self, saved_hyperparams: dict[str, Any]) -> None:
        super()._save_config(saved_hyperparams)
        try:
            read_saved(Path(self.params_path) / "config.yml")
        except yaml.constructor.ConstructorError as error:
            warnings.warn(f"enjoy and record_video will not play this model: {what_cannot_be_read(error)}", stacklevel=2)

    def create_callbacks(self) -> None:
        """Make the callbacks of the command line's options."""
        checkpoint_callback = partial(SafeCheckpointCallback, save_vecnormalize=True)
        n_given = len(self.callbacks)
        with (
            replaced(rl_zoo3.exp_manager, "CheckpointCallback", checkpoint_callback),
            replaced(rl_zoo3.exp_manager, "ProgressBarCallback", TaskProgressBar),
        ):
            super().create_callbacks()
        for callback in self.callbacks[n_given:]:
            if isinstance(callback, EvalCallback):
                callback.best_model_save_path = None
                callback.callback_on_new_best = SaveBestModel(
                    f"{self.save_path}/best_model.zip", f"{self.params_path}/vecnormalize.pkl"
                )
                callback.callback_on_new_best.parent = callback
        if self.checkpoints is not None:
            self.callbacks.append(self._make_checkpoint_callback(self.checkpoints))

    def _make_checkpoint_callback(self, options: CheckpointOptions) -> TrainingCheckpoint:
        assert options.freq is not None and options.keep is not None
        callback = TrainingCheckpoint(options.freq, self.checkpoint_folder, options.keep, options.exact)
        callback.advice = ""  # the summary says how to go on
        if self.resumed is not None:
            callback.go_on_from(self.resumed)
        return callback

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """
        Make the environments. With checkpoints that are exact, those in processes of their own are made resumable.

        :param n_envs: Number of environments
        :param eval_env: Whether they are for evaluation
        :param no_log: Whether episodes are logged nowhere
        :return: The vectorised environment
        """
        wrapper = self.env_wrapper
        if self.checkpoints is not None and self.checkpoints.exact and self.vec_env_class is SubprocVecEnv:
            wrapper = partial(_resumable, wrapper)
        with replaced(self, "env_wrapper", wrapper):
            return super().create_envs(n_envs, eval_env, no_log)

    def _maybe_normalize(self, env: VecEnv, eval_env: bool) -> VecEnv:
        if not self.normalize:
            return env
        evaluation = {"training": False, "norm_reward": False} if eval_env else {}
        return TaskVecNormalize(env, **{**self.normalize_kwargs, **evaluation})

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        if self.resumed is not None:
            # The rest, statistics and replay buffer included, is put back when training starts
            kept = {name: value for name, value in hyperparams.items() if name not in ("policy", "policy_kwargs")}
            for name in ("seed", "tensorboard_log", "verbose", "device"):
                kept[name] = getattr(self, name)
            return rl_zoo3.ALGOS[self.algo].load(self.trained_agent, env=env, **kept)
        normalize = unwrap_vec_normalize(env)
        if normalize is not None:
            load_statistics(normalize, self._find_statistics())
        elif (path := statistics_path(self.trained_agent, self.env_name)).is_file():
            raise ValueError(f"{self.trained_agent} was trained with normalisation ({path}): keep `normalize` in the settings")
        return super()._load_pretrained_agent(hyperparams, env)

    def learn(self, model: BaseAlgorithm) -> None:
        """
        Train a model. One that was loaded goes on counting its steps.

        :param model: The model
        :raises SystemExit: With checkpoints, when training was stopped by SIGTERM
        """
        if self.tensorboard_log is not None:
            folder = make_run_folder(self.tensorboard_log, type(model).__name__)
            model.set_logger(configure(str(folder), ["stdout", "tensorboard"] if self.verbose > 0 else ["tensorboard"]))
        go_on = None if self.checkpoints is None else self.checkpoints.resume_command(Path(self.save_path))
        self._summary = TrainingSummary(model, self.args, Path(self.save_path), self.env_name, go_on)
        # RL Zoo's method has no place for `reset_num_timesteps`
        learn = partial(model.learn, reset_num_timesteps=False) if self.continue_training else model.learn

        def learn_and_tell(*args: Any, **kwargs: Any) -> None:
            try:
                learn(*args, **kwargs)
            except KeyboardInterrupt:  # which RL Zoo takes for the end
                self._was_interrupted = True
                raise
            finally:
                for callback in self.callbacks:
                    if isinstance(callback, TaskProgressBar):
                        callback.close()  # at once, before what follows is printed

        # RL Zoo's ParallelTrainCallback trains a copy, which it would load as a plain SAC or TQC
        base = next((base for base in (SAC, TQC) if isinstance(model, base)), None)
        try:
            with nullcontext() if base is None else replaced(rl_zoo3.callbacks, base.__name__, type(model)):
                super().learn(SimpleNamespace(learn=learn_and_tell, env=model.env, policy=model.policy))  # type: ignore[arg-type]
        except SystemExit:  # by SIGTERM, with checkpoints: no model is saved
            self._summary.print()
            raise

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """
        Save the model, the statistics of its ``VecNormalize`` if there is one, and its replay buffer if asked for. Then print
        the summary of the training.

        :param model: The model
        :raises SystemExit: With checkpoints, when training was interrupted by Ctrl-C
        """
        print(f"Saving to {self.save_path}")
        statistics = f"{self.params_path}/vecnormalize.pkl"
        _copy_if_there(Path(statistics), f"{self.save_path}/{BEST_STATISTICS}")  # until now those of the best model
        save_statistics(model, statistics)
        if isinstance(model, OffPolicyAlgorithm) and self.save_replay_buffer:
            print("Saving replay buffer")
            with write_safely(f"{self.save_path}/replay_buffer.pkl") as path:
                model.save_replay_buffer(path)
        save_model(model, f"{self.save_path}/{self.env_name}.zip")
        self._summary.print()
        if self._was_interrupted and self.checkpoints is not None:
            sys.exit(128 + signal.SIGINT)

    def hyperparameters_optimization(self) -> None:
        """Search the hyperparameters, and the β of what is held still."""
        search_churn_target(self.algo, self._hyperparams.get("churn_target", "auto"))
        super().hyperparameters_optimization()

    def objective(self, trial: optuna.Trial) -> float:
        """
        Train with the values of a trial. Those of the related methods stand within ``policy_kwargs`` and ``callback`` of the
        settings, the first of which RL Zoo's samplers replace as a whole, and the second not at all.

        :param trial: Optuna's trial
        :return: Mean reward of the last evaluation
        :raises ValueError: When arguments of a callback are to be searched that is not in the settings
        """
        manager = copy(self)  # trials may run side by side
        method = BY_ALGO.get(self.algo)
        if method is not None and method.grid:
            values = suggest_from_grid(trial, method)
            if method.optimizer_class is not None:
                manager._hyperparams = add_to_policy_kwargs(self._hyperparams, values)
            else:
                manager.specified_callbacks = add_to_callback(self.specified_callbacks, method.callbacks[0], values)
        return super(ExperimentManager, manager).objective(trial)


def _copy_if_there(source: Path, target: str) -> None:
    if source.is_file():
        with write_safely(target) as path:
            shutil.copyfile(source, path)


def _resumable(wrapper: Callable[[gym.Env], gym.Env] | None, env: gym.Env) -> ResumableEnv:
    """An environment with the settings' wrapper, and outside of it what makes it resumable."""
    return ResumableEnv(env if wrapper is None else wrapper(env))


def make_run_folder(parent: str | Path, name: str) -> Path:
    """
    Make the next of the folders ``name_1``, ``name_2`` and so on. No two calls get the same, not even in two processes.

    :param parent: Folder to make it in
    :param name: Name without its number
    :return: The new folder
    """
    number = get_latest_run_id(str(parent), name) + 1  # pyright: ignore[reportArgumentType]
    while True:
        folder = Path(parent) / f"{name}_{number}"
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:  # made by another process since
            number += 1
