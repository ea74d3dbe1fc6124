"""The command ``sb3-cchain inspect``."""

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
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


def make_as_trained(
    model_path: Path, env_id: str, n_envs: int, seed: int, env_kwargs: dict[str, Any]
) -> tuple[VecEnv, list[BaseCallback]]:
    """
    What a model was trained in by RL Zoo: the environment with its arguments, wrappers and normalisation, and the callbacks of
    its settings. For a model that lies in no folder of RL Zoo's, the environment as it is.

    :param model_path: The saved model
    :param env_id: Environment id
    :param n_envs: Number of environments
    :param seed: Seed
    :param env_kwargs: Arguments of the environment, besides those it was trained with
    :return: The environment, as in training, and the callbacks
    """
    folder = model_path.parent / env_id.replace("/", "-")
    hyperparams, stats_path = get_saved_hyperparams(str(folder), norm_reward=True)
    if (folder / "args.yml").is_file():
        trained_with = yaml.load((folder / "args.yml").read_text(), Loader=yaml.UnsafeLoader)
        env_kwargs = {**(trained_with["env_kwargs"] or {}), **env_kwargs}
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
    :return: By name on the command line, those of RL Zoo's algorithms of which all can be reported
    """
    return {
        name: algorithm
        for name, algorithm in ALGOS.items()
        if (issubclass(algorithm, (OnPolicyAlgorithm, DQN)) or name == "qrdqn") and name != "ppo_lstm"
    }


def main(arguments: Sequence[str]) -> None:
    """
    :param arguments: Of the command line, after ``inspect``
    """
    parser = argparse.ArgumentParser(
        prog="sb3-cchain inspect",
        description="Roll out saved models, train them a little, and report their churn, their neural tangent kernel and the "
        "health of their networks. The files stay as they are.",
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
    parser.add_argument("--algo", choices=sorted(known_algorithms()), help="Algorithm, by default told from the file")
    parser.add_argument("--n-steps", type=int, default=2048, help="Environment steps of a DQN's rollout; a PPO's is its own")
    parser.add_argument("--n-updates", type=int, default=100, help="Gradient updates of a DQN whose churn is measured")
    parser.add_argument("--seed", type=int, default=0, help="Seed of rollout and updates")
    parser.add_argument("--device", default="auto", help="PyTorch device")
    parser.add_argument("--output", type=Path, default=Path("inspection"), help="Folder of the picture and of the figures")
    args = parser.parse_args(arguments)
    if len(args.models) > 2:
        parser.error(f"one model, or two to compare; got {len(args.models)}")
    for option, number in (("--n-steps", args.n_steps), ("--n-updates", args.n_updates)):
        if number < 1:
            parser.error(f"{option} must be at least 1; got {number}")
    for path in args.models:
        if not path.is_file():
            parser.error(f"no such file: {path}")

    env_kwargs = args.env_kwargs
    if args.task is not None:  # and long enough to stay there, however long the model was trained
        env_kwargs = {**env_kwargs, "first_task": args.task, "steps_per_task": 10**9}
    names = ["A", "B"] if len(args.models) == 2 else [args.models[0].stem]
    console = Console()
    inspections = []
    for name, path in zip(names, args.models, strict=True):
        try:
            algorithm = known_algorithms()[args.algo] if args.algo else algorithm_of(path)
            data, *_ = load_from_zip_file(path, device="cpu", load_data=True)
            assert data is not None
            env, callbacks = make_as_trained(path, args.env, data["n_envs"], args.seed, env_kwargs)
            # The buffer is as large as what is rolled out
            settings = {"buffer_size": args.n_steps} if issubclass(algorithm, OffPolicyAlgorithm) else {}
            model = algorithm.load(path, env, device=args.device, **settings)
        except (TypeError, ValueError, gym.error.Error) as error:
            parser.error(f"{path} in {args.env} {env_kwargs or ''}: {error}")
        if model.lr_schedule(model._current_progress_remaining) == 0:
            console.print(f"{name} was saved when its learning rate had come down to 0: its updates change nothing.")
        model.set_random_seed(args.seed)
        console.print(f"{name}: {path}, {algorithm.__name__}, {model.num_timesteps} steps of training", soft_wrap=True)
        inspections.append(inspect_model(model, name, args.n_steps, args.n_updates, callbacks))
        env.close()
    for table in report(inspections):
        console.print(table)
    plot(inspections, args.output / "inspection.png")
    figures = [
        # JSON has neither infinity nor what is not a number
        {"model": str(path), **{tag: value if math.isfinite(value) else None for tag, value in inspection.figures.items()}}
        for path, inspection in zip(args.models, inspections, strict=True)
    ]
    (args.output / "inspection.json").write_text(json.dumps(figures, indent=1))
    console.print(f"Written: {args.output}/inspection.png, {args.output}/inspection.json", soft_wrap=True)
