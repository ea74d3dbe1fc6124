"""The command ``sb3-cchain inspect``."""

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch as th
import yaml
from rich.console import Console
from rl_zoo3 import ALGOS
from rl_zoo3.utils import StoreDict, create_test_env, get_callback_list, get_saved_hyperparams
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, unwrap_vec_normalize

from sb3_cchain.analysis.inspection import algorithm_of, inspect_model, plot, report
from sb3_cchain.checkpoint import check_model_file, check_writable
from sb3_cchain.zoo.settings import read_saved


def make_as_trained(
    model_path: Path, env_id: str, n_envs: int, seed: int, env_kwargs: dict[str, Any]
) -> tuple[VecEnv, list[BaseCallback]]:
    """
    Make what RL Zoo trained a model with: the environment with its arguments, wrappers and normalisation, and the callbacks of
    its settings. For a model that is in no folder of RL Zoo's, that is the environment as it is.

    :param model_path: The saved model
    :param env_id: Environment id
    :param n_envs: Number of environments
    :param seed: Seed
    :param env_kwargs: Arguments of the environment, besides those it was trained with
    :return: The environment, as in training, and the callbacks
    :raises ValueError: When the YAML files beside the model are not as RL Zoo writes them
    """
    folder = model_path.parent / env_id.replace("/", "-")
    env_kwargs = {**(read_saved(folder / "args.yml").get("env_kwargs") or {}), **env_kwargs}
    read_saved(folder / "config.yml")  # for its errors
    hyperparams, stats_path = get_saved_hyperparams(str(folder), norm_reward=True)
    norm_reward = hyperparams.get("normalize_kwargs", {}).get("norm_reward", True)
    callbacks = get_callback_list(hyperparams)
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
    if normalize is not None:
        normalize.training, normalize.norm_reward = True, norm_reward
    return env, callbacks


def known_algorithms() -> dict[str, type[BaseAlgorithm]]:
    """
    :return: By name on the command line, the algorithms of which everything in the report can be measured
    """
    return {
        name: algorithm
        for name, algorithm in ALGOS.items()
        if (issubclass(algorithm, (OnPolicyAlgorithm, DQN)) or name == "qrdqn") and name != "ppo_lstm"
    }


def load_as_trained(
    path: Path, algo: str | None, env_id: str, env_kwargs: dict[str, Any], seed: int, n_steps: int, device: str
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
    :return: The model, and the callbacks of its settings
    :raises ValueError: When the file is no whole model or one of another algorithm, or parameters are not finite
    """
    check_model_file(path)
    algorithm = known_algorithms()[algo] if algo else algorithm_of(path)
    data, *_ = load_from_zip_file(path, device="cpu", load_data=True)
    assert data is not None
    if algo:
        check_algorithm(path, data, algo)
    env, callbacks = make_as_trained(path, env_id, data.get("n_envs", 1), seed, env_kwargs)
    settings: dict[str, Any] = {"buffer_size": n_steps} if issubclass(algorithm, OffPolicyAlgorithm) else {}
    try:
        model = algorithm.load(path, env, device=device, **settings)
    except (AssertionError, AttributeError, KeyError, RuntimeError) as error:
        # A file of another algorithm or version lacks something
        raise ValueError(
            f"it cannot be loaded as {algorithm.__name__}: {error!r}. Give the --algo that it was saved by"
        ) from error
    for name, parameter in model.policy.named_parameters():
        if not th.isfinite(parameter).all():
            raise ValueError(
                f"its parameter {name} has entries that are not finite: nothing can be measured in such a network"
            )
    return model, callbacks


def check_algorithm(path: Path, data: dict[str, Any], algo: str) -> None:
    """
    :param path: A saved model
    :param data: Its attributes
    :param algo: Name of an algorithm on the command line
    :raises ValueError: When the model was saved by another one
    """
    algorithm = known_algorithms()[algo]
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


def main(arguments: Sequence[str]) -> None:
    """
    :param arguments: Of the command line, after ``inspect``
    """
    parser = argparse.ArgumentParser(
        prog="sb3-cchain inspect",
        description="Roll out saved models, train them a little, and report their churn, their neural tangent kernel and the "
        "health of their networks. The files are not changed.",
    )
    parser.add_argument("models", nargs="+", type=Path, metavar="MODEL.zip", help="One saved model, or two to compare")
    parser.add_argument("--env", required=True, help="Environment id")
    parser.add_argument(
        "--env-kwargs",
        nargs="+",
        action=StoreDict,
        default={},
        metavar="NAME:VALUE",
        help="Arguments of the environment, besides those that RL Zoo trained with",
    )
    parser.add_argument(
        "--task", type=int, help="Task of a continual environment, by default the one that training would go on with"
    )
    parser.add_argument("--algo", choices=sorted(known_algorithms()), help="Algorithm, by default the one that the file tells")
    parser.add_argument(
        "--n-steps", type=int, default=2048, help="Environment steps of a DQN's rollout; PPO has its `n_steps`"
    )
    parser.add_argument("--n-updates", type=int, default=100, help="Gradient updates of a DQN whose churn is measured")
    parser.add_argument("--seed", type=int, default=0, help="Seed of rollout and updates")
    parser.add_argument("--device", default="auto", help="PyTorch device")
    parser.add_argument("--output", type=Path, default=Path("inspection"), help="Folder for the picture and the numbers")
    args = parser.parse_args(arguments)
    if len(args.models) > 2:
        parser.error(f"one model, or two to compare; got {len(args.models)}")
    for option, number in (("--n-steps", args.n_steps), ("--n-updates", args.n_updates)):
        if number < 1:
            parser.error(f"{option} must be at least 1; got {number}")
    for path in args.models:
        if not path.is_file():
            parser.error(f"no such file: {path}")
    try:
        check_writable(args.output)
    except OSError as error:
        parser.error(f"--output {args.output}: {error.strerror}. Give a folder that can be written to")

    env_kwargs = args.env_kwargs
    if args.task is not None:  # and long enough to stay there, however long the model was trained
        env_kwargs = {**env_kwargs, "first_task": args.task, "steps_per_task": 10**9}
    names = ["A", "B"] if len(args.models) == 2 else [args.models[0].stem]
    console = Console()
    inspections = []
    for name, path in zip(names, args.models, strict=True):
        try:
            model, callbacks = load_as_trained(path, args.algo, args.env, env_kwargs, args.seed, args.n_steps, args.device)
        except (
            *(TypeError, ValueError, yaml.YAMLError, gym.error.Error),
            # Of settings that name what is not there
            *(AttributeError, ImportError, NameError, SyntaxError),
        ) as error:
            message = " ".join(str(error).split())  # in one line
            parser.error(f"{path} in {args.env} {env_kwargs or ''}: {message}")
        if model.lr_schedule(model._current_progress_remaining) == 0:
            console.print(f"{name} was saved when its learning rate had come down to 0: its updates change nothing.")
        model.set_random_seed(args.seed)
        console.print(f"{name}: {path}, {type(model).__name__}, {model.num_timesteps} steps of training", soft_wrap=True)
        inspections.append(inspect_model(model, name, args.n_steps, args.n_updates, callbacks))
        assert model.env is not None
        model.env.close()
    for table in report(inspections):
        console.print(table)
    figures = [
        # JSON has neither infinity nor NaN
        {"model": str(path), **{tag: value if math.isfinite(value) else None for tag, value in inspection.figures.items()}}
        for path, inspection in zip(args.models, inspections, strict=True)
    ]
    try:
        plot(inspections, args.output / "inspection.png")
        (args.output / "inspection.json").write_text(json.dumps(figures, indent=1))
    except OSError as error:
        parser.error(f"--output {args.output}: {error.strerror}")
    console.print(f"Written: {args.output}/inspection.png, {args.output}/inspection.json", soft_wrap=True)
