"""
The command ``sb3-cchain``: RL Zoo's commands, with the algorithms, related methods and hyperparameters of this package, and
``sb3-cchain compare`` and ``sb3-cchain inspect``.
"""

import runpy
import subprocess
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from typing import Any

from stable_baselines3.common import callbacks, evaluation

try:
    import rl_zoo3.enjoy
    import rl_zoo3.train
    import rl_zoo3.utils
    import yaml
    from huggingface_sb3 import EnvironmentName
    from rl_zoo3 import ALGOS
except ImportError as error:
    raise ImportError(f'The sb3-cchain command needs RL Zoo ({error}): pip install "sb3-cchain[zoo]"') from error

from sb3_cchain.masked_evaluation import evaluate_policy
from sb3_cchain.methods.registry import REGISTRY
from sb3_cchain.replaced import replaced
from sb3_cchain.zoo import compare
from sb3_cchain.zoo import inspect as zoo_inspect
from sb3_cchain.zoo.checkpoint_options import find_resumed, make_parser, take_options
from sb3_cchain.zoo.experiment import ExperimentManager
from sb3_cchain.zoo.gym_packages import take_gym_packages
from sb3_cchain.zoo.hub import working_clients
from sb3_cchain.zoo.playing import Playing
from sb3_cchain.zoo.search import register_search_spaces
from sb3_cchain.zoo.settings import SettingsLoader, add_settings_file, hyperparams_folder, what_cannot_be_read

__all__ = ["hyperparams_folder", "register_algorithms", "run"]

# Modules of RL Zoo to run by `python -m rl_zoo3.NAME`; the other commands are of its console script
MODULES = ("record_video", "record_training", "benchmark", "load_from_hub", "push_to_hub")
# They load a model to look at what it does
PLAYING = ("enjoy", "record_video", "push_to_hub")

_RL_ZOO_ALGOS = dict(ALGOS)


def register_algorithms(playing: Playing | None = None) -> None:
    """
    Make all rows of the registry known to RL Zoo, in place.

    :param playing: For commands that load models to play, not to train
    """
    algorithms = {**_RL_ZOO_ALGOS, **{method.algo: method.algorithm for method in REGISTRY}}
    ALGOS.update({name: playing.algorithm(algorithm) if playing else algorithm for name, algorithm in algorithms.items()})
    register_search_spaces()


def call_sb3_cchain(command: list[str], *args: Any, gym_packages: Sequence[str] = (), **kwargs: Any) -> int:
    """
    What ``subprocess.call`` is to RL Zoo's ``record_training`` and ``benchmark``, which start others of RL Zoo's commands.

    :param command: A command and its arguments
    :param args: Other arguments of ``subprocess.call``
    :param gym_packages: Packages that the command imports
    :param kwargs: Other arguments of ``subprocess.call``
    :return: Exit code
    """
    # Names of environments are EnvironmentName, see `run_module`
    command = [getattr(argument, "gym_id", argument) for argument in command]
    for stock, name in ((["python", "-m", "rl_zoo3.record_video"], "record_video"), (["python", "enjoy.py"], "enjoy")):
        if command[: len(stock)] == stock:
            command = [sys.executable, "-m", "sb3_cchain.zoo", name, *command[len(stock) :]]
            if gym_packages:
                command += ["--gym-packages", *gym_packages]
    return subprocess.run(command, *args, **kwargs).returncode


def run(command: str) -> None:
    """
    Run a command with the arguments in ``sys.argv``.

    :param command: Name of the command, which is also ``sys.argv[1]``
    """
    playing = Playing()
    register_algorithms(playing if command in PLAYING else None)
    with (
        _exit_on_unreadable_settings(),
        # RL Zoo reads the files beside a model by a loader that runs what is in them
        replaced(yaml, "UnsafeLoader", SettingsLoader),
        # Callbacks, and push_to_hub, evaluate without masks
        replaced(callbacks, "evaluate_policy", evaluate_policy),
        replaced(evaluation, "evaluate_policy", evaluate_policy),
    ):
        if command == "inspect":
            if code := zoo_inspect.main(sys.argv[2:]):
                sys.exit(code)
        elif command == "compare":
            compare.main(sys.argv[2:])
        elif command in MODULES:
            run_module(command, playing)
        elif command == "train":
            train(sys.argv[2:])
        elif command == "enjoy":
            with replaced(rl_zoo3.enjoy, "create_test_env", playing.create_env):
                run_script(command)
        else:
            run_script(command)


@contextmanager
def _exit_on_unreadable_settings() -> Iterator[None]:
    """End with one line where the settings beside a model cannot be read, such as those with objects of a Python file."""
    try:
        yield
    except yaml.constructor.ConstructorError as error:
        sys.exit(what_cannot_be_read(error))


def train(arguments: list[str]) -> None:
    """
    RL Zoo's ``train``, with the settings of this package, and with checkpoints.

    :param arguments: Arguments of the command line
    :raises SystemExit: When options do not go together, when training was interrupted, or after the help
    """
    if {"-h", "--help"} & set(arguments):
        print(make_parser().format_help())
        # Without the other arguments, which may be wrong or lack settings
        sys.argv[2:] = ["--help"]
        run_script("train")
        return
    checkpoints, rest = take_options(arguments)
    if checkpoints is not None:
        checkpoints, rest = find_resumed(checkpoints, rest)
    sys.argv[2:] = add_settings_file(rest)
    with replaced(rl_zoo3.train, "ExperimentManager", partial(ExperimentManager, checkpoints=checkpoints)):
        run_script("train")


def run_script(name: str) -> None:
    """
    Run a command of RL Zoo's console script with the arguments in ``sys.argv``. ``rl_zoo3.cli`` would import the libraries
    that draw for every command.

    :param name: Name of the command, which is also ``sys.argv[1]``
    :raises SystemExit: When the command draws and the libraries for it are not installed
    """
    del sys.argv[1]
    if name == "train":
        from rl_zoo3.train import train as run
    elif name == "enjoy":
        from rl_zoo3.enjoy import enjoy as run
    else:
        try:
            from rl_zoo3 import plots
        except ImportError as error:
            sys.exit(f'{name} needs the libraries that draw ({error}): pip install "sb3-cchain[plots]"')
        run = getattr(plots, name)
    run()


def run_module(name: str, playing: Playing) -> None:
    """
    Run a module of RL Zoo's as ``python -m`` does, with the algorithms registered, and with ``--gym-packages``.

    :param name: Its name, which ``sys.argv[1]`` is as well
    :param playing: Makes its environment
    """
    del sys.argv[1]
    gym_packages, sys.argv[1:] = take_gym_packages(name, sys.argv[1:])
    get_trained_models = rl_zoo3.utils.get_trained_models

    def get_trained_models_by_name(log_folder: str) -> dict[str, tuple[str, str]]:
        # benchmark uses the id in paths, where "Continual/..." would be two folders
        return {key: (algo, EnvironmentName(env_id)) for key, (algo, env_id) in get_trained_models(log_folder).items()}

    create_env = playing.create_captioned_env if name == "record_video" else playing.create_env
    with (
        replaced(subprocess, "call", partial(call_sb3_cchain, gym_packages=gym_packages)),
        replaced(rl_zoo3.utils, "get_trained_models", get_trained_models_by_name),
        replaced(rl_zoo3.utils, "create_test_env", create_env),
        working_clients(gym_packages) if name.endswith("_hub") else nullcontext(),
        warnings.catch_warnings(),
    ):
        # enjoy has imported load_from_hub before
        warnings.filterwarnings("ignore", message=".*found in sys.modules", category=RuntimeWarning)
        runpy.run_module(f"rl_zoo3.{name}", run_name="__main__")
