"""The options of RL Zoo's ``train`` that this package reads, too."""

import argparse
from collections.abc import Sequence
from pathlib import Path


def read_rl_zoo_options(arguments: Sequence[str]) -> argparse.Namespace:
    """
    :param arguments: Arguments of RL Zoo's ``train``
    :return: Those that are read here, with RL Zoo's defaults
    """
    # Without the usage, which would be of these options alone, in front of an error
    parser = argparse.ArgumentParser(add_help=False, usage=argparse.SUPPRESS)
    parser.add_argument("--algo", default="ppo")
    parser.add_argument("--env", default="CartPole-v1")
    parser.add_argument("--seed", type=int, default=-1)
    parser.add_argument("-f", "--log-folder", type=Path, default=Path("logs"))
    parser.add_argument("-i", "--trained-agent", default="")
    parser.add_argument("-conf", "--conf-file")
    parser.add_argument("-optimize", "--optimize-hyperparameters", action="store_true")
    given, _ = parser.parse_known_args(arguments)
    return given
