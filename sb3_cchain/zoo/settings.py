"""The settings of a training run: the YAML files of this package, and what RL Zoo saved beside a model."""

import sys
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from sb3_cchain.methods import OptimizerMetrics
from sb3_cchain.methods.registry import BY_ALGO, REGISTRY, Method
from sb3_cchain.tasks.callback_tree import iterate_callbacks
from sb3_cchain.zoo.rl_zoo_options import read_rl_zoo_options


def hyperparams_folder() -> Path:
    """
    :return: The folder of the YAML files: inside the installed package, at the root of a checkout
    """
    package = Path(__file__).parent.parent
    inside = package / "zoo_hyperparams"
    return inside if inside.is_dir() else package.parent / "zoo_hyperparams"


def settings_path(algo: str) -> Path:
    """
    :param algo: Name of the algorithm on the command line
    :return: Where its YAML file is, if it has one
    """
    return hyperparams_folder() / f"{algo}.yml"


def read_settings(algo: str) -> dict[str, Any]:
    """
    :param algo: Name of the algorithm on the command line
    :return: The content of its YAML file; empty if there is none
    """
    path = settings_path(algo)
    return yaml.safe_load(path.read_text()) if path.is_file() else {}


def settings_file(algo: str, env_id: str) -> Path | None:
    """
    :param algo: Name of the algorithm on the command line
    :param env_id: Environment id
    :return: Our YAML file, if it has settings for the environment, or defaults for an algorithm that RL Zoo does not have;
        otherwise None, which leaves it to RL Zoo's settings
    """
    settings = read_settings(algo)
    if env_id in settings or ("default" in settings and not _rl_zoo_has_settings(algo)):
        return settings_path(algo)
    return None


def _rl_zoo_has_settings(algo: str) -> bool:
    import rl_zoo3

    return (Path(rl_zoo3.__file__).parent / "hyperparams" / f"{algo}.yml").is_file()


def add_settings_file(arguments: list[str]) -> list[str]:
    """
    :param arguments: Arguments of RL Zoo's ``train``
    :return: The same, with the YAML file of this package where there is one
    :raises SystemExit: When an algorithm of this package has no settings for the environment, or is to be optimised and has
        nothing to search
    """
    given = read_rl_zoo_options(arguments)
    method = BY_ALGO.get(given.algo)
    if given.optimize_hyperparameters and method is not None and method.is_related and not method.grid:
        base = base_algo(method)
        sys.exit(
            f"-optimize: {given.algo} has no hyperparameters of its own to search. "
            f"Those of {base} are searched by --algo {base} -optimize."
        )
    path = settings_file(given.algo, given.env)
    if path is not None:
        # First, so that a file given by the user wins
        return ["--conf-file", str(path), *arguments]
    if given.conf_file is None and method is not None and not _rl_zoo_has_settings(given.algo):
        covered = [key for key in read_settings(given.algo) if not key.endswith("-defaults")]
        has = f"only for {', '.join(covered)}" if covered else "and for no other"
        sys.exit(
            f"{given.algo}.yml has no settings for {given.env}, {has}. "
            "For another environment, give a YAML file of your own that names the method, too: -conf FILE"
        )
    return arguments


def base_algo(method: Method) -> str:
    """
    :param method: A related method
    :return: Name of its algorithm on the command line, without the method
    """
    return next(row.algo for row in REGISTRY if row.algorithm is method.algorithm and not row.is_related)


def missing_parts(method: Method, hyperparams: Mapping[str, Any], callbacks: Sequence[BaseCallback]) -> list[str]:
    """
    :param method: A method
    :param hyperparams: Hyperparameters of its algorithm
    :param callbacks: Callbacks of the settings
    :return: Names of the classes that make the method and that the settings lack: its optimiser, its callbacks, and its policy
        where the settings have one of Stable-Baselines3's with its usual features extractor
    """
    policy, policy_kwargs = hyperparams.get("policy"), hyperparams.get("policy_kwargs") or {}
    # Callbacks that only log are no part of a method
    parts: list[type] = [callback for callback in method.callbacks if callback is not OptimizerMetrics]
    if method.optimizer_class is not None:
        parts.append(method.optimizer_class)
    there = [*map(type, iterate_callbacks(CallbackList(list(callbacks)))), *_optimizer_classes(policy_kwargs)]
    missing = [part.__name__ for part in parts if not any(issubclass(each, part) for each in there)]
    is_stock = not isinstance(policy, type) or policy.__module__.startswith("stable_baselines3.")
    if isinstance(method.policy, type) and is_stock and "features_extractor_class" not in policy_kwargs:
        missing.append(method.policy.__name__)
    return missing


def _optimizer_classes(policy_kwargs: Mapping[str, Any]) -> Iterator[type]:
    """The optimiser of a policy, and those inside of it."""
    name, kwargs = "optimizer", policy_kwargs
    while (optimizer_class := kwargs.get(f"{name}_class")) is not None:
        yield getattr(optimizer_class, "func", optimizer_class)  # which a partial() is of
        name, kwargs = "base", kwargs.get(f"{name}_kwargs") or {}


class SettingsLoader(yaml.FullLoader):
    """
    Reads the ``args.yml`` and ``config.yml`` that RL Zoo wrote, and calls nothing that they name: plain values, tuples,
    ``OrderedDict``, and names of classes that are already imported. ``yaml.YAMLError`` for all else.
    """


def read_saved(path: Path) -> dict[str, Any]:
    """
    :param path: An ``args.yml`` or ``config.yml`` of RL Zoo
    :return: Its content; empty if there is no such file
    :raises ValueError: When it does not map names to values
    """
    if not path.is_file():
        return {}
    with open(path) as file:
        content = yaml.load(file, Loader=SettingsLoader)
    if not isinstance(content, dict):
        raise ValueError(f"{path} must map names to values, as RL Zoo writes it")
    return content


def what_cannot_be_read(error: yaml.constructor.ConstructorError) -> str:
    """
    :param error: Raised when saved settings were read
    :return: What is wrong, and what to do
    """
    where = error.problem_mark.name if error.problem_mark is not None else "the settings"
    return (
        f"{where} cannot be read: {error.problem}. Import classes of your own by --gym-packages MODULE. Objects, such as "
        "callbacks in a Python file of settings, cannot be read back: give their names in a YAML file"
    )


def _ordered_dict(loader: yaml.FullLoader, node: yaml.Node) -> OrderedDict[str, Any]:
    if not isinstance(node, yaml.SequenceNode):
        raise yaml.constructor.ConstructorError(None, None, "an OrderedDict must be a list of pairs", node.start_mark)
    (pairs,) = loader.construct_sequence(node, deep=True) or ([],)
    return OrderedDict(pairs)


SettingsLoader.add_constructor("tag:yaml.org,2002:python/object/apply:collections.OrderedDict", _ordered_dict)

# NumPy's numbers in a Python file of settings are written as plain ones, which can be read back
yaml.add_multi_representer(np.generic, lambda dumper, n: dumper.represent_data(n.item()))  # type: ignore[type-abstract]
