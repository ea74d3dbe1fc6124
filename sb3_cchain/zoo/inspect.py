"""The command ``sb3-cchain inspect``."""

import argparse
import importlib
import json
import math
import pickle
import sys
from collections.abc import Sequence
from contextlib import nullcontext, redirect_stdout
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml
from rich.console import Console
from rl_zoo3 import ALGOS
from rl_zoo3.callbacks import SaveVecNormalizeCallback
from rl_zoo3.utils import StoreDict, create_test_env, get_callback_list, get_saved_hyperparams
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.utils import is_masking_supported
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_cchain.analysis.findings import BY_NAME, CERTAINTIES
from sb3_cchain.analysis.inspection import Inspection, inspect_model
from sb3_cchain.analysis.inspection_report import findings_text, plot, report
from sb3_cchain.analysis.report_page import html_report
from sb3_cchain.analysis.saved_algorithm import algorithm_of
from sb3_cchain.checkpoint import check_model_file
from sb3_cchain.checkpoint.checkpoint_folder import MODEL
from sb3_cchain.checkpoint.files import load_statistics
from sb3_cchain.envs import TaskVecNormalize
from sb3_cchain.zoo.checkpoint_options import CHECKPOINTS
from sb3_cchain.zoo.outputs import check_output_file, check_output_folder, print_line
from sb3_cchain.zoo.settings import read_saved
from sb3_cchain.zoo.statistics import checkpoint_statistics


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
    if normalize is not None:
        normalize.training, normalize.norm_reward = True, norm_reward
    if normalize is None:
        return (env if statistics is None else VecNormalize.load(str(statistics), env)), callbacks
    if statistics is None and is_deep:
        raise ValueError(
            "it was trained with normalisation, and its statistics are within the checkpoint: give a file of them as "
            "--vec-normalize"
        )
    statistics = statistics or checkpoint_statistics(model_path)
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


def make_parser() -> argparse.ArgumentParser:
    """
    :return: The parser of the command line
    """
    parser = argparse.ArgumentParser(
        prog="sb3-cchain inspect",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Roll out saved models, train them a little, and report what is wrong with them, and their churn, their\n"
        "neural tangent kernel and the health of their networks. The files are not changed.",
        epilog="Exit code: 0 when there are no findings as certain as --fail-on asks for, 3 when there are, 2 when a file\n"
        "is no model that can be read or an argument is wrong.",
    )
    parser.add_argument("models", nargs="+", type=Path, metavar="MODEL.zip", help="One saved model, or two to compare")
    parser.add_argument("--env", required=True, help="Environment id")
    parser.add_argument(
        "--gym-packages", nargs="+", default=[], metavar="PACKAGE", help="Packages to import that register environments"
    )
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
    parser.add_argument(
        "--vec-normalize",
        type=Path,
        metavar="STATS.pkl",
        help="Statistics that VecNormalize.save() wrote, by default those beside the model in RL Zoo's folder",
    )
    parser.add_argument("--algo", choices=sorted(ALGOS), help="Algorithm, by default the one that the file tells")
    parser.add_argument(
        "--n-steps",
        type=int,
        default=2048,
        help="Environment steps of the rollout, for off-policy algorithms and ARS; PPO and its like have their `n_steps`",
    )
    parser.add_argument(
        "--n-updates", type=int, default=100, help="Gradient updates after the rollout, for off-policy algorithms"
    )
    parser.add_argument("--seed", type=int, default=0, help="Seed of rollout and updates")
    parser.add_argument("--device", default="auto", help="PyTorch device")
    parser.add_argument("--output", type=Path, default=Path("inspection"), help="Folder for the picture and the numbers")
    parser.add_argument("--json", action="store_true", help="Print the findings as JSON, and all else to stderr")
    parser.add_argument(
        "--html", type=Path, metavar="PATH", help="Write the findings to an HTML page that is complete in itself"
    )
    parser.add_argument(
        "--fail-on",
        choices=[*CERTAINTIES, "never"],
        default="likely",
        help="Which findings make the exit code 3: likely ones, possible ones too, or none",
    )
    parser.add_argument(
        "--ignore",
        nargs="+",
        choices=list(BY_NAME),
        default=[],
        metavar="NAME",
        help=f"Findings to leave out: {', '.join(BY_NAME)}",
    )
    return parser


def check_arguments(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """
    End with an error in one line where arguments are wrong.

    :param parser: The parser of the command line
    :param args: Its arguments
    """
    if len(args.models) > 2:
        parser.error(f"one model, or two to compare; got {len(args.models)}")
    for option, number in (("--n-steps", args.n_steps), ("--n-updates", args.n_updates)):
        if number < 1:
            parser.error(f"{option} must be at least 1; got {number}")
    for path in [*args.models, *([args.vec_normalize] if args.vec_normalize else [])]:
        if not path.is_file():
            parser.error(f"no such file: {path}")
    check_output_folder(parser, "--output", args.output)
    if args.html is not None:
        check_output_file(parser, "--html", args.html)


def main(arguments: Sequence[str]) -> int:
    """
    :param arguments: Of the command line, after ``inspect``
    :return: Exit code: 0, or 3 for findings as certain as ``--fail-on`` asks for
    """
    parser = make_parser()
    args = parser.parse_args(arguments)
    check_arguments(parser, args)
    for package in args.gym_packages:
        try:
            importlib.import_module(package)
        except ImportError as error:
            parser.error(f"--gym-packages {package}: {error}")
    names = ["A", "B"] if len(args.models) == 2 else [args.models[0].stem]
    console = Console(stderr=args.json)
    # RL Zoo prints how it makes an environment
    with redirect_stdout(sys.stderr) if args.json else nullcontext():
        inspections = [_inspect(parser, args, name, path, console) for name, path in zip(names, args.models, strict=True)]
    for inspection in inspections:
        inspection.findings = [finding for finding in inspection.findings if finding.check.name not in args.ignore]
    for table in report(inspections):
        console.print(table)
    for inspection in inspections:
        print_line(console, f"\n{findings_text(inspection)}\n")
    try:
        written = _write(args, inspections)
    except OSError as error:
        parser.error(f"{error.filename}: {error.strerror}")
    console.print(f"Written: {', '.join(map(str, written))}", soft_wrap=True)
    fails = CERTAINTIES[: CERTAINTIES.index(args.fail_on) + 1] if args.fail_on != "never" else ()
    code = 3 if any(finding.check.certainty in fails for inspection in inspections for finding in inspection.findings) else 0
    if args.json:
        models = [
            {"file": str(path), "env": args.env, **inspection.to_json()}
            for path, inspection in zip(args.models, inspections, strict=True)
        ]
        print(json.dumps({"version": 1, "exit_code": code, "models": models}, indent=1))
    return code


def _inspect(parser: argparse.ArgumentParser, args: argparse.Namespace, name: str, path: Path, console: Console) -> Inspection:
    env_kwargs = args.env_kwargs
    if args.task is not None:  # and long enough to stay there, however long the model was trained
        env_kwargs = {**env_kwargs, "first_task": args.task, "steps_per_task": 10**9}
    try:
        model, callbacks = load_as_trained(
            path, args.algo, args.env, env_kwargs, args.seed, args.n_steps, args.device, args.vec_normalize
        )
    except (
        *(TypeError, ValueError, yaml.YAMLError, gym.error.Error),
        # Of settings that name what is not there
        *(AttributeError, ImportError, NameError, SyntaxError),
    ) as error:
        where = f"{args.env} {env_kwargs}" if env_kwargs else args.env
        message = " ".join(str(error).split())  # in one line
        parser.exit(2, f"{parser.prog}: error: {path} in {where}: {message}\n")
    if args.task is not None:
        _forget_task(model, callbacks)
    if model.lr_schedule(model._current_progress_remaining) == 0:
        console.print(f"{name} was saved when its learning rate had come down to 0: its updates change nothing.")
    model.set_random_seed(args.seed)
    console.print(f"{name}: {path}, {type(model).__name__}, {model.num_timesteps} steps of training", soft_wrap=True)
    inspection = inspect_model(model, name, args.n_steps, args.n_updates, callbacks)
    assert model.env is not None
    model.env.close()
    return inspection


def _forget_task(model: Any, callbacks: Sequence[Any]) -> None:
    """The user's choice of a task is no switch, at which methods would act and λ would start over."""
    model.trained_task_id = None
    normalize = model.get_vec_normalize_env()
    if isinstance(normalize, TaskVecNormalize):
        normalize.forget_task()
    for each in (model, *callbacks):
        if hasattr(each, "reset_churn_coef"):
            each.reset_churn_coef = False


def _write(args: argparse.Namespace, inspections: Sequence[Inspection]) -> list[Path]:
    """The files, and their names."""
    figures = [
        # JSON has neither infinity nor NaN
        {"model": str(path), **{tag: value if math.isfinite(value) else None for tag, value in inspection.figures.items()}}
        for path, inspection in zip(args.models, inspections, strict=True)
    ]
    written = [args.output / "inspection.json"]
    written[0].write_text(json.dumps(figures, indent=1))
    if any(tag.startswith("health/") for inspection in inspections for tag in inspection.figures):
        written.append(args.output / "inspection.png")
        plot(inspections, written[-1])
    if args.html is not None:
        written.append(args.html)
        args.html.write_text(html_report(inspections, f"Inspection in {args.env}"), encoding="utf-8")
    return written
