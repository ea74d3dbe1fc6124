"""Going on with training that was saved by a TrainingCheckpoint."""

from pathlib import Path

import gymnasium as gym
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm, maybe_make_env
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_cchain.checkpoint.log import further_logger
from sb3_cchain.checkpoint.named_code import find_named
from sb3_cchain.checkpoint.saved_checkpoint import Checkpoint, find_checkpoint
from sb3_cchain.checkpoint.training_checkpoint import TrainingCheckpoint
from sb3_cchain.tasks.callback_tree import as_list, iterate_callbacks
from sb3_cchain.validation import check_number


def resume(
    path: str | Path,
    env: GymEnv | str,
    callback: MaybeCallback = None,
    *,
    total_timesteps: int | None = None,
    logger: Logger | None = None,
    device: th.device | str = "auto",
) -> BaseAlgorithm:
    """
    Go on with training that a :class:`~sb3_cchain.TrainingCheckpoint` saved, up to the number of steps that it was to have.
    On the CPU it is the same as if it had not been interrupted, to the bit.

    The model, its class and its hyperparameters come from the checkpoint. The environment and the callbacks are made as before
    the interruption; their state comes from the checkpoint. Further checkpoints go to the same folder.

    :param path: A checkpoint, or the folder of checkpoints, whose newest whole one is taken
    :param env: The environment, made as before, or its id
    :param callback: The callbacks that were given to ``learn()``, made as before and in the same order. The former
        TrainingCheckpoint may be left out where it was the last
    :param total_timesteps: Environment steps at which training ends, those before the interruption included; by default as
        before
    :param logger: The logger. By default the model logs to the same folder in the same formats. Files that SB3 would overwrite
        are new ones, such as ``progress_from_step_50000.csv``
    :param device: PyTorch device, which must be that of the training; ``"auto"`` takes it
    :return: The trained model
    :raises ValueError: When there is no whole checkpoint, when the training was at its end already, or naming what differs
        from the training that was saved
    """
    if env is None or (callable(env) and not isinstance(env, (gym.Env, VecEnv))):
        raise ValueError(f"`env` must be an environment, a vectorised environment or an environment id, got {env!r}")
    if total_timesteps is not None:
        check_number("total_timesteps", total_timesteps, 1, integer=True)
    checkpoint = find_checkpoint(path)
    remaining = (checkpoint.total_timesteps if total_timesteps is None else total_timesteps) - checkpoint.num_timesteps
    if remaining <= 0:
        raise ValueError(
            f"`total_timesteps` must be more than {checkpoint.num_timesteps}, the steps that the model in {checkpoint.path} "
            f"was trained for; got {total_timesteps or checkpoint.total_timesteps}"
        )
    device = checkpoint.device(device)
    made = maybe_make_env(env, verbose=0)
    assert made is not None
    model = load_model(checkpoint, made, device)
    if logger is None:
        logger = further_logger(checkpoint.info["log"], checkpoint.num_timesteps)
    if logger is not None:
        model.set_logger(logger)
    callbacks = with_checkpoint(as_list(callback), checkpoint)
    model.learn(remaining, callbacks, reset_num_timesteps=False, **checkpoint.info["learn"])
    return model


def load_model(checkpoint: Checkpoint, env: GymEnv, device: th.device | str = "auto") -> BaseAlgorithm:
    """
    :param checkpoint: A checkpoint
    :param env: The environment to go on in
    :param device: PyTorch device, as in :func:`resume`
    :return: The model, as Stable-Baselines3 loads it
    :raises ValueError: When the installed NumPy cannot read it, or it was trained on another device
    """
    checkpoint.check_numpy()
    algorithm: type[BaseAlgorithm] = find_named(checkpoint.info["algorithm"])
    return algorithm.load(checkpoint.model_path, env, checkpoint.device(device))


def with_checkpoint(given: list[BaseCallback], checkpoint: Checkpoint) -> list[BaseCallback]:
    """
    :param given: Callbacks of ``learn()``
    :param checkpoint: The checkpoint to go on from
    :return: The same, with a TrainingCheckpoint that goes on from it: the one among them, or a new one at their end
    """
    for found in iterate_callbacks(CallbackList(given)):
        if isinstance(found, TrainingCheckpoint):
            found.go_on_from(checkpoint)
            return given
    return [*given, TrainingCheckpoint.resume_from(checkpoint)]
