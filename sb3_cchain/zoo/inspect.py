"""The command ``sb3-cchain inspect``."""

import argparse
import json
import sys
from collections.abc import Sequence
from contextlib import nullcontext, redirect_stdout
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml
from rich.console import Console
from rl_zoo3 import ALGOS
from rl_zoo3.utils import StoreDict

from sb3_cchain.analysis.findings import BY_NAME, CERTAINTIES, as_json
from sb3_cchain.analysis.inspection import Inspection, inspect_model
from sb3_cchain.analysis.inspection_report import findings_text, plot, report
from sb3_cchain.analysis.report_page import html_report
from sb3_cchain.envs import TaskVecNormalize
from sb3_cchain.zoo.as_trained import load_as_trained
from sb3_cchain.zoo.gym_packages import add_gym_packages, import_gym_packages
from sb3_cchain.zoo.outputs import check_output_file, check_output_folder, print_line

# What loading a model raises: of files, arguments and environments, and of settings that name what is not there
BAD_VALUES = (TypeError, ValueError, yaml.YAMLError, gym.error.Error)
MISSING_NAMES = (AttributeError, ImportError, NameError, SyntaxError)


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
    add_gym_packages(parser)
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
    import_gym_packages(parser, args.gym_packages)
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
    print_line(console, f"Written: {', '.join(map(str, written))}")
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
    except (*BAD_VALUES, *MISSING_NAMES) as error:
        where = f"{args.env} {env_kwargs}" if env_kwargs else args.env
        message = " ".join(str(error).split())  # in one line
        parser.exit(2, f"{parser.prog}: error: {path} in {where}: {message}\n")
    if args.task is not None:
        _forget_task(model, callbacks)
    if model.lr_schedule(model._current_progress_remaining) == 0:
        print_line(console, f"{name} was saved when its learning rate had come down to 0: its updates change nothing.")
    model.set_random_seed(args.seed)
    print_line(console, f"{name}: {path}, {type(model).__name__}, {model.num_timesteps} steps of training")
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
        {"model": str(path), **{tag: as_json(value) for tag, value in inspection.figures.items()}}
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
