"""The options of ``sb3-cchain train`` that RL Zoo does not have: checkpoints, and training that goes on exactly from one."""

import argparse
import os
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from sb3_cchain.checkpoint.checkpoint_folder import is_being_written
from sb3_cchain.checkpoint.files import write_safely
from sb3_cchain.checkpoint.saved_checkpoint import Checkpoint, find_checkpoint, has_checkpoint
from sb3_cchain.zoo.rl_zoo_options import read_rl_zoo_options
from sb3_cchain.zoo.training_record import COMMAND, read_record

# In a run folder
CHECKPOINTS = "checkpoints"
RESUMED_FROM = "resumed_from"

# Checkpoints that stay
KEEP = 2

# In the place of a path after --resume
LAST = Path("last")


class CheckpointOptions(NamedTuple):
    """
    What the options say.

    :param freq: Environment steps between two checkpoints, None for as many as in the training that goes on
    :param keep: How many of the newest checkpoints stay, None for as many as in the training that goes on
    :param exact: Whether environments that cannot be resumed exactly are refused
    :param typed: The other arguments, as typed
    :param resume: Where the checkpoint is that training goes on from, None for training from the start
    :param checkpoint: That checkpoint
    :param record: What that training was started with, see :func:`~sb3_cchain.zoo.training_record.write_record`
    """

    freq: int | None
    keep: int | None
    exact: bool
    typed: Sequence[str]
    resume: Path | None = None
    checkpoint: Checkpoint | None = None
    record: Mapping[str, Any] = MappingProxyType({})

    def resume_command(self, folder: Path) -> str:
        """
        :param folder: A run folder
        :return: The command that goes on from its newest checkpoint
        """
        return shlex.join(["sb3-cchain", "train", *self.typed, "--resume", str(folder)])


def make_parser() -> argparse.ArgumentParser:
    """
    :return: The parser of these options alone
    """
    parser = argparse.ArgumentParser(
        prog="sb3-cchain train",
        usage=argparse.SUPPRESS,
        description="Options of sb3-cchain. Those of RL Zoo follow.",
        add_help=False,
        allow_abbrev=False,
    )
    group = parser.add_argument_group("checkpoints to go on from exactly")
    group.add_argument(
        "--checkpoint-freq",
        type=int,
        metavar="STEPS",
        help="Save all of the training every so many environment steps, and on Ctrl-C or SIGTERM, in the folder `checkpoints` "
        "of the run",
    )
    group.add_argument(
        "--checkpoint-keep",
        type=int,
        metavar="N",
        help=f"How many of the newest checkpoints stay (default: {KEEP}; with --resume, as before)",
    )
    group.add_argument(
        "--checkpoint-inexact",
        action="store_true",
        help="Also save training in environments that cannot be resumed exactly, such as Atari games: with --resume, all "
        "environments begin new episodes",
    )
    group.add_argument(
        "--resume",
        type=Path,
        metavar="PATH",
        help="Go on exactly from a checkpoint, from the newest in a folder of checkpoints, or from that of a run folder. "
        "`last` is the last run of --algo and --env in the log folder; where none has a checkpoint, training begins. All "
        "other options must be those of that training, but a greater --n-timesteps trains longer",
    )
    return parser


def take_options(arguments: Sequence[str]) -> tuple[CheckpointOptions | None, list[str]]:
    """
    :param arguments: Arguments of ``sb3-cchain train``
    :return: What these options say, None where none is given; and the arguments for RL Zoo
    :raises SystemExit: When an option is out of range, or the options do not go together
    """
    parser = make_parser()
    given, rest = parser.parse_known_args(arguments)
    if given == parser.parse_args([]):
        return None, rest
    other = read_rl_zoo_options(rest)
    for name in ("checkpoint_freq", "checkpoint_keep"):
        value = getattr(given, name)
        if value is not None and value < 1:
            sys.exit(f"--{name.replace('_', '-')} must be at least 1; got {value}")
    if given.checkpoint_freq is None and given.resume is None:
        option = "--checkpoint-keep" if given.checkpoint_keep is not None else "--checkpoint-inexact"
        sys.exit(f"{option} is about checkpoints: give --checkpoint-freq STEPS, too")
    if given.checkpoint_freq is None and given.resume == LAST:
        sys.exit("--resume last begins a training where there is none to go on from: give --checkpoint-freq STEPS, too")
    if other.optimize_hyperparameters:
        sys.exit(f"{'--checkpoint-freq' if given.resume is None else '--resume'} does not go with -optimize")
    if given.resume is not None and other.trained_agent:
        sys.exit(
            f"--resume and -i are both given, {given.resume} and {other.trained_agent}: --resume goes on exactly from a "
            "checkpoint, -i goes on from a model alone"
        )
    keep = given.checkpoint_keep or (KEEP if given.resume is None else None)
    return CheckpointOptions(given.checkpoint_freq, keep, not given.checkpoint_inexact, rest, given.resume), rest


def find_resumed(options: CheckpointOptions, arguments: list[str]) -> tuple[CheckpointOptions, list[str]]:
    """
    :param options: The options
    :param arguments: Arguments for RL Zoo
    :return: With ``--resume``, the options with the checkpoint, and the arguments with its seed where none is given
    :raises SystemExit: When there is no whole checkpoint, unless ``last`` is asked for
    """
    if options.resume == LAST:
        runs = _runs(arguments)
        if running := [run for run in runs if is_being_written(run / CHECKPOINTS)]:
            sys.exit(f"--resume last: another process is training in {running[-1]}")
        begun = [run for run in runs if has_checkpoint(run / CHECKPOINTS) or _resumed_from(run) is not None]
        options = options._replace(resume=begun[-1] if begun else None)
    if options.resume is None:
        return options._replace(keep=options.keep or KEEP), arguments
    try:
        folder = _where_to_look(options.resume)
        if (folder / COMMAND).is_file() and not has_checkpoint(folder):
            raise ValueError(f"{options.resume} ended before its first checkpoint: start it again without --resume")
        checkpoint = find_checkpoint(folder)
        record = read_record(checkpoint.folder)
    except (ValueError, OSError) as error:
        sys.exit(f"--resume: {error}")
    if read_rl_zoo_options(arguments).seed < 0:  # RL Zoo would draw one
        arguments = [*arguments, "--seed", str(record["options"]["seed"])]
    freq = options.freq or record["checkpoint_freq"]
    keep = options.keep or record["checkpoint_keep"]
    exact = options.exact and checkpoint.info["training_checkpoint"]["exact"]
    return options._replace(freq=freq, keep=keep, exact=exact, checkpoint=checkpoint, record=record), arguments


def _runs(arguments: Sequence[str]) -> list[Path]:
    """The run folders of an algorithm and an environment, the last one last."""
    given = read_rl_zoo_options(arguments)
    name = re.compile(re.escape(given.env.replace("/", "-")) + r"_(\d+)(_[-0-9a-f]{36})?")  # the latter by --uuid
    numbers = {
        folder: int(match[1]) for folder in (given.log_folder / given.algo).glob("*") if (match := name.fullmatch(folder.name))
    }
    return sorted(numbers, key=numbers.__getitem__)


def write_resumed_from(run: Path, checkpoint: Path) -> None:
    """
    :param run: A run folder
    :param checkpoint: The checkpoint that its training goes on from. One in the folder beside it is found there also after
        both were moved
    """
    checkpoint = checkpoint.resolve()
    is_beside = checkpoint.is_relative_to(run.resolve().parent)
    with write_safely(run / RESUMED_FROM) as file:
        file.write_text(f"{os.path.relpath(checkpoint, run.resolve()) if is_beside else checkpoint}\n")


def _resumed_from(run: Path) -> Path | None:
    """The checkpoint that the training in a run folder went on from."""
    file = run / RESUMED_FROM
    name = file.read_text().strip() if file.is_file() else ""
    return run / name if name else None


def _where_to_look(resume: Path) -> Path:
    """For a run folder its checkpoints, or those that the run itself went on from, if it was killed before it saved one."""
    inside, resumed_from = resume / CHECKPOINTS, _resumed_from(resume)
    if not has_checkpoint(inside) and resumed_from is not None:
        return resumed_from.resolve()
    return inside if inside.is_dir() else resume
