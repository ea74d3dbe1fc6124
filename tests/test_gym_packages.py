"""The option ``--gym-packages`` of RL Zoo's commands that lack it."""

import subprocess
from types import SimpleNamespace

import pytest

from sb3_cchain.zoo.cli import call_sb3_cchain
from tests.zoo_command import command


@pytest.mark.parametrize("name", ["load_from_hub", "push_to_hub", "record_video"])
def test_a_package_that_is_not_there(name, capsys):
    with pytest.raises(SystemExit):
        command(name, "--algo", "ppo_cchain", "--env", "MyGrid-v0", "--gym-packages", "no_such_package")
    assert f"sb3-cchain {name}: error: --gym-packages no_such_package: No module" in capsys.readouterr().err


def test_commands_that_a_command_starts_import_the_packages_too(monkeypatch):
    started = []
    monkeypatch.setattr(subprocess, "run", lambda command: started.append(command) or SimpleNamespace(returncode=0))
    call_sb3_cchain(["python", "enjoy.py", "--env", "MyGrid-v0"], gym_packages=["my_envs", "my_wrappers"])
    assert started[0][1:] == "-m sb3_cchain.zoo enjoy --env MyGrid-v0 --gym-packages my_envs my_wrappers".split()
