"""Files that are whole or absent, whatever happens while they are written."""

import os

import numpy as np
import pytest
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.save_util import load_from_pkl, save_to_zip_file
from stable_baselines3.common.vec_env import VecNormalize

from sb3_cchain.checkpoint import (
    SafeCheckpointCallback,
    SaveBestModel,
    check_model_file,
    load_statistics,
    save_model,
    saved_timesteps,
    write_safely,
)
from sb3_cchain.envs import TaskVecNormalize


def make(algorithm=PPO, env="CartPole-v1", **kwargs):
    if algorithm is PPO:
        kwargs = dict(n_steps=16, batch_size=16, n_epochs=1, **kwargs)
    return algorithm("MlpPolicy", env, policy_kwargs=dict(net_arch=[4]), seed=0, device="cpu", **kwargs)


class Killed(BaseException):
    """In the place of a signal that ends the process."""


def test_what_was_there_stays_until_the_new_file_is_whole(tmp_path):
    path = tmp_path / "folder" / "model.zip"
    save_model(make(), path)
    before = path.read_bytes()
    with pytest.raises(Killed), write_safely(path) as unfinished:
        unfinished.write_bytes(b"half a mo")
        assert path.read_bytes() == before
        raise Killed()
    assert path.read_bytes() == before
    with write_safely(path) as unfinished:
        unfinished.write_bytes(b"whole")
    assert path.read_bytes() == b"whole"
    assert os.listdir(path.parent) == ["model.zip"]


def test_a_file_is_on_the_disk_before_it_takes_its_place(tmp_path, monkeypatch):
    events = []
    monkeypatch.setattr(os, "fsync", lambda _: events.append("fsync"))
    replace = os.replace
    monkeypatch.setattr(os, "replace", lambda *paths: (events.append("replace"), replace(*paths)))
    save_model(make(), tmp_path / "model.zip")
    assert events == ["fsync", "replace", "fsync"]  # the file, its name


@pytest.mark.parametrize("name", ["model", "model.zip", "CartPole-v1"])
def test_names_are_those_of_save(name, tmp_path):
    model = make()
    model.save(tmp_path / "by_save" / name)
    save_model(model, tmp_path / "by_save_model" / name)
    assert os.listdir(tmp_path / "by_save") == os.listdir(tmp_path / "by_save_model")
    PPO.load(tmp_path / "by_save_model" / name, device="cpu")


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.99, 0.999])
def test_a_torn_model_is_named_and_the_newest_whole_one_too(share, tmp_path):
    paths = [tmp_path / f"rl_model_{number}_steps.zip" for number in (9, 10, 11)]
    for age, path in zip((2, 1, 0), paths, strict=True):
        save_model(make(), path)
        os.utime(path, (1e9 - age, 1e9 - age))
    content = paths[2].read_bytes()
    paths[2].write_bytes(content[: int(share * len(content))])
    check_model_file(paths[1])
    with pytest.raises(ValueError, match=f"^{paths[2]} is torn.*The newest whole model beside it is {paths[1]}$"):
        check_model_file(paths[2])
    for path in paths[:2]:
        path.unlink()
    with pytest.raises(ValueError, match=r"There is no whole model beside it$"):
        check_model_file(paths[2])


def test_a_flipped_byte_is_noticed(tmp_path):
    save_model(make(), tmp_path / "model.zip")
    content = bytearray((tmp_path / "model.zip").read_bytes())
    content[len(content) // 2] ^= 0xFF
    (tmp_path / "model.zip").write_bytes(content)
    with pytest.raises(ValueError, match="is torn"):
        check_model_file(tmp_path / "model.zip")


def test_parameters_alone_are_no_model(tmp_path):
    save_to_zip_file(tmp_path / "model.zip", params=make().get_parameters())
    with pytest.raises(ValueError, match=r"without the model's settings \(no entry `data`\): save it by the model's save\(\)"):
        check_model_file(tmp_path / "model.zip")


def test_a_missing_file_is_missing(tmp_path):
    with pytest.raises(FileNotFoundError):
        check_model_file(tmp_path / "model.zip")


def test_saved_timesteps(tmp_path):
    save_model(make().learn(32), tmp_path / "model.zip")
    assert saved_timesteps(tmp_path / "model.zip") == 32


def normalized(**kwargs):
    return VecNormalize(make_vec_env("CartPole-v1", seed=0), **kwargs)


@pytest.mark.parametrize("algorithm", [PPO, DQN])
def test_checkpoints_are_those_of_sb3_under_the_same_names(algorithm, tmp_path):
    for callback, folder in ((CheckpointCallback, "sb3"), (SafeCheckpointCallback, "safe")):
        kwargs = dict(buffer_size=50, learning_starts=100) if algorithm is DQN else {}
        model = make(algorithm, normalized(), **kwargs)
        arguments = dict(save_replay_buffer=True, save_vecnormalize=True)
        model.learn(32, callback=callback(16, str(tmp_path / folder), name_prefix="x", **arguments))
    assert sorted(os.listdir(tmp_path / "sb3")) == sorted(os.listdir(tmp_path / "safe"))
    for steps in (16, 32):
        sb3, safe = (load_from_pkl(tmp_path / folder / f"x_vecnormalize_{steps}_steps.pkl") for folder in ("sb3", "safe"))
        assert np.array_equal(sb3.obs_rms.mean, safe.obs_rms.mean)
        check_model_file(tmp_path / "safe" / f"x_{steps}_steps.zip")
        assert saved_timesteps(tmp_path / "safe" / f"x_{steps}_steps.zip") == steps


def test_the_options_of_the_checkpoint_callback_hold(tmp_path):
    make(env=normalized()).learn(32, callback=SafeCheckpointCallback(16, str(tmp_path)))
    assert sorted(os.listdir(tmp_path)) == ["rl_model_16_steps.zip", "rl_model_32_steps.zip"]


def test_best_model(tmp_path):
    save = SaveBestModel(tmp_path / "best_model.zip", tmp_path / "of_best" / "vecnormalize.pkl")
    evaluation = EvalCallback(normalized(training=False), save, n_eval_episodes=1, eval_freq=16, verbose=0)
    make(env=normalized()).learn(16, callback=evaluation)
    assert saved_timesteps(tmp_path / "best_model.zip") == 16
    assert load_from_pkl(tmp_path / "of_best" / "vecnormalize.pkl").obs_rms.count == pytest.approx(17, abs=1e-3)


@pytest.mark.parametrize("cls", [VecNormalize, TaskVecNormalize])
def test_statistics_are_loaded_and_settings_kept(cls, tmp_path):
    def wrap(**kwargs):
        return cls(make_vec_env("Continual/CartPole-v1", env_kwargs=dict(steps_per_task=8)), **kwargs)

    saved = wrap(clip_obs=3.0)
    saved.reset()
    for _ in range(10):
        saved.step([0])
    saved.save(str(tmp_path / "vecnormalize.pkl"))
    loaded = wrap(clip_obs=5.0)
    load_statistics(loaded, tmp_path / "vecnormalize.pkl")
    assert np.array_equal(loaded.obs_rms.mean, saved.obs_rms.mean) and loaded.ret_rms.var == saved.ret_rms.var
    assert loaded.clip_obs == 5.0 and loaded.venv is not None
    if cls is TaskVecNormalize:
        assert loaded._switch.task_id == 1
    with pytest.raises(ValueError, match=r"are of norm_obs=True, but training has norm_obs=False"):
        load_statistics(wrap(norm_obs=False), tmp_path / "vecnormalize.pkl")
    with pytest.raises(AssertionError, match="spaces must have the same shape"):  # SB3's
        load_statistics(VecNormalize(make_vec_env("Acrobot-v1")), tmp_path / "vecnormalize.pkl")
