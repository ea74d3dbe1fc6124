"""The callbacks of `analysis` work without matplotlib; what draws pictures names the extra (test_wheel.py: all extras)."""

import sys

import pytest
import torch as th
from stable_baselines3 import PPO

from sb3_cchain.analysis import ChurnMonitor, NetworkHealth, NTKCallback
from sb3_cchain.analysis.inspection import inspect_model
from sb3_cchain.analysis.inspection_report import plot
from sb3_cchain.analysis.plots import plot_ntk
from tests.envs import RandomEnv

INSTALL_PLOTS = r'Pictures need matplotlib .*: pip install "sb3-cchain\[plots\]"'


@pytest.fixture
def without_matplotlib(monkeypatch):
    for name in ("matplotlib", "matplotlib.figure", "matplotlib.style"):
        monkeypatch.setitem(sys.modules, name, None)


@pytest.mark.usefixtures("without_matplotlib")
def test_training_logs_numbers_and_says_so_once(tmp_path):
    model = PPO("MlpPolicy", RandomEnv(), n_steps=16, batch_size=16, n_epochs=1, device="cpu", tensorboard_log=tmp_path)
    callbacks = [ChurnMonitor(interval=1), NTKCallback(4), NetworkHealth(interval=1)]
    with pytest.warns(UserWarning) as caught:
        model.learn(32, callback=callbacks, log_interval=100)
        model.learn(16, callback=callbacks, log_interval=100, reset_num_timesteps=False)
    assert sum("NTKCallback logs numbers and no pictures" in str(warning.message) for warning in caught) == 1
    assert {"ntk/srank", "health/weight_norm", "churn_monitor/fresh/value_churn"} <= set(model.logger.name_to_value)
    assert "ntk/matrix" not in model.logger.name_to_value
    assert list(tmp_path.glob("PPO_1/events*"))


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
