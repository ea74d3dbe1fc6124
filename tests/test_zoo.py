"""RL Zoo's command line with our algorithms, and the stock one."""

import os
import re
import shutil
import subprocess
import sys
from importlib import import_module

import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import Autoreset
from rl_zoo3 import ALGOS
from stable_baselines3 import DQN, PPO
from stable_baselines3.common import buffers, callbacks
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_pkl
from stable_baselines3.common.vec_env import VecEnvWrapper

import sb3_cchain.methods
import sb3_cchain.zoo
import sb3_cchain.zoo.__main__ as console
import sb3_cchain.zoo.cli as zoo
from sb3_cchain import CChainDQN, CChainPPO, DoubleDQN
from sb3_cchain.callbacks import read_returns
from sb3_cchain.envs import RewardScale, TaskCaption, TaskVecNormalize
from sb3_cchain.envs.task_caption import with_caption
from sb3_cchain.methods.registry import REGISTRY
from sb3_cchain.zoo.playing import Playing
from tests.extras import needs_dm_control
from tests.zoo_command import FAST, NO_EVALUATION, ROOT, SHORT_PPO, command, run, stock_train

ACROBOT = (
    *("--env", "Continual/Acrobot-v1", "-n", "1600", "--env-kwargs", "steps_per_task:800", "--seed", "1", *FAST),
    *("--eval-freq", "800", "--eval-episodes", "2"),
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of 1600 steps over two tasks by each algorithm."""
    folder = tmp_path_factory.mktemp("zoo")
    for algo in ("ppo", "ppo_cchain"):
        command("train", "--algo", algo, *ACROBOT, "-f", folder / "logs", "-tb", folder / "tb", "--n-eval-envs", "2")
    return folder


@pytest.mark.parametrize("algo, cls", [("ppo", PPO), ("ppo_cchain", CChainPPO)])
def test_train_finds_our_hyperparameters(trained, algo, cls):
    folder = trained / "logs" / algo / "Continual-Acrobot-v1_1"
    model = cls.load(folder / "Continual-Acrobot-v1.zip", device="cpu")
    assert (model.n_steps, model.batch_size, model.n_epochs, model.ent_coef) == (800, 32, 5, 0.01)
    assert model.policy.mlp_extractor.policy_net[1].negative_slope == 0.1
    assert model.policy.optimizer.defaults["eps"] == 1e-8
    if algo == "ppo_cchain":
        assert model.churn_reducer.coefficient.target_ratio == 1e4
        # Task 0's iteration was forgotten at the switch
        assert model.churn_reducer.coefficient.n_seen == 1


@pytest.mark.parametrize("algo", ["ppo", "ppo_cchain"])
def test_a_zoo_run_writes_returns_that_no_reward_scale_touched(trained, algo):
    (path,) = (trained / "tb").glob(f"*/{'PPO' if algo == 'ppo' else 'CChainPPO'}_1/returns.csv")
    rows = read_returns(path)
    assert [(row["timesteps"], row["task_id"]) for row in rows] == [(800, 0), (1600, 1)]
    assert all(-400 <= row["mean_return"] <= -40 for row in rows)
    monitor = (trained / "logs" / algo / "Continual-Acrobot-v1_1" / "0.monitor.csv").read_text().splitlines()
    assert monitor[1] == "r,l,t,task_id"
    assert {line.split(",")[3] for line in monitor[2:]} == {"0", "1"}


def test_the_stock_command_reaches_c_chain_through_a_callback(tmp_path, trained):
    run(
        *("rl_zoo3.train", "--algo", "ppo", "--gym-packages", "sb3_cchain", *ACROBOT, "-f", "logs", "-tb", "tb"),
        *("-conf", str(ROOT / "zoo_hyperparams" / "ppo_cchain_callback.yml")),
        cwd=tmp_path,
    )
    stock = PPO.load(tmp_path / "logs/ppo/Continual-Acrobot-v1_1/Continual-Acrobot-v1.zip", device="cpu")
    by_our_command = CChainPPO.load(trained / "logs/ppo_cchain/Continual-Acrobot-v1_1/Continual-Acrobot-v1.zip", device="cpu")
    for name, tensor in by_our_command.policy.state_dict().items():
        assert th.equal(tensor, stock.policy.state_dict()[name]), name
    assert len(read_returns(next((tmp_path / "tb").glob("*/PPO_1/returns.csv")))) == 2


def test_enjoy(trained, capsys):
    command(
        *("enjoy", "--algo", "ppo_cchain", "--env", "Continual/Acrobot-v1", "-f", trained / "logs", "-n", "801"),
        *("--no-render", "--device", "cpu", "--env-kwargs", "first_task:1"),
    )
    output = capsys.readouterr().out
    # 801 steps are at least two episodes of at most 400
    (n_episodes,) = re.findall(r"^(\d+) Episodes", output, flags=re.MULTILINE)
    assert int(n_episodes) >= 2
    (mean_reward,) = re.findall(r"^Mean reward: (-?[\d.]+)", output, flags=re.MULTILINE)
    assert -20 <= float(mean_reward) < 0  # scaled by 1/20


def test_plots(trained, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("matplotlib.pyplot.show", lambda: None)
    # RL Zoo compares algorithms of several runs each
    for algo in ("ppo", "ppo_cchain"):
        for number in (1, 2):
            shutil.copytree(
                trained / "logs" / algo / "Continual-Acrobot-v1_1", tmp_path / "logs" / algo / f"Continual-Acrobot-v1_{number}"
            )
    command("plot_train", "-a", "ppo_cchain", "-e", "Continual-Acrobot", "-f", "logs", "-w", "2")
    environment = ("-e", "Continual-Acrobot", "-f", "logs")
    command("all_plots", "-a", "ppo", "ppo_cchain", *environment, "--no-million", "-o", "results")
    arguments = ("-i", "results.pkl", "-l", "PPO", "C-CHAIN", "--skip-timesteps", "-b", "-o", "plot.png", "--format", "png")
    command("plot_from_file", *arguments)
    assert (tmp_path / "plot.png").stat().st_size > 1000


@pytest.mark.parametrize("algo", ["ppo", "ppo_cchain"])
def test_evaluation_in_a_zoo_run_follows_the_task(algo, tmp_path, monkeypatch):
    """The evaluation environments are RL Zoo's own."""
    tasks, evaluate_policy = [], callbacks.evaluate_policy

    def spy(model, env, **kwargs):
        result = evaluate_policy(model, env, **kwargs)
        tasks.append((model.num_timesteps, env.get_attr("task_id")))
        return result

    monkeypatch.setattr(zoo, "evaluate_policy", spy)
    command(
        *("train", "--algo", algo, "--env", "Continual/CartPole-v1", "-n", "96", "-f", tmp_path, *FAST, *SHORT_PPO),
        *("--env-kwargs", "steps_per_task:32", "--eval-freq", "16", "--eval-episodes", "1"),
    )
    # The step that ends a task is still of that task
    assert tasks == [(16, [0]), (32, [0]), (48, [1]), (64, [1]), (80, [2]), (96, [2])]


# Three games of 100 steps, the random ones at the beginning of each cut to 20
MINATAR = [
    *("--env", "Continual/MinAtar-v0", "-n", "300", "--env-kwargs", "steps_per_task:100", "--eval-freq", "100"),
    *("--eval-episodes", "1", *FAST, "--seed", "1", "-params"),
    "callback:['sb3_cchain.TaskSync', 'sb3_cchain.ContinualMetrics', "
    "{'sb3_cchain.callbacks.TaskLearningStarts': {'learning_starts': 20}}]",
    "buffer_size:1000",
]


def test_dqn_cchain_on_minatar(tmp_path, capsys):
    folders = ("-f", tmp_path / "logs", "-tb", tmp_path / "tb", "--save-replay-buffer")
    command("train", "--algo", "dqn_cchain", *MINATAR, "churn_warmup:10", *folders)
    folder = tmp_path / "logs" / "dqn_cchain" / "Continual-MinAtar-v0_1"
    model = CChainDQN.load(folder / "Continual-MinAtar-v0.zip", device="cpu")
    assert (model.loss, model.double_q, model.learning_rate(1), model.max_grad_norm) == ("mse", True, 3e-4, np.inf)
    assert sum(p.numel() for p in model.q_net.parameters()) == 16 * (3 * 3 * 10 + 1) + 128 * (8 * 8 * 16 + 1) + 6 * 129
    assert model._n_updates == 79 + 79 + 80
    assert model.churn_reducer.coefficient.n_seen == model._n_updates - 1
    assert model.churn_reducer.coefficient.value != 50
    assert (folder / "replay_buffer.pkl").exists()
    (path,) = (tmp_path / "tb").glob("*/CChainDQN_1/returns.csv")
    assert {row["task_id"] for row in read_returns(path)} == {0, 1, 2}
    assert list(np.load(folder / "evaluations.npz")["timesteps"]) == [100, 200, 300]
    arguments = ("--env", "Continual/MinAtar-v0", "-f", tmp_path / "logs", "-n", "600", "--no-render", "--device", "cpu")
    command("enjoy", "--algo", "dqn_cchain", *arguments)
    assert re.search(r"^Mean reward: \d", capsys.readouterr().out, flags=re.MULTILINE)


def test_the_stock_command_trains_dqn_on_minatar(tmp_path):
    settings = ROOT / "zoo_hyperparams" / "dqn.yml"
    stock_train("--algo", "dqn", "--gym-packages", "sb3_cchain", "-conf", settings, *MINATAR, "-f", tmp_path)
    model = DQN.load(tmp_path / "dqn/Continual-MinAtar-v0_1/Continual-MinAtar-v0.zip", device="cpu")
    assert type(model) is DQN and model._n_updates == 79 + 79 + 80


def test_oracle_of_minatar_begins_each_game_with_an_empty_buffer(tmp_path):
    command(
        *("train", "--algo", "double_dqn_oracle", "--env", "Continual/MinAtar-v0", "-n", "250", "-f", tmp_path, *FAST),
        *("--env-kwargs", "steps_per_task:100", *NO_EVALUATION, "--save-replay-buffer", "-params", "buffer_size:1000"),
    )
    (folder,) = tmp_path.glob("double_dqn_oracle/Continual-MinAtar-v0_1")
    model = DoubleDQN.load(folder / "Continual-MinAtar-v0.zip", device="cpu")
    assert (model.trained_task_id, model.double_q, model._n_updates) == (2, True, 0)
    assert load_from_pkl(folder / "replay_buffer.pkl").size() == 50


@needs_dm_control
def test_walker_with_normalisation_that_restarts(tmp_path, capsys):
    command(
        *("train", "--algo", "ppo_cchain", "--env", "Continual/Walker-v0", "-n", "400", "-f", tmp_path, "--seed", "1", *FAST),
        *("--env-kwargs", "steps_per_task:300", "--eval-freq", "400", "--eval-episodes", "1"),
        *("-params", "n_steps:200", "n_epochs:1", "batch_size:100"),
    )
    folder = tmp_path / "ppo_cchain" / "Continual-Walker-v0_1"
    statistics = load_from_pkl(folder / "Continual-Walker-v0" / "vecnormalize.pkl")
    assert type(statistics) is TaskVecNormalize and statistics.returns_over_cuts
    # Of the second task alone: 100 steps and the observation they begin with; RunningMeanStd begins with a count of 1e-4
    assert statistics.obs_rms.count == pytest.approx(101, abs=1e-3)
    model = CChainPPO.load(folder / "Continual-Walker-v0.zip", device="cpu")
    assert (model.churn_reducer.coefficient.initial, model.churn_reducer.coefficient.target_ratio) == (100, 0.5)
    assert model.churn_base_loss == "last"
    assert [type(layer) for layer in model.policy.mlp_extractor.policy_net] == [th.nn.Linear, th.nn.ReLU] * 2
    arguments = ("--algo", "ppo_cchain", "--env", "Continual/Walker-v0", "-f", tmp_path, "-n", "1001", "--no-render")
    command("enjoy", *arguments, "--device", "cpu", "--env-kwargs", "first_task:1")
    output = capsys.readouterr().out
    assert "Loading running average" in output and re.search(r"^Mean reward: ", output, flags=re.MULTILINE)


def test_a_method_by_either_command(tmp_path, capsys):
    """Our ``train`` and ``enjoy``, and the stock ``train``."""
    arguments = ("--env", "Continual/Acrobot-v1", "-n", "1600", "--env-kwargs", "steps_per_task:800", "--seed", "1", *FAST)
    arguments += (*NO_EVALUATION, "-f", tmp_path / "logs", "-tb", tmp_path / "tb", "-params", "n_epochs:1")
    command("train", "--algo", "ppo_trac", *arguments)
    settings = ROOT / "zoo_hyperparams" / "ppo_trac.yml"
    stock_train("--algo", "ppo", "--gym-packages", "sb3_cchain", "-conf", settings, *arguments)
    by_our_command, stock = (
        PPO.load(tmp_path / "logs" / algo / "Continual-Acrobot-v1_1" / "Continual-Acrobot-v1.zip", device="cpu")
        for algo in ("ppo_trac", "ppo")
    )
    assert type(by_our_command.policy.optimizer) is type(stock.policy.optimizer) is sb3_cchain.methods.TRAC
    for name, tensor in by_our_command.policy.state_dict().items():
        assert th.equal(tensor, stock.policy.state_dict()[name]), name
    for number in (1, 2):
        rows = read_returns(tmp_path / "tb" / "Continual-Acrobot-v1" / f"PPO_{number}" / "returns.csv")
        assert [(row["timesteps"], row["task_id"]) for row in rows] == [(800, 0), (1600, 1)]
    command(
        *("enjoy", "--algo", "ppo_trac", "--env", "Continual/Acrobot-v1", "-f", tmp_path / "logs", "-n", "401"),
        *("--no-render", "--device", "cpu"),
    )
    assert re.search(r"^Mean reward: -\d", capsys.readouterr().out, flags=re.MULTILINE)


# --- Commands -------------------------------------------------------------------------------------------------------------


def test_unknown_environment_names_the_nearest():
    with pytest.raises(ValueError, match="you maybe meant Continual/Acrobot-v1"):
        command("train", "--algo", "ppo_cchain", "--env", "Continual/Acrobat-v1")


@pytest.mark.parametrize("playing", [None, Playing()])
def test_all_methods_are_known(playing):
    zoo.register_algorithms(playing)
    for method in REGISTRY:
        assert issubclass(ALGOS[method.algo], method.algorithm)
        assert (ALGOS[method.algo] is method.algorithm) == (not playing)


OFF_POLICY = ["dqn", "crossq", *(method.algo for method in REGISTRY if issubclass(method.algorithm, OffPolicyAlgorithm))]


@pytest.mark.parametrize("algo", OFF_POLICY)
def test_playing_makes_no_replay_buffer(algo, tmp_path, monkeypatch):
    zoo.register_algorithms()
    algorithm = ALGOS[algo]
    is_discrete = "dqn" in algo
    env = "CartPole-v1" if is_discrete else "Pendulum-v1"
    sizes, make = [], buffers.ReplayBuffer.__init__

    def spy(self, buffer_size, *args, **kwargs):
        sizes.append(buffer_size)
        make(self, buffer_size, *args, **kwargs)

    monkeypatch.setattr(buffers.ReplayBuffer, "__init__", spy)
    settings = dict(optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False))
    algorithm("MlpPolicy", env, buffer_size=1000, device="cpu", **settings).save(tmp_path / algo / f"{env}.zip")
    command("enjoy", "--algo", algo, "--env", env, "-f", tmp_path, "--exp-id", "-1", "-n", "2", "--no-render")
    assert sizes == [1000, 1]


def test_playing_a_torn_model_names_the_file(tmp_path):
    path = tmp_path / "ppo_cchain" / "CartPole-v1.zip"
    CChainPPO("MlpPolicy", "CartPole-v1", device="cpu").save(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match=f"{path} is torn"):
        command("enjoy", "--algo", "ppo_cchain", "--env", "CartPole-v1", "-f", tmp_path, "--exp-id", "-1", "--no-render")


class Frames(VecEnvWrapper):
    """In the place of the recorder, which needs moviepy."""

    def __init__(self, venv, folder, **kwargs):
        super().__init__(venv)
        self.path, self.frames = f"{folder}/{kwargs['name_prefix']}", []

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        step = self.venv.step_wait()
        self.frames.append(self.venv.render())
        return step


def test_record_video_has_the_task_on_each_frame(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(
        "stable_baselines3.common.vec_env.VecVideoRecorder",
        lambda *args, **kwargs: made.append(Frames(*args, **kwargs)) or made[-1],
    )
    CChainPPO("MlpPolicy", "Continual/CartPole-v1", device="cpu").save(tmp_path / "ppo_cchain" / "Continual-CartPole-v1.zip")
    arguments = ("--algo", "ppo_cchain", "--env", "Continual/CartPole-v1", "-f", tmp_path, "--exp-id", "-1", "-n", "4")
    command("record_video", *arguments, "-o", tmp_path / "videos", "--no-render", "--env-kwargs", "steps_per_task:2")
    (video,) = made
    assert video.path == str(tmp_path / "videos" / "final-model-ppo_cchain-Continual-CartPole-v1")
    # When a step has ended a task, the environment is already at the next
    for frame, task in zip(video.frames, (0, 1, 1, 2), strict=True):
        assert np.array_equal(frame, with_caption(frame, f"task {task}"))


@pytest.mark.parametrize(
    "settings, wrapper",
    [
        ({}, TaskCaption),
        (dict(env_wrapper=None), TaskCaption),
        (dict(env_wrapper="gymnasium.wrappers.Autoreset"), Autoreset),
        (dict(env_wrapper=[{"sb3_cchain.envs.RewardScale": {"scale": 2.0}}]), RewardScale),
    ],
)
def test_what_is_filmed_keeps_the_wrappers_of_the_settings(settings, wrapper):
    env = Playing().create_captioned_env(
        "Continual/CartPole-v1", hyperparams=settings, env_kwargs=dict(render_mode="rgb_array")
    )
    assert env.env_is_wrapped(wrapper) == env.env_is_wrapped(TaskCaption) == [True]


@pytest.mark.parametrize("create", [Playing().create_env, Playing().create_captioned_env])
def test_what_is_filmed_or_pushed_has_the_arguments_of_the_settings(create):
    settings = dict(env_kwargs=dict(n_tasks=2, steps_per_task=7))
    env = create("Continual/CartPole-v1", hyperparams=settings, env_kwargs=dict(steps_per_task=5, render_mode="rgb_array"))
    assert env.get_attr("n_tasks") == [2] and env.get_attr("steps_per_task") == [[5, 5]]


def test_record_training_records_by_our_command(tmp_path, monkeypatch):
    started = []
    monkeypatch.setattr(subprocess, "run", lambda command: started.append(command) or subprocess.CompletedProcess(command, 0))
    monkeypatch.setattr(os, "system", lambda command: 0)  # ffmpeg
    (tmp_path / "ppo_cchain").mkdir()
    for name in ("Continual-CartPole-v1.zip", "rl_model_100_steps.zip"):
        (tmp_path / "ppo_cchain" / name).touch()
    before = subprocess.call
    command("record_training", "--algo", "ppo_cchain", "--env", "Continual/CartPole-v1", "-f", tmp_path, "--exp-id", "-1")
    assert [started[i][:4] for i in (0, 1)] == [[sys.executable, "-m", "sb3_cchain.zoo", "record_video"]] * 2
    assert started[0][4:8] == ["--env", "Continual/CartPole-v1", "--algo", "ppo_cchain"]
    assert started[1][-2:] == ["--load-checkpoint", "100"]
    assert subprocess.call is before


def test_benchmark_enjoys_by_our_command(trained, tmp_path, monkeypatch, capsys):
    pytest.importorskip("pytablewriter")

    def run_in_process(arguments):
        assert arguments[:3] == [sys.executable, "-m", "sb3_cchain.zoo"]
        command(*arguments[3:])
        return subprocess.CompletedProcess(arguments, 0)

    monkeypatch.setattr(subprocess, "run", run_in_process)
    monkeypatch.chdir(tmp_path)
    shutil.copytree(trained / "logs" / "ppo_cchain", tmp_path / "logs" / "ppo_cchain")
    command("benchmark", "--log-dir", "logs", "--benchmark-dir", "table", "--no-hub", "--test-mode", "-n", "401")
    assert re.search(r"ppo_cchain *\| *Continual-Acrobot-v1", (tmp_path / "table" / "benchmark.md").read_text())


# --- What is printed where something is missing or old -------------------------------------------------------------------


def test_the_notice_of_the_old_gym_is_not_printed(tmp_path):
    """Neither on importing this package nor by a command that imports others, too."""
    output = run("benchmarks.run", "--help", cwd=tmp_path)
    assert "usage" in output and "Gym has been unmaintained" not in output


def test_without_rl_zoo_one_line_names_the_mend(monkeypatch):
    mend = 'needs RL Zoo .*pip install "sb3-cchain\\[zoo\\]"$'
    for name in [name for name in sys.modules if name.startswith("sb3_cchain.zoo.") or name.split(".")[0] == "rl_zoo3"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rl_zoo3", None)
    monkeypatch.delattr(sb3_cchain.zoo, "cli")
    with pytest.raises(ImportError, match=mend):
        import_module("sb3_cchain.zoo.cli")
    with pytest.raises(SystemExit, match="^sb3-cchain: The .*" + mend):
        monkeypatch.setattr(sys, "argv", ["sb3-cchain", "train"])
        import_module("sb3_cchain.zoo.__main__").main()


def test_help_and_version_need_no_rl_zoo(monkeypatch, capsys):
    """They answer at once: RL Zoo is not imported."""
    monkeypatch.setattr("builtins.__import__", refuse_rl_zoo(__import__))
    for option in ("--help", "-h", "--version"):
        monkeypatch.setattr(sys, "argv", ["sb3-cchain", option])
        console.main()
    output = capsys.readouterr().out
    assert output.endswith(f"sb3-cchain {sb3_cchain.__version__}\n")
    assert "search" in output and all(f"\n  {name} " in output for name in console.COMMANDS)


def refuse_rl_zoo(import_):
    def import_others(name, *args, **kwargs):
        assert not name.startswith("rl_zoo3"), name
        return import_(name, *args, **kwargs)

    return import_others


@pytest.mark.parametrize(
    "arguments, message", [([], "^usage: sb3-cchain COMMAND"), (["tran"], "COMMAND must be one of .* got tran$")]
)
def test_what_is_no_command(monkeypatch, arguments, message):
    monkeypatch.setattr(sys, "argv", ["sb3-cchain", *arguments])
    with pytest.raises(SystemExit, match=message):
        console.main()


def test_modules_of_the_present_folder_are_found(tmp_path, monkeypatch):
    """By the console script, too, which Python starts without the present folder on its path."""
    (tmp_path / "module_of_a_user.py").write_text(
        "import gymnasium as gym\n\n"
        "gym.register('OfAUser-v0', 'gymnasium.envs.classic_control:CartPoleEnv', max_episode_steps=9)\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    (tmp_path / "own.yml").write_text("OfAUser-v0:\n  policy: MlpPolicy\n  n_timesteps: 32\n")
    own = ("-conf", "own.yml", "--gym-packages", "module_of_a_user")
    command("train", "--algo", "ppo", "--env", "OfAUser-v0", *own, "-f", "logs", *FAST, *NO_EVALUATION, *SHORT_PPO)
    assert (tmp_path / "logs" / "ppo" / "OfAUser-v0_1" / "OfAUser-v0.zip").is_file()
