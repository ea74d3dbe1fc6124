"""Stands in for the training command in tests of what executes it: starts at once and does as it is told."""

import json
import os
import signal
import sys
import time
from pathlib import Path

HERE = Path(__file__)


def fake_program(folder, behaviours):
    """
    :param folder: Folder for the instructions
    :param behaviours: By seed, what each attempt does, the last one again and again: ``ok``, ``fail``, ``hang`` until it is
        told to stop, ``save`` a checkpoint half-way and be killed, or ``wait`` until there is a file ``go`` in the folder.
        Seeds that are missing are ``ok``
    :return: The command
    """
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "behaviours.json"
    file.write_text(json.dumps({str(seed): behaviour for seed, behaviour in behaviours.items()}))
    return (sys.executable, str(HERE), str(file))


def option(name):
    return sys.argv[sys.argv.index(name) + 1]


def stop(number, frame):
    (Path(option("--log-folder")) / "stopped").touch()
    sys.exit(128 + number)


def save_checkpoint(folder, num_timesteps):
    """As `sb3-cchain train` does, with nothing in it."""
    checkpoint = folder / "algo" / "env_1" / "checkpoints" / f"step_{num_timesteps:012d}"
    checkpoint.mkdir(parents=True)
    # Which takes longer to import than most of these processes live
    from sb3_cchain.checkpoint.checkpoint_info import FORMAT, write_info

    info = {"format": FORMAT, "num_timesteps": num_timesteps, "seconds": 100.0, "files": {}, "chunks": [], "versions": {}}
    write_info(checkpoint, info)


def train():
    signal.signal(signal.SIGTERM, stop)
    file, folder = Path(sys.argv[1]), Path(option("--log-folder"))
    attempts = json.loads(file.read_text()).get(option("--seed"), ["ok"])
    n_before = len(list(folder.parent.glob("attempt_*"))) - 1
    behaviour = attempts[min(n_before, len(attempts) - 1)]
    if behaviour == "fail":
        sys.exit("first line\n\nValueError: boom\n")
    steps = int(option("--n-timesteps")) // 2
    returns = folder / "tensorboard" / "env" / "algo_1" / "returns.csv"
    returns.parent.mkdir(parents=True)
    rows = [f"{steps * (task + 1)},{task},2,{-10.0 * (task + 1)}\n" for task in (0, 1)]
    returns.write_text("timesteps,task_id,n_episodes,mean_return\n" + rows[0])
    if behaviour == "save":
        save_checkpoint(folder, steps)
        os.kill(os.getpid(), signal.SIGKILL)
    while behaviour == "hang" or (behaviour == "wait" and not (file.parent / "go").exists()):
        time.sleep(0.05)
    with open(returns, "a") as csv:
        csv.write(rows[1])


if __name__ == "__main__":
    train()
