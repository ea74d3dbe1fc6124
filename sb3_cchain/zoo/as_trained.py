"""Loads a saved model with the environment and the callbacks that RL Zoo trained it with."""

import pickle
from pathlib import Path
from typing import Any

from rl_zoo3 import ALGOS
from rl_zoo3.callbacks import SaveVecNormalizeCallback
from rl_zoo3.utils import create_test_env, get_callback_list, get_saved_hyperparams
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.utils import is_masking_supported
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_cchain.analysis.saved_algorithm import algorithm_of
from sb3_cchain.checkpoint import check_model_file, load_statistics
from sb3_cchain.checkpoint.checkpoint_info import MODEL
from sb3_cchain.zoo.checkpoint_options import CHECKPOINTS
from sb3_cchain.zoo.settings import read_saved
from sb3_cchain.zoo.statistics import statistics_beside


def make_as_trained(
    model_path: Path, env_id: str, n_envs: int, seed: int, env_kwargs: dict[str, Any], statistics: Path | None
) -> tuple[VecEnv, list[BaseCallback]]:
    """
    Make what RL Zoo trained a model with: the environment with its arguments, wrappers and normalisation, and the callbacks of
    its settings. For a model that is in no folder of RL Zoo's, that is the environment as it is.

    :param model_path: The saved model
    :param env_id: Environment id
    :param n_envs: Number of environments
    :param seed: Seed
    :param env_kwargs: Arguments of the environment, besides those it was trained with
    :param statistics: What ``VecNormalize.save()`` wrote, if not the file beside the model
    :return: The environment, as in training, and the callbacks
    :raises ValueError: When the YAML files beside the model are not as RL Zoo writes them, or the statistics are missing or of
        another kind
    """
    env_name = env_id.replace("/", "-")
    # A checkpoint of training that goes on exactly is deeper in the run folder
    is_deep = model_path.name == MODEL and model_path.parent.parent.name == CHECKPOINTS
    folder = (model_path.parents[2] if is_deep else model_path.parent) / env_name
    settings, options = (read_saved(folder / name).get("env_kwargs") for name in ("config.yml", "args.yml"))
    env_kwargs = {**(settings or {}), **(options or {}), **env_kwargs}
    hyperparams, stats_path = get_saved_hyperparams(str(folder), norm_reward=True)
    norm_reward = hyperparams.get("normalize_kwargs", {}).get("norm_reward", True)
    # RL Zoo's own callback that writes files; inspect_model() leaves out those of SB3 and of this package
    callbacks = [each for each in get_callback_list(hyperparams) if not isinstance(each, SaveVecNormalizeCallback)]
    env = create_test_env(
        env_id,
        n_envs,
        stats_path,
        seed,
        should_render=False,
        hyperparams=hyperparams,
        env_kwargs=env_kwargs,
        vec_env_cls=DummyVecEnv,
    )
    normalize = unwrap_vec_normalize(env)
    if normalize is None:
        return (env if statistics is None else VecNormalize.load(str(statistics), env)), callbacks
    normalize.training, normalize.norm_reward = True, norm_reward
    if statistics is None and is_deep:
        raise ValueError(
            "it was trained with normalisation, and its statistics are within the checkpoint: give a file of them as "
            "--vec-normalize"
        )
    statistics = statistics or statistics_beside(model_path)
    if statistics is not None and statistics.is_file():
        load_statistics(normalize, statistics)  # instead of those of the end of training
    return env, callbacks


def load_as_trained(
    path: Path,
    algo: str | None,
    env_id: str,
    env_kwargs: dict[str, Any],
    seed: int,
    n_steps: int,
    device: str,
    statistics: Path | None = None,
) -> tuple[BaseAlgorithm, list[BaseCallback]]:
    """
    Load a model with the environment that it was trained in.

    :param path: The saved model
    :param algo: Name of its algorithm on the command line; if None, the file tells
    :param env_id: Environment id
    :param env_kwargs: Arguments of the environment, besides those it was trained with
    :param seed: Seed of the environment
    :param n_steps: Size of the replay buffer, for off-policy algorithms
    :param device: PyTorch device
    :param statistics: What ``VecNormalize.save()`` wrote, if not the file beside the model
    :return: The model, and the callbacks of its settings
    :raises ValueError: When the file is no whole model or one of another algorithm, or the statistics cannot be read
    """
    check_model_file(path)
    try:
        data, *_ = load_from_zip_file(path, device="cpu", load_data=True)
    except Exception as error:  # whatever reading pickles raises
        raise ValueError(f"it cannot be read: {error!r}") from error
    assert data is not None
    algorithm = ALGOS[algo] if algo else algorithm_of(path)
    if algo:
        check_algorithm(path, data, algo)
    if statistics is not None:
        try:
            pickle.loads(statistics.read_bytes())
        except Exception as error:  # whatever reading a pickle raises
            raise ValueError(f"--vec-normalize {statistics} cannot be read: {error!r}") from error
    env, callbacks = make_as_trained(path, env_id, data.get("n_envs", 1), seed, env_kwargs, statistics)
    settings: dict[str, Any] = {"buffer_size": n_steps} if issubclass(algorithm, OffPolicyAlgorithm) else {}
    try:
        model = algorithm.load(path, env, device=device, **settings)
    except (AssertionError, AttributeError, KeyError, RuntimeError) as error:
        # A file of another algorithm or version lacks something
        raise ValueError(
            f"it cannot be loaded as {algorithm.__name__}: {error!r}. Give the --algo that it was saved by"
        ) from error
    if isinstance(model, MaskablePPO) and not is_masking_supported(env):
        raise ValueError("its algorithm is MaskablePPO, but the environment has no method `action_masks`")
    return model, callbacks


def check_algorithm(path: Path, data: dict[str, Any], algo: str) -> None:
    """
    :param path: A saved model
    :param data: Its attributes
    :param algo: Name of an algorithm on the command line
    :raises ValueError: When the model was saved by another one
    """
    algorithm = ALGOS[algo]
    policies = tuple(algorithm.policy_aliases.values())
    if not issubclass(data["policy_class"], policies):
        raise ValueError(
            f"it was not saved by {algorithm.__name__} (its policy is a {data['policy_class'].__name__}): --algo {algo}"
        )
    try:
        saved_by = algorithm_of(path)
    except ValueError:
        return  # it cannot be told
    if not (issubclass(saved_by, algorithm) or issubclass(algorithm, saved_by)):
        raise ValueError(f"it was saved by {saved_by.__name__}, not by {algorithm.__name__}: leave out --algo {algo}")
