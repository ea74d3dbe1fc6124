"""What is installed works without the checkout, and with the packages that it requires alone."""

import json
import os
import subprocess
import sys
from importlib.metadata import Distribution, distribution, distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import sb3_cchain

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A folder that the wheel was installed to, without its dependencies."""
    folder = tmp_path_factory.mktemp("wheel")
    run = dict(check=True, cwd=folder, stdout=subprocess.DEVNULL)
    build = ["build", "--wheel", "--no-isolation", "--outdir", "dist", str(ROOT)]
    subprocess.run([sys.executable, "-m", *build], **run)
    (path,) = folder.glob("dist/*.whl")
    subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", "site", str(path)], **run)
    return folder / "site"


def required(package: Distribution, extra: str) -> list[Distribution]:
    """
    :return: The distributions that a package requires with an extra (with none where it is ""), and all that these require
    """
    found: dict[tuple[str, str], Distribution] = {("sb3-cchain", extra): package}
    waiting = [("sb3-cchain", extra)]
    while waiting:
        key = waiting.pop()
        for requirement in map(Requirement, found[key].requires or ()):
            if requirement.marker is None or requirement.marker.evaluate({"extra": key[1]}):
                for needed in [(requirement.name, each) for each in ("", *requirement.extras)]:
                    if needed not in found:
                        found[needed] = package if needed[0] == "sb3-cchain" else distribution(needed[0])
                        waiting.append(needed)
    return [found[key] for key in found if key[0] != "sb3-cchain"]


def link(package: Distribution, folder: Path) -> None:
    """Fill a folder with links to what a distribution installed."""
    site = Path(str(package.locate_file("")))
    for file in package.files or ():
        # Of a namespace such as `google`, which several distributions share, only the part of this one
        is_namespace = (site / file.parts[0]).is_dir() and not any((site / file.parts[0]).glob("*.*"))
        part = Path(*file.parts[: 2 if is_namespace else 1])
        if part.parts[0] not in ("..", "__pycache__") and not (folder / part).exists():
            (folder / part).parent.mkdir(exist_ok=True)
            (folder / part).symlink_to(site / part)


@pytest.fixture(scope="module")
def run(tmp_path_factory, wheel):
    """
    A function that runs Python with the wheel and what an extra of it requires. To install that from an index would take
    minutes and a network, so the Python of an empty virtual environment sees links to the distributions installed here.
    """
    empty = tmp_path_factory.mktemp("empty")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(empty)], check=True)
    folders: dict[str, Path] = {}

    def run(arguments, extra="", paths=()):
        if extra not in folders:
            folders[extra] = tmp_path_factory.mktemp("links")
            for package in required(next(distributions(path=[str(wheel)])), extra):
                link(package, folders[extra])
        path = os.pathsep.join(map(str, (*paths, wheel, folders[extra])))
        environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
        process = subprocess.run(
            [empty / "bin" / "python", *arguments], cwd=wheel.parent, env=environment, capture_output=True, text=True
        )
        assert process.returncode == 0, process.stderr
        return process.stdout

    return run


IMPORT_ALL = """
import importlib, json, sys
errors = {}
for name in sys.argv[1:]:
    try:
        importlib.import_module(name)
    except ImportError as error:
        errors[name] = str(error)
print(json.dumps([sys.modules["sb3_cchain"].__file__, errors]))
"""


def test_every_module_is_imported_without_extras_or_names_its_extra(run, wheel):
    files = [path.relative_to(wheel).with_suffix("") for path in (wheel / "sb3_cchain").rglob("*.py")]
    modules = {".".join(path.parts).removesuffix(".__init__") for path in files}
    path, errors = json.loads(run(["-c", IMPORT_ALL, *modules]))
    assert path.startswith(str(wheel))
    # The door to the command line names the extra; what is behind it fails with the missing module
    assert all(name.startswith(("sb3_cchain.zoo.", "sb3_cchain.algorithms.contrib")) for name in errors)
    assert 'pip install "sb3-cchain[zoo]"' in errors["sb3_cchain.zoo.cli"]
    assert 'pip install "sb3-cchain[contrib]"' in errors["sb3_cchain.algorithms.contrib"]


TRAIN = """
import torch
from stable_baselines3 import PPO
from sb3_cchain import *
from sb3_cchain.analysis import NetworkHealth, NTKCallback
from sb3_cchain.methods import *
from sb3_cchain.networks import LayerNormPolicy

torch.set_num_threads(1)
env = "Continual/CartPole-v1"
ppo = CChainPPO("MlpPolicy", env, n_steps=64, n_epochs=2, tensorboard_log="runs")
ppo.learn(128, callback=[ChurnMonitor(), NTKCallback(), NetworkHealth()], progress_bar=True).save("ppo")
CChainPPO.load("ppo", env=ppo.get_env()).learn(64, reset_num_timesteps=False)

dqn = CChainDQN("MlpPolicy", env, learning_starts=16, buffer_size=500)
dqn.learn(64, callback=[ChurnMonitor(), NTKCallback(), NetworkHealth()]).save("dqn")
CChainDQN.load("dqn", env=dqn.get_env()).learn(32, reset_num_timesteps=False)

CChainSAC("MlpPolicy", "Pendulum-v1", learning_starts=16, buffer_size=500).learn(32)

for optimizer_class in (TRAC, WeightClipping, L2Init, Parseval):
    optimizer_kwargs = dict(n_output_layers=2) if optimizer_class is Parseval else {}
    kwargs = dict(optimizer_class=optimizer_class, optimizer_kwargs=optimizer_kwargs)
    PPO("MlpPolicy", env, n_steps=64, n_epochs=1, policy_kwargs=kwargs).learn(64, callback=OptimizerMetrics())
related = [TaskSync(), AdamRel(), Oracle(), ReDo(), ShrinkAndPerturb()]
PPO(LayerNormPolicy, env, n_steps=64, n_epochs=1).learn(64, callback=[CChainCallback(), *related])
"""


def test_trains_saves_and_loads_without_extras(run, wheel):
    run(["-c", TRAIN])
    assert list(wheel.parent.glob("runs/CChainPPO_1/events*")) and (wheel.parent / "dqn.zip").exists()


IMPORTS = """
import json
import gymnasium
from sb3_cchain import CChainPPO
from sb3_cchain.analysis import NTKCallback
"""
NEEDS = {
    "box2d": 'gymnasium.make("Continual/LunarLander-v3")',
    "minatar": 'gymnasium.make("Continual/MinAtar-v0")',
    "dmc": 'gymnasium.make("Continual/Walker-v0")',
    "procgen": 'gymnasium.make("Continual/Starpilot-v0")',
    "zoo": "import sb3_cchain.zoo.cli",
    "contrib": "from sb3_cchain import CChainTQC",
    "drift": "from sb3_cchain import TaskSignal; TaskSignal(drift='adwin')",
    "plots": "CChainPPO('MlpPolicy', 'CartPole-v1', n_steps=64).learn(64, callback=NTKCallback(picture_interval=1))",
}


def test_the_absence_of_each_extra_is_named(run):
    tries = [
        f"try:\n    {code}\nexcept ImportError as error:\n    print(json.dumps(str(error)))\nelse:\n    print('no error')"
        for code in NEEDS.values()
    ]
    output = run(["-c", "\n".join([IMPORTS, *tries])])
    for extra, message in zip(NEEDS, output.strip().splitlines()[-len(NEEDS) :], strict=True):
        assert f'pip install "sb3-cchain[{extra}]"' in message.replace('\\"', '"'), (extra, message)


def test_trains_with_the_hyperparameters_inside_the_wheel(run, wheel):
    output = run(
        [
            *("-m", "sb3_cchain.zoo", "train", "--algo", "ppo_cchain", "--env", "Continual/CartPole-v1"),
            *("-n", "800", "-f", "logs", "--device", "cpu", "--eval-freq", "-1"),
        ],
        extra="zoo",
    )
    assert f"Loading hyperparameters from: {wheel}/sb3_cchain/zoo_hyperparams/ppo_cchain.yml" in output
    assert (wheel.parent / "logs/ppo_cchain/Continual-CartPole-v1_1/Continual-CartPole-v1.zip").exists()


def test_the_demo_needs_its_extra_alone(run, wheel):
    run(["-m", "benchmarks.demo", "--n-tasks", "1", "--steps-per-task", "800"], extra="demo", paths=[ROOT])
    assert list(wheel.parent.glob("demo_output/*.png"))


def test_holds_types_licence_and_all_hyperparameters(wheel):
    package = wheel / "sb3_cchain"
    assert (package / "py.typed").exists()
    shipped = {path.name for path in (package / "zoo_hyperparams").iterdir()}
    assert shipped == {path.name for path in (ROOT / "zoo_hyperparams").iterdir()}
    assert list(wheel.glob("sb3_cchain-*.dist-info/licenses/LICENSE"))
    assert not (wheel / "tests").exists() and not (wheel / "benchmarks").exists()


def test_the_version_stands_once(wheel):
    """In the package; pyproject.toml and the metadata of the wheel have it from there."""
    (metadata,) = wheel.glob("sb3_cchain-*.dist-info")
    assert metadata.name == f"sb3_cchain-{sb3_cchain.__version__}.dist-info"
    assert f"version: {sb3_cchain.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"## {sb3_cchain.__version__}" in (ROOT / "CHANGELOG.md").read_text()
