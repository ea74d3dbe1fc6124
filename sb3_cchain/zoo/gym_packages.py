"""The option ``--gym-packages``, also for those of RL Zoo's commands that lack it."""

import argparse
import importlib
from collections.abc import Sequence


def add_gym_packages(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: Gets the option
    """
    parser.add_argument(
        "--gym-packages", nargs="+", default=[], metavar="PACKAGE", help="Packages to import that register environments"
    )


def import_gym_packages(parser: argparse.ArgumentParser, packages: Sequence[str]) -> None:
    """
    End with an error in one line where a package cannot be imported.

    :param parser: The parser of the command line
    :param packages: Names of the packages
    """
    for package in packages:
        try:
            importlib.import_module(package)
        except ImportError as error:
            parser.error(f"--gym-packages {package}: {error}")


def take_gym_packages(command: str, arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """
    Import the packages for a command of RL Zoo's that does not know the option. The help begins with it.

    :param command: Name of the command
    :param arguments: Of the command line, after the command
    :return: The names of the packages, and the arguments for RL Zoo
    """
    parser = argparse.ArgumentParser(
        prog=f"sb3-cchain {command}",
        usage=argparse.SUPPRESS,
        description="An option of sb3-cchain. Those of RL Zoo follow.",
        add_help=False,
        allow_abbrev=False,
    )
    add_gym_packages(parser)
    given, rest = parser.parse_known_args(arguments)
    if {"-h", "--help"} & set(rest):
        print(parser.format_help())
    import_gym_packages(parser, given.gym_packages)
    return given.gym_packages, rest
