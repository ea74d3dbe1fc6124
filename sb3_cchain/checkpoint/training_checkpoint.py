"""A callback that saves the whole training at intervals and when it is told to stop, and that puts it back."""

import os
import signal
import sys
import threading
import time
import warnings
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_cchain.checkpoint.checkpoint_folder import CheckpointFolder
from sb3_cchain.checkpoint.checkpoint_info import package_versions
from sb3_cchain.checkpoint.environment_processes import live_as_long_as_training
from sb3_cchain.checkpoint.environment_state import can_save_environment, prepare_environment
from sb3_cchain.checkpoint.files import sync_files
from sb3_cchain.checkpoint.log import describe_log
from sb3_cchain.checkpoint.named_code import find_named, name_in_module
from sb3_cchain.checkpoint.new_episodes import begin_new_episodes, lasting_state
from sb3_cchain.checkpoint.saved_checkpoint import Checkpoint, has_checkpoint
from sb3_cchain.checkpoint.training_description import check_same, describe_callbacks, describe_env, describe_model
from sb3_cchain.checkpoint.training_state import chunk_names, restore_training, training_parts, training_state
from sb3_cchain.tasks.callback_tree import require_single
from sb3_cchain.validation import check_bool, check_number, check_path

DIFFERENT = "Make the training as it was, or load the model as usual, which begins new episodes."
SIGNALS = (signal.SIGINT, signal.SIGTERM)
# Arguments of `learn()` that training goes on with; the last one is MaskablePPO's
LEARN_ARGUMENTS = ("log_interval", "tb_log_name", "progress_bar", "use_masking")


class _Progress(NamedTuple):
    last_saved: int
    seconds: float
    stop_signal: int | None


# How far each model has come that this process trains, by the folders of checkpoints
_progress: WeakKeyDictionary[BaseAlgorithm, dict[Path, _Progress]] = WeakKeyDictionary()


class TrainingCheckpoint(BaseCallback):
    """
    Saves all that training depends on, so that :func:`~sb3_cchain.resume` goes on from there as if nothing had happened: to
    the bit, on the CPU.

    It acts at the start of a rollout, after the updates that follow the rollout before: when ``save_freq`` more steps were
    made, and when the process is told to stop, by Ctrl-C or by SIGTERM, which SLURM sends before a job's time is over. Then it
    ends the training, by ``KeyboardInterrupt`` or, after SIGTERM, by ``SystemExit``. The rollout under way is completed and
    learned from before that. A second Ctrl-C ends the training at once; a second SIGTERM, which schedulers send, changes
    nothing. In the last rollout, the first signal changes nothing, either: ``learn()`` is complete then. A further call that
    goes on with the training stops at its start.

    With on-policy algorithms and a ``log_interval`` above 1, it waits for the end of an interval, so that the log goes on in
    the same rhythm. It waits for ``save_freq`` steps at the most, and not at all when it is told to stop.

    A training may consist of several calls of ``learn(..., reset_num_timesteps=False)`` of one model, with the same callback
    or with new ones of the same ``path``.

    Works with all algorithms of Stable-Baselines3 and sb3-contrib but ARS. The page "Stop and resume" says what is exact.

    :param save_freq: Environment steps from one checkpoint to the next
    :param path: Folder of the checkpoints. A training has a folder of its own
    :param keep: How many checkpoints stay
    :param exact: Whether environments that cannot be resumed in the middle of an episode are refused. Otherwise all
        environments begin new episodes when training is resumed
    :raises TypeError: Naming the argument that is of another type. When training starts, for ARS
    :raises ValueError: Naming the argument that is out of its range. When training starts: for environments that cannot be
        resumed exactly, a folder of another training or one that cannot be written to, a second TrainingCheckpoint, or a
        model whose class its module does not have
    """

    def __init__(self, save_freq: int, path: str | Path, keep: int = 2, exact: bool = True):
        super().__init__()
        check_number("save_freq", save_freq, 1, integer=True)
        check_number("keep", keep, 1, integer=True)
        check_bool("exact", exact)
        self.save_freq = int(save_freq)
        self.path = check_path("path", path)
        self.keep = int(keep)
        self.exact = bool(exact)
        # How to go on, as it is printed when training was told to stop
        self.advice = f'Go on from there: sb3_cchain.resume("{path}", env=...)'
        self._resumed: Checkpoint | None = None
        self._folder: CheckpointFolder | None = None
        self._last_saved = 0
        self._seconds_before = 0.0
        self._started = time.monotonic()
        self._n_rollouts = 0
        self._stop_signal: int | None = None
        self._replaced_handlers: dict[int, Any] = {}

    @classmethod
    def resume_from(cls, checkpoint: Checkpoint, path: str | Path | None = None) -> "TrainingCheckpoint":
        """
        :param checkpoint: A checkpoint
        :param path: Folder of the further checkpoints, by default the one that it is in
        :return: A callback with the former settings that goes on from the checkpoint, see :meth:`go_on_from`
        """
        settings = checkpoint.info["training_checkpoint"]
        path = checkpoint.folder if path is None else path
        callback = cls(settings["save_freq"], path, settings["keep"], settings["exact"])
        callback.go_on_from(checkpoint)
        return callback

    def go_on_from(self, checkpoint: Checkpoint) -> None:
        """
        Put the state back at the start of the first rollout of the next ``learn()``. To be called before ``learn(...,
        reset_num_timesteps=False)`` of the checkpoint's model, to which this callback is given where the former one was.

        :param checkpoint: A checkpoint
        """
        self._resumed = checkpoint

    @property
    def is_resuming(self) -> bool:
        """Whether the next or the present ``learn()`` goes on from a checkpoint, whose state has not been put back yet."""
        return self._resumed is not None

    @property
    def seconds(self) -> float:
        """Seconds that the training has taken, interruptions not counted."""
        return self._seconds_before + time.monotonic() - self._started

    def state_dict(self) -> dict[str, Any]:
        """
        :return: Its counters
        """
        return {"num_timesteps": self.num_timesteps, "n_calls": self.n_calls}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: What :meth:`state_dict` returned
        """
        self.num_timesteps, self.n_calls = state["num_timesteps"], state["n_calls"]

    def _init_callback(self) -> None:
        if self.parent is not None:
            raise ValueError(
                f"TrainingCheckpoint acts between rollouts: give it to `learn()` itself, not to {type(self.parent).__name__}"
            )
        if not isinstance(self.model, (OnPolicyAlgorithm, OffPolicyAlgorithm)):
            raise TypeError(
                f"TrainingCheckpoint is for on-policy and off-policy algorithms, got {type(self.model).__name__}, which has "
                "no rollouts"
            )
        _check_class(type(self.model))
        if self._resumed is not None:
            # Before other callbacks change hyperparameters when training starts
            check_same(self._resumed.info["model"], describe_model(self.model), DIFFERENT)

    def _on_training_start(self) -> None:
        require_single(self)
        self._release()  # what training that was ended by an error left
        self._started = time.monotonic()
        self._n_rollouts, self._stop_signal = 0, None
        self._parts = training_parts(self.model, self.locals["callback"])
        self._environment = describe_env(self.training_env)
        newest = self._begin() if self._resumed is None else self._go_on(self._resumed)
        for name, env in self._parts.envs.items():
            if self.exact:
                self._prepare(name, env)
            live_as_long_as_training(env)
        self._folder = CheckpointFolder(self.path, self.keep, newest)
        self._note_progress()
        self._listen_to_signals()

    def _begin(self) -> int | None:
        """
        :return: Step of the newest checkpoint that may be in the folder; None when there must be none
        """
        earlier = None if self.locals["reset_num_timesteps"] else _progress.get(self.model, {}).get(self.path.resolve())
        if earlier is None:
            self._last_saved, self._seconds_before = self.num_timesteps, 0.0
            return None
        # A signal in the last rollout of the call before stops this one
        self._last_saved, self._seconds_before, self._stop_signal = earlier
        return self.num_timesteps

    def _go_on(self, checkpoint: Checkpoint) -> int | None:
        """
        :param checkpoint: The checkpoint to go on from
        :return: See :meth:`_begin`
        """
        if self.locals["reset_num_timesteps"]:
            raise ValueError("Training that goes on from a checkpoint needs learn(..., reset_num_timesteps=False)")
        checkpoint.warn_of_other_versions()
        saved = checkpoint.info
        check_same(saved["environment"], self._environment, DIFFERENT)
        check_same(saved["callbacks"], describe_callbacks(self._parts.callbacks), "Give the same callbacks in the same order.")
        self._last_saved, self._seconds_before = checkpoint.num_timesteps, checkpoint.seconds
        return checkpoint.num_timesteps if checkpoint.folder.resolve() == self.path.resolve() else None

    def _note_progress(self) -> None:
        progress = _Progress(self._last_saved, self.seconds, self._stop_signal)
        _progress.setdefault(self.model, {})[self.path.resolve()] = progress

    def _prepare(self, name: str, env: VecEnv) -> None:
        try:
            prepare_environment(env)
        except ValueError as error:
            owner = self._parts.callbacks.get(name.rpartition(" ")[0])
            where = "training environment" if owner is None else f"environment of {type(owner).__name__}"
            raise ValueError(f"The {where} cannot be resumed exactly. {error}") from error

    def _on_rollout_start(self) -> None:
        if self._resumed is not None:
            checkpoint, self._resumed = self._resumed, None
            self._restore(checkpoint)
        elif self._stop_signal is not None:
            self._stop()
        elif self._is_due():
            try:
                self._save()
            except OSError as error:
                warnings.warn(
                    f"No checkpoint was saved at step {self.num_timesteps}: {error}. Training goes on, and the next rollout "
                    "tries again."
                )

    def _restore(self, checkpoint: Checkpoint) -> None:
        exact = checkpoint.info["training_checkpoint"]["exact"]
        if not exact:
            warnings.warn("All environments begin new episodes, so that training goes on, but not exactly (exact=False).")
        state = checkpoint.read_state()
        try:
            restore_training(self._parts, state, checkpoint.model_path, checkpoint.store)
        except (AttributeError, ImportError) as error:  # a class that is gone, say
            raise ValueError(
                f"{checkpoint.path} cannot be put back ({error}): perhaps callbacks or environments had other code"
            ) from error
        if not exact:
            begin_new_episodes(self.model, self._parts.envs, state["lasting"])

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self._n_rollouts += 1

    def _on_training_end(self) -> None:
        if self._stop_signal is not None:
            print("That was the last rollout: learn() is complete. A call that goes on with it stops at its start", flush=True)
        self._note_progress()
        self._release()

    def _is_due(self) -> bool:
        n_steps = self.num_timesteps - self._last_saved
        # The training loop of on-policy algorithms counts its iterations from 0 when training is resumed
        log_interval = (isinstance(self.model, OnPolicyAlgorithm) and self.locals["log_interval"]) or 1
        may_wait = self._n_rollouts % log_interval != 0
        return n_steps >= (2 * self.save_freq if may_wait else self.save_freq) and self._can_save()

    def _can_save(self) -> bool:
        return not self.exact or all(map(can_save_environment, self._parts.envs.values()))

    def _save(self) -> Path:
        assert self._folder is not None
        try:
            return self._write(self._folder)
        except OSError:
            with suppress(OSError):  # a file system that is gone
                self._folder.remove_useless_chunks()
            raise

    def _write(self, folder: CheckpointFolder) -> Path:
        state, left_out = training_state(self._parts, folder.store, with_envs=self.exact)
        if not self.exact:
            state["lasting"] = {name: lasting_state(env, left_out) for name, env in self._parts.envs.items()}
        info = {
            "versions": package_versions(),
            "num_timesteps": self.num_timesteps,
            "total_timesteps": self.model._total_timesteps,
            "seconds": self.seconds,
            "algorithm": name_in_module(type(self.model)),
            "environment": self._environment,
            "model": describe_model(self.model),
            "device": str(self.model.device),
            "callbacks": describe_callbacks(self._parts.callbacks),
            "learn": {name: self.locals[name] for name in LEARN_ARGUMENTS if name in self.locals},
            "log": describe_log(self.model),
            "training_checkpoint": {"save_freq": self.save_freq, "keep": self.keep, "exact": self.exact},
            "left_out": left_out,
            "chunks": chunk_names(state),
        }
        log_dir = getattr(self.logger, "dir", None)
        if log_dir is not None:
            sync_files(Path(log_dir))  # what comes before the checkpoint is not written again
        path = folder.write(info, self.model.save, state)
        self._last_saved = self.num_timesteps
        self._note_progress()
        return path

    def _stop(self) -> None:
        """End the training, as the signal would have."""
        saved, reason = None, "it is in an episode whose beginning was not recorded"
        if self._can_save():
            try:
                saved = self._save()
            except OSError as error:
                reason = str(error)
        self._release()
        stopped = f"Training was stopped at step {self.num_timesteps}"
        if saved is not None:
            print(f"{stopped} and saved to {saved}. {self.advice}", flush=True)
        elif has_checkpoint(self.path):
            print(
                f"{stopped} and not saved: {reason}. The last checkpoint is of step {self._last_saved}. {self.advice}",
                flush=True,
            )
        else:
            print(f"{stopped} and not saved: {reason}. There is no checkpoint", flush=True)
        number, self._stop_signal = self._stop_signal, None
        self._note_progress()
        if number == signal.SIGTERM:
            sys.exit(128 + signal.SIGTERM)
        raise KeyboardInterrupt

    def _listen_to_signals(self) -> None:
        if threading.current_thread() is threading.main_thread():  # Python allows it nowhere else
            # What is ignored stays ignored, such as Ctrl-C of a job in the background of a shell script
            heeded = [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
            self._replaced_handlers = {number: signal.signal(number, self._on_signal) for number in heeded}

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if _is_learning(self.model, frame):
            if self._stop_signal is None:
                self._stop_signal = number
                print("Stopping when this rollout has been learned from and saved. Stop at once: Ctrl-C again", flush=True)
                return
            if number == signal.SIGTERM:  # a job may get it several times, from the scheduler and from its own script
                return
        # Where the former handler lets training go on, it is still stopped after this rollout
        self._restore_handlers()
        os.kill(os.getpid(), number)

    def _restore_handlers(self) -> None:
        for number, handler in self._replaced_handlers.items():
            signal.signal(number, handler)
        self._replaced_handlers = {}

    def _release(self) -> None:
        self._restore_handlers()
        if self._folder is not None:
            self._folder.close()
            self._folder = None


def _check_class(algorithm: type[BaseAlgorithm]) -> None:
    try:
        find_named(name_in_module(algorithm))
    except (AttributeError, ImportError) as error:
        raise ValueError(
            f"Training of {algorithm.__qualname__} could not be resumed, because there is no such class in its module "
            f"{algorithm.__module__}: define it at the top level of the module"
        ) from error


def _is_learning(model: BaseAlgorithm, frame: FrameType | None) -> bool:
    """Whether a frame is within the model's ``learn()``: SB3 does not tell callbacks when an error ends it."""
    while frame is not None:
        if frame.f_code.co_name == "learn" and frame.f_locals.get("self") is model:
            return True
        frame = frame.f_back
    return False
