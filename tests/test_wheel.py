"""What is installed works without the checkout."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder that the wheel was installed to, without its dependencies."""
    folder = tmp_path_factory.mktemp("wheel")
    run = dict(check=True, cwd=folder, stdout=subprocess.DEVNULL)
    build = ["build", "--wheel", "--no-isolation", "--outdir", "dist", str(ROOT)]
    subprocess.run([sys.executable, "-m", *build], **run)
    (wheel,) = folder.glob("dist/*.whl")
    subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", "site", str(wheel)], **run)
    return folder


def python(folder, *arguments):
    environment = {**os.environ, "PYTHONPATH": str(folder / "site"), "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, *arguments], check=True, cwd=folder, env=environment, capture_output=True, text=True
    ).stdout


def test_trains_with_the_hyperparameters_inside_the_wheel(installed):
    assert python(installed, "-c", "import sb3_cchain; print(sb3_cchain.__file__)").startswith(str(installed))
    output = python(
        *(installed, "-m", "sb3_cchain.zoo.cli", "train", "--algo", "ppo_cchain", "--env", "Continual/CartPole-v1"),
        *("-n", "2000", "-f", "logs", "--device", "cpu", "--eval-freq", "-1"),
    )
    assert f"Loading hyperparameters from: {installed}/site/sb3_cchain/zoo_hyperparams/ppo_cchain.yml" in output
    assert (installed / "logs/ppo_cchain/Continual-CartPole-v1_1/Continual-CartPole-v1.zip").exists()


def test_holds_types_licence_and_all_hyperparameters(installed):
    package = installed / "site" / "sb3_cchain"
    assert (package / "py.typed").exists()
    shipped = {path.name for path in (package / "zoo_hyperparams").iterdir()}
    assert shipped == {path.name for path in (ROOT / "zoo_hyperparams").iterdir()}
    assert list((installed / "site").glob("sb3_cchain-*.dist-info/licenses/LICENSE"))
    assert not (installed / "site" / "tests").exists() and not (installed / "site" / "benchmarks").exists()
