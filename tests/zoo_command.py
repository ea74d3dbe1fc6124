"""The command line, in this process and in one of its own."""

import os
import subprocess
import sys
from pathlib import Path
from unittest import mock

import rl_zoo3.train
import yaml

import sb3_cchain.zoo.__main__ as zoo
import sb3_cchain.zoo.search as search
from benchmarks.grid.suites import SUITES
from sb3_cchain.zoo.settings import read_settings

ROOT = Path(__file__).parent.parent
ENV_IDS = {name: list(suite.env_ids) for name, suite in SUITES.items()}
GYM_CONTROL, PROCGEN, DMC = (ENV_IDS[suite] for suite in ("gym_control", "procgen", "dmc"))

FAST = ("--num-threads", "1", "--device", "cpu", "--verbose", "0")
NO_EVALUATION = ("--eval-freq", "-1")
# Few steps of PPO in a continual environment that is fast
SHORT_PPO = ("-params", "n_steps:32", "batch_size:16", "n_epochs:1", "policy_kwargs:dict(net_arch=[8])")


def command(*arguments):
    """``sb3-cchain ...``"""
    with mock.patch.object(sys, "argv", ["sb3-cchain", *map(str, arguments)]):
        zoo.main()


def stock_train(*arguments):
    """``python -m rl_zoo3.train ...`` as it is without our command."""
    with mock.patch.object(sys, "argv", ["train.py", *map(str, arguments)]):
        rl_zoo3.train.train()


def run(*command, cwd):
    """``python -m ...``, its output."""
    environment = {**os.environ, "MPLBACKEND": "agg", "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    result = subprocess.run([sys.executable, "-m", *command], cwd=cwd, capture_output=True, text=True, env=environment)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout + result.stderr


def search_short_rollouts(monkeypatch, algorithm):
    """RL Zoo's search space for PPO has long rollouts and large networks."""
    _, converter = search._SEARCH_SPACES[algorithm]
    monkeypatch.setitem(search._SEARCH_SPACES, algorithm, (lambda *_: dict(n_steps=50, batch_size=25), converter))


def shipped_settings(algo):
    settings = read_settings(algo)
    assert settings == yaml.safe_load((ROOT / "zoo_hyperparams" / f"{algo}.yml").read_text())
    return settings
