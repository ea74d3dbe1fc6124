"""The package works with its core dependencies alone; what needs an extra names it."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch as th
from stable_baselines3 import PPO

from sb3_cchain.analysis import NTKCallback
from sb3_cchain.analysis.inspection import inspect_model, plot
from sb3_cchain.analysis.plots import plot_ntk
from tests.envs import RandomEnv

INSTALL_PLOTS = r'Pictures need matplotlib .*: pip install "sb3-cchain\[plots\]"'

# Trains with every callback of `analysis` and writes to TensorBoard, without the libraries of the extras
WITHOUT_EXTRAS = """
import importlib, pkgutil, sys, warnings

extras = '''matplotlib pandas seaborn rliable rl_zoo3 sb3_contrib optuna ray gym procgen minatar dm_control shimmy mujoco Box2D
requests yaml'''.split()
sys.modules.update(dict.fromkeys(extras))  # what is None there cannot be imported
import sb3_cchain
for module in pkgutil.walk_packages(sb3_cchain.__path__, "sb3_cchain."):
    if not module.name.startswith("sb3_cchain.zoo"):
        importlib.import_module(module.name)

from stable_baselines3 import PPO
from sb3_cchain import ChurnMonitor
from sb3_cchain.analysis import NetworkHealth, NTKCallback

model = PPO("MlpPolicy", "CartPole-v1", n_steps=32, batch_size=16, n_epochs=1, device="cpu", tensorboard_log=sys.argv[1])
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    callbacks = [ChurnMonitor(interval=1), NTKCallback(4), NetworkHealth(interval=1)]
    model.learn(64, callback=callbacks, log_interval=100)
    model.learn(32, callback=callbacks, reset_num_timesteps=False, log_interval=100)
print(sum("NTKCallback" in str(warning.message) for warning in caught))
print(*model.logger.name_to_value)
"""


def test_training_without_extras(tmp_path):
    command = [sys.executable, "-c", WITHOUT_EXTRAS, str(tmp_path)]
    finished = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parent.parent, check=False)
    assert finished.returncode == 0, finished.stderr
    notices, logged = finished.stdout.splitlines()[-2:]
    assert notices == "1"
    assert {"ntk/srank", "health/weight_norm", "churn_monitor/fresh/value_churn"} <= set(logged.split())
    assert "ntk/matrix" not in logged
    assert list(tmp_path.glob("PPO_1/events*"))


@pytest.fixture
def without_matplotlib(monkeypatch):
    for name in ("matplotlib", "matplotlib.figure", "matplotlib.style"):
        monkeypatch.setitem(sys.modules, name, None)


@pytest.mark.usefixtures("without_matplotlib")
@pytest.mark.parametrize("arguments", [dict(picture_interval=1), dict(path="pictures"), dict(picture_interval=3, path="a")])
def test_pictures_that_are_asked_for_need_matplotlib(arguments):
    with pytest.raises(ImportError, match=INSTALL_PLOTS):
        NTKCallback(**arguments)


@pytest.mark.usefixtures("without_matplotlib")
def test_no_pictures_need_no_matplotlib(recwarn):
    model = PPO("MlpPolicy", RandomEnv(), n_steps=16, batch_size=16, device="cpu")
    model.learn(16, callback=NTKCallback(4, picture_interval=0, path="pictures"), log_interval=100)
    assert "ntk/srank" in model.logger.name_to_value
    assert not [warning for warning in recwarn if "matplotlib" in str(warning.message)]


@pytest.mark.usefixtures("without_matplotlib")
def test_drawing_names_the_extra(tmp_path):
    with pytest.raises(ImportError, match=INSTALL_PLOTS):
        plot_ntk(th.eye(3), "title")
    model = PPO("MlpPolicy", "CartPole-v1", n_steps=16, batch_size=16, policy_kwargs=dict(net_arch=[4]), device="cpu")
    with pytest.raises(ImportError, match=INSTALL_PLOTS):
        plot([inspect_model(model)], tmp_path / "picture.png")
