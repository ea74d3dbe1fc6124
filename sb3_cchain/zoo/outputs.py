"""What commands write: files, whose places are checked before they work, and lines in the terminal."""

import argparse
from pathlib import Path

from rich.console import Console

from sb3_cchain.checkpoint import check_writable


def check_output_folder(parser: argparse.ArgumentParser, option: str, folder: Path) -> None:
    """
    Make a folder, or end with an error in one line.

    :param parser: The parser of the command line
    :param option: The option that the folder was given by
    :param folder: The folder
    """
    try:
        check_writable(folder)
    except OSError as error:
        parser.error(f"{option} {folder}: {error.strerror}. Give a folder that can be written to")


def check_output_file(parser: argparse.ArgumentParser, option: str, path: Path) -> None:
    """
    Make the folder of a file, or end with an error in one line.

    :param parser: The parser of the command line
    :param option: The option that the file was given by
    :param path: The file
    """
    if path.is_dir():
        parser.error(f"{option} {path}: it is a folder. Give the path of a file")
    try:
        check_writable(path.parent)
    except OSError as error:
        parser.error(f"{option} {path}: {error.strerror}. Give a path in a folder that can be written to")


def print_line(console: Console, line: str) -> None:
    """
    Print text as it is: not wrapped, so that paths and commands can be copied, and without rich's markup and colours.

    :param console: Where
    :param line: The text
    """
    console.print(line, soft_wrap=True, markup=False, highlight=False)
