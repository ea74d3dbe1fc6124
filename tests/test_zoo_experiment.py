"""Training by the command line: folders of its own, and going on from a saved model."""

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import yaml
from rl_zoo3.callbacks import ParallelTrainCallback
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.save_util import load_from_pkl
from stable_baselines3.common.vec_env import DummyVecEnv, unwrap_vec_normalize

from sb3_cchain import CChainPPO, CChainSAC
from sb3_cchain.algorithms.contrib import CChainTQC
from sb3_cchain.callbacks import read_returns
from sb3_cchain.checkpoint import saved_timesteps
from sb3_cchain.zoo.experiment import ExperimentManager, make_run_folder, statistics_path
from tests.envs import CountEnv
from tests.zoo_command import FAST, NO_EVALUATION, SHORT_PPO, command

ENV = "Continual/CartPole-v1"
NAME = "Continual-CartPole-v1"


def train(folder, *arguments, params=(), algo="ppo_cchain"):
    command(
        *("train", "--algo", algo, "--env", ENV, "-f", folder / "logs", "-tb", folder / "tb", *FAST, "--seed", "0"),
        *("--env-kwargs", "steps_per_task:64", "n_tasks:3", *arguments, *SHORT_PPO, *params),
    )


def run_folder(folder, number, algo="ppo_cchain"):
    return folder / "logs" / algo / f"{NAME}_{number}"


class Spy(BaseCallback):
    """What training began with, and the learning rates."""

    def __init__(self, seen):
        super().__init__()
        self.seen = seen

    def _on_training_start(self):
        normalize = unwrap_vec_normalize(self.training_env)
        self.seen.update(
            timesteps=self.num_timesteps,
            task=self.training_env.get_attr("task_id")[0],
            count=normalize.obs_rms.count if normalize else None,
            progress=[],
        )

    def _on_rollout_end(self):
        self.model._update_current_progress_remaining(self.num_timesteps, self.model._total_timesteps)
        self.seen["progress"].append(self.model._current_progress_remaining)

    def _on_step(self):
        return True


@pytest.fixture
def seen(monkeypatch):
    found = {}
    init = BaseAlgorithm._init_callback

    def with_spy(self, callback, progress_bar=False):
        # Last, after the callbacks that put the environment on its task
        return init(self, [*(callback if isinstance(callback, list) else [callback]), Spy(found)], progress_bar)

    monkeypatch.setattr(BaseAlgorithm, "_init_callback", with_spy)
    return found


@pytest.mark.parametrize("algo, cls", [("ppo", PPO), ("ppo_cchain", CChainPPO), ("ppo_oracle", PPO)])
def test_training_goes_on_at_its_step_and_task(algo, cls, tmp_path, seen):
    train(tmp_path, "-n", 64, *NO_EVALUATION, algo=algo)
    assert (seen["timesteps"], seen["task"]) == (0, 0)
    train(tmp_path, "-n", 96, *NO_EVALUATION, "-i", run_folder(tmp_path, 1, algo) / f"{NAME}.zip", algo=algo)
    assert (seen["timesteps"], seen["task"]) == (64, 1)
    model = cls.load(run_folder(tmp_path, 2, algo) / f"{NAME}.zip", device="cpu")
    assert (model.num_timesteps, model.trained_task_id if hasattr(model, "trained_task_id") else 2) == (160, 2)
    # 96 more, and the schedules go on from where 64 of 160 steps are
    assert seen["progress"] == pytest.approx([1 - 96 / 160, 1 - 128 / 160, 0])
    first, second = (read_returns(tmp_path / "tb" / NAME / f"{cls.__name__}_{number}" / "returns.csv") for number in (1, 2))
    assert second[: len(first)] == first
    assert {row["task_id"] for row in second} == {0, 1, 2} and second[-1]["timesteps"] == 160


@pytest.mark.parametrize("algo, cls", [("sac_cchain", CChainSAC), ("tqc_cchain", CChainTQC), ("sac", SAC)])
def test_training_in_parallel_trains_a_model_of_the_same_class(algo, cls, tmp_path, monkeypatch):
    trained = set()
    monkeypatch.setattr(ParallelTrainCallback, "train", lambda self: trained.add(type(self._model)))
    monkeypatch.setattr(ParallelTrainCallback, "_on_training_end", lambda self: None)  # which waits for the thread
    command(
        *("train", "--algo", algo, "--env", "Pendulum-v1", "-n", 40, "-f", tmp_path, *FAST, *NO_EVALUATION),
        *("-params", "callback:'rl_zoo3.callbacks.ParallelTrainCallback'", "learning_starts:10", "train_freq:10"),
        *("normalize:False", "policy_kwargs:dict(net_arch=[8])", "use_sde:False"),
    )
    assert trained == {cls}


def test_without_a_number_training_goes_on_to_that_of_the_settings(tmp_path, seen):
    train(tmp_path, *NO_EVALUATION, "--save-freq", 64, params=["n_timesteps:128"])
    checkpoint = run_folder(tmp_path, 1) / "rl_model_64_steps.zip"
    train(tmp_path, *NO_EVALUATION, "-i", checkpoint, params=["n_timesteps:128"])
    assert seen["progress"] == pytest.approx([1 - 96 / 128, 0])
    final = run_folder(tmp_path, 2) / f"{NAME}.zip"
    assert saved_timesteps(final) == 128
    with pytest.raises(ValueError, match=r"was trained for 128 steps, and the settings have 128\. .* -n STEPS"):
        train(tmp_path, *NO_EVALUATION, "-i", final, params=["n_timesteps:128"])
    assert not run_folder(tmp_path, 3).exists()


# EpisodicRollouts, of the settings, would begin each rollout with a reset, whose observation counts
CALLBACKS = "callback:['sb3_cchain.TaskSync', 'sb3_cchain.ContinualMetrics']"
NORMALIZATIONS = {
    "normalize": "normalize:True",
    "wrapper": "vec_env_wrapper:[{'sb3_cchain.envs.TaskVecNormalize': {'clip_obs': 5.0}}]",
}


@pytest.mark.parametrize("by", NORMALIZATIONS)
def test_statistics_go_on(by, tmp_path, seen):
    normalize = [NORMALIZATIONS[by], CALLBACKS]
    evaluation = () if by == "wrapper" else ("--eval-freq", "32", "--eval-episodes", "1")
    train(tmp_path, "-n", 96, *(evaluation or NO_EVALUATION), "--save-freq", 48, params=normalize)
    folder = run_folder(tmp_path, 1)
    counts = {
        # The first observation of a task is the first in its statistics
        "rl_model_48_steps.zip": 49,
        "rl_model_96_steps.zip": 33,
        f"{NAME}.zip": 33,
    }
    for name, count in counts.items():
        assert load_from_pkl(statistics_path(folder / name, NAME)).obs_rms.count == pytest.approx(count, abs=1e-3)
        train(tmp_path, "-n", 32, *NO_EVALUATION, "-i", folder / name, params=normalize)
        # and that of the reset is in them, too
        assert seen["count"] == pytest.approx(count + 1, abs=1e-3), name


def test_statistics_that_are_missing_are_an_error_before_anything_is_made(tmp_path):
    normalize = [NORMALIZATIONS["normalize"]]
    train(tmp_path, "-n", 64, *NO_EVALUATION, "--save-freq", 64, params=normalize)
    folder = run_folder(tmp_path, 1)
    for name in ("rl_model_64_steps.zip", f"{NAME}.zip"):
        path = statistics_path(folder / name, NAME)
        os.rename(path, tmp_path / "elsewhere.pkl")
        with pytest.raises(ValueError, match=f"there is no file {path}$"):
            train(tmp_path, "-n", 64, *NO_EVALUATION, "-i", folder / name, params=normalize)
        os.rename(tmp_path / "elsewhere.pkl", path)
        with pytest.raises(ValueError, match=rf"was trained with normalisation \({path}\): keep `normalize`"):
            train(tmp_path, "-n", 64, *NO_EVALUATION, "-i", folder / name)
        run_folder(tmp_path, 2).rename(tmp_path / f"unnormalised_{name}")
    assert not run_folder(tmp_path, 2).exists()


def test_a_torn_model_names_the_newest_whole_one(tmp_path):
    train(tmp_path, "-n", 64, *NO_EVALUATION, "--save-freq", 32)
    torn, whole = (run_folder(tmp_path, 1) / name for name in (f"{NAME}.zip", "rl_model_64_steps.zip"))
    torn.write_bytes(torn.read_bytes()[:1000])
    with pytest.raises(ValueError, match=f"{torn} is torn.* newest whole model beside it is {whole}"):
        train(tmp_path, "-n", 64, *NO_EVALUATION, "-i", torn)
    assert not run_folder(tmp_path, 2).exists()


class Killed(BaseException):
    """In the place of a signal that ends the process."""


def test_a_kill_while_a_model_is_written_tears_none(tmp_path, monkeypatch):
    """Checkpoints, the best model and the final one."""
    folder = run_folder(tmp_path, 1)
    evaluation = ("--eval-freq", "32", "--eval-episodes", "1")
    train(tmp_path, "-n", 32, "--save-freq", 32, *evaluation)
    assert {f"{NAME}.zip", "best_model.zip", "rl_model_32_steps.zip"} <= set(os.listdir(folder))
    written = []

    def save_half(self, path, *args, **kwargs):
        written.append(os.path.basename(path))
        with open(path, "wb") as file:
            file.write(b"half a mo")
        raise Killed()

    monkeypatch.setattr(BaseAlgorithm, "save", save_half)
    for number, options in enumerate((("--save-freq", "32", *NO_EVALUATION), evaluation, NO_EVALUATION), start=2):
        with pytest.raises(Killed):
            train(tmp_path, "-n", 32, *options)
        assert not list(run_folder(tmp_path, number).glob("*.zip"))
    assert written == [f".{name}.zip.unfinished" for name in ("rl_model_32_steps", "best_model", NAME)]


def test_normalize_is_restarted_at_each_task_unless_the_settings_say_otherwise(tmp_path):
    for number, (normalize, count) in enumerate((("True", 33), ("dict(restart=False)", 97)), start=1):
        train(tmp_path, "-n", 96, *NO_EVALUATION, params=[f"normalize:{normalize}", CALLBACKS])
        statistics = load_from_pkl(run_folder(tmp_path, number) / NAME / "vecnormalize.pkl")
        assert statistics.obs_rms.count == pytest.approx(count, abs=1e-3)
        assert statistics.gamma == 0.99 and statistics.norm_reward


@pytest.mark.parametrize("eval_env", [False, True])
def test_evaluations_leave_statistics_and_rewards_as_they_are(eval_env):
    manager = object.__new__(ExperimentManager)
    manager.normalize, manager.normalize_kwargs = True, {"norm_reward": True, "clip_obs": 5.0}
    env = manager._maybe_normalize(DummyVecEnv([CountEnv]), eval_env)
    assert (env.training, env.norm_reward, env.clip_obs) == (not eval_env, not eval_env, 5.0)


def test_an_evaluation_of_the_settings_keeps_its_own_files(tmp_path):
    """That of the command line saves the best model more safely."""
    (tmp_path / "best").mkdir()
    own = EvalCallback(DummyVecEnv([CountEnv]), best_model_save_path=str(tmp_path / "best"))
    manager = object.__new__(ExperimentManager)
    vars(manager).update(callbacks=[own], checkpoints=None, show_progress=False, save_freq=-1, eval_freq=-1)
    manager.create_callbacks()
    assert manager.callbacks == [own] and own.best_model_save_path == str(tmp_path / "best")


# --- Folders --------------------------------------------------------------------------------------------------------------


def test_each_training_has_its_own_folders(tmp_path, monkeypatch):
    # As if another training had asked at the same time
    monkeypatch.setattr("sb3_cchain.zoo.experiment.get_latest_run_id", lambda *_: 0)
    for number in (1, 2):
        train(tmp_path, "-n", 32, *NO_EVALUATION)
        assert saved_timesteps(run_folder(tmp_path, number) / f"{NAME}.zip") == 32
        assert (tmp_path / "tb" / NAME / f"CChainPPO_{number}" / "returns.csv").is_file()


def test_a_unique_id_stays_in_the_name(tmp_path):
    train(tmp_path, "-n", 32, *NO_EVALUATION, "--uuid")
    (folder,) = (tmp_path / "logs" / "ppo_cchain").iterdir()
    assert len(folder.name) == len(f"{NAME}_1_") + 36 and (folder / f"{NAME}.zip").is_file()


def _make_many(folder):
    return [str(make_run_folder(folder, "run")) for _ in range(20)]


def test_run_folders_are_never_shared(tmp_path):
    with ThreadPoolExecutor(4) as pool:
        made = [folder for folders in pool.map(_make_many, [tmp_path / "runs"] * 4) for folder in folders]
    assert sorted(made) == sorted(str(tmp_path / "runs" / f"run_{number}") for number in range(1, 81))


def test_what_rl_zoo_saves_beside_a_model_is_as_before(tmp_path):
    train(tmp_path, "-n", 32, "--eval-freq", "32", "--eval-episodes", "1")
    folder = run_folder(tmp_path, 1)
    assert {path.name for path in (folder / NAME).iterdir()} == {"args.yml", "command.txt", "config.yml"}
    assert yaml.load((folder / NAME / "args.yml").read_text(), yaml.UnsafeLoader)["algo"] == "ppo_cchain"
    assert np.load(folder / "evaluations.npz")["timesteps"].tolist() == [32]
