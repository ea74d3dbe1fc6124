"""What the commands do for models that are evaluated and played: masks of actions, and statistics of normalisation."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from rl_zoo3.utils import get_saved_hyperparams
from sb3_contrib import MaskablePPO
from sb3_contrib.common.wrappers import ActionMasker
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize, unwrap_vec_normalize

from sb3_cchain import ContinualEnv, TaskSync
from sb3_cchain.analysis import EvalTrainedTask
from sb3_cchain.zoo.as_trained import make_as_trained
from sb3_cchain.zoo.playing import Playing
from tests.zoo_command import FAST, NO_EVALUATION, SHORT_PPO, command, search_short_rollouts


class OneAllowed(gym.Env):
    """Of ten actions one is allowed, another one at each step; all others are counted. Episodes of five steps."""

    n_forbidden = 0
    observation_space = spaces.Box(0, 1, (1,), np.float32)
    action_space = spaces.Discrete(10)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n_steps = 0
        return np.zeros(1, np.float32), {}

    def action_masks(self):
        return np.arange(10) == 3 * self.n_steps % 10

    def step(self, action):
        OneAllowed.n_forbidden += not self.action_masks()[action]
        self.n_steps += 1
        return np.zeros(1, np.float32), 1.0, self.n_steps >= 5, False, {}


@pytest.fixture(autouse=True)
def nothing_is_forbidden(monkeypatch):
    monkeypatch.setitem(gym.registry, "OneAllowed-v0", EnvSpec("OneAllowed-v0", f"{__name__}:OneAllowed"))
    yield
    assert OneAllowed.n_forbidden == 0


def train(folder, *arguments, algo="ppo_mask_cchain", env="OneAllowed-v0", n=64, evaluation=NO_EVALUATION, params=()):
    arguments = ("train", "--algo", algo, "--env", env, "-f", folder, "-n", n, "--seed", 0, *FAST, *evaluation, *arguments)
    command(*arguments, *SHORT_PPO, *params)


def enjoy(folder, *arguments, algo="ppo_mask_cchain", env="OneAllowed-v0"):
    command("enjoy", "--algo", algo, "--env", env, "-f", folder, "--no-render", "-n", 20, "--device", "cpu", *arguments)


def test_maskable_ppo_is_evaluated_and_played_with_masks(tmp_path):
    train(tmp_path, evaluation=("--eval-freq", 32, "--eval-episodes", 2))
    evaluations = np.load(tmp_path / "ppo_mask_cchain/OneAllowed-v0_1/evaluations.npz")
    assert evaluations["ep_lengths"].tolist() == [[5, 5]] * 2
    enjoy(tmp_path)


def test_the_search_evaluates_with_masks(tmp_path, monkeypatch):
    search_short_rollouts(monkeypatch, MaskablePPO)
    evaluation = ("--eval-episodes", 1, "--n-evaluations", 1)
    train(tmp_path, "-optimize", "--n-trials", 1, "--n-startup-trials", 1, evaluation=evaluation, n=32)


def test_tasks_are_evaluated_with_masks():
    env, eval_env = (
        ActionMasker(ContinualEnv([OneAllowed] * 2, 32), lambda env: env.unwrapped.task.action_masks()) for _ in range(2)
    )
    model = MaskablePPO("MlpPolicy", env, n_steps=32, batch_size=16, n_epochs=1, device="cpu")
    model.learn(64, [TaskSync(), EvalTrainedTask(eval_env, n_eval_episodes=2)])
    assert [row["mean_return"] for row in model.evaluations] == [5.0] * 3


# --- Statistics of normalisation -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def normalised(tmp_path_factory):
    """A run folder with checkpoints of both kinds, of eight environments."""
    folder = tmp_path_factory.mktemp("normalised")
    evaluation = ("--eval-freq", 160, "--eval-episodes", 1)  # one alone, at step 160
    options = ("--save-freq", 32, "--checkpoint-freq", 32)
    train(folder, *options, algo="ppo", env="CartPole-v1", params=("normalize:True",), evaluation=evaluation)
    return folder / "ppo/CartPole-v1_1"


COUNTS = [("CartPole-v1.zip", 8 + 256), ("rl_model_32_steps.zip", 8 + 32), ("best_model.zip", 8 + 160)]


@pytest.mark.parametrize("name, count", COUNTS)
def test_a_model_is_played_with_its_statistics(normalised, name, count):
    settings, statistics = get_saved_hyperparams(str(normalised / "CartPole-v1"))
    playing = Playing()
    env = playing.create_env("CartPole-v1", settings, {}, stats_path=statistics, should_render=False)
    playing.algorithm(PPO).load(normalised / name)
    assert unwrap_vec_normalize(env).obs_rms.count == pytest.approx(count, abs=0.01)


@pytest.mark.parametrize("name, count", COUNTS)
def test_a_model_is_inspected_with_its_statistics(normalised, name, count):
    env, _ = make_as_trained(normalised / name, "CartPole-v1", 1, 0, {}, None)
    assert env.obs_rms.count == pytest.approx(count, abs=0.01) and not isinstance(env.venv, VecNormalize)


def test_the_statistics_that_are_given_take_their_place(normalised):
    statistics = normalised / "rl_model_vecnormalize_32_steps.pkl"
    for name in ("CartPole-v1.zip", "checkpoints/step_000000000032/model.zip"):
        env, _ = make_as_trained(normalised / name, "CartPole-v1", 1, 0, {}, statistics)
        assert env.obs_rms.count == pytest.approx(8 + 32, abs=0.01) and not isinstance(env.venv, VecNormalize)


def test_a_checkpoint_with_normalisation_needs_statistics(normalised):
    with pytest.raises(ValueError, match="its statistics are within the checkpoint: give a file of them as --vec-normalize"):
        make_as_trained(normalised / "checkpoints/step_000000000032/model.zip", "CartPole-v1", 1, 0, {}, None)


def test_packages_that_register_environments(tmp_path, capsys):
    (tmp_path / "model.zip").touch()
    arguments = ("inspect", tmp_path / "model.zip", "--env", "CartPole-v1", "--output", tmp_path)
    for package, message in (("no_such_package", "--gym-packages no_such_package: No module"), ("tests.envs", "not a saved")):
        with pytest.raises(SystemExit):
            command(*arguments, "--gym-packages", package)
        assert message in capsys.readouterr().err
