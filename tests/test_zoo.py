"""RL Zoo's command line with our algorithms, and the stock one."""

import ast
import json
import os
import pickle
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch as th
import yaml
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.save_util import load_from_pkl

import sb3_cchain.methods as baselines
import sb3_cchain.zoo.cli as zoo
import sb3_cchain.zoo.search as zoo_search
from sb3_cchain import CChainDQN, CChainPPO, DoubleDQN
from sb3_cchain.callbacks import read_returns
from sb3_cchain.envs import TaskVecNormalize
from sb3_cchain.envs.registration import CONTINUAL_ENVS

ROOT = Path(__file__).parent.parent
DMC = ["Continual/Walker-v0", "Continual/Quadruped-v0", "Continual/Dog-v0"]
PROCGEN = [f"Continual/{name}" for name, registration in CONTINUAL_ENVS.items() if "game" in registration.get("kwargs", {})]
GYM_CONTROL = ["Continual/CartPole-v1", "Continual/Acrobot-v1", "Continual/LunarLander-v3", "Continual/MountainCar-v0"]
SHORT = ["--env-kwargs", "steps_per_task:1600", "--eval-freq", "800", "--num-threads", "1", "--device", "cpu", "--seed", "1"]


def run(*command, cwd, ok=True):
    environment = {**os.environ, "MPLBACKEND": "agg", "OMP_NUM_THREADS": "1"}
    result = subprocess.run([sys.executable, "-m", *command], cwd=cwd, capture_output=True, text=True, env=environment)
    assert (result.returncode == 0) == ok, result.stdout + result.stderr
    return result.stdout + result.stderr


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of 3200 steps over two tasks by each algorithm."""
    folder = tmp_path_factory.mktemp("zoo")
    for algo in ("ppo", "ppo_cchain"):
        run(
            *("sb3_cchain.zoo.cli", "train", "--algo", algo, "--env", "Continual/Acrobot-v1", "-n", "3200"),
            *("-f", "logs", "-tb", "tb", "--n-eval-envs", "2", *SHORT),
            cwd=folder,
        )
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
        # Task 0's two iterations were forgotten at the switch
        assert model.churn_reducer.coefficient.n_seen == 2


@pytest.mark.parametrize("algo", ["ppo", "ppo_cchain"])
def test_a_zoo_run_writes_returns_that_no_reward_scale_touched(trained, algo):
    (path,) = (trained / "tb").glob(f"*/{'PPO' if algo == 'ppo' else 'CChainPPO'}_1/returns.csv")
    rows = read_returns(path)
    assert [(row["timesteps"], row["task_id"]) for row in rows] == [(800, 0), (1600, 0), (2400, 1), (3200, 1)]
    assert all(-400 <= row["mean_return"] <= -40 for row in rows)
    monitor = (trained / "logs" / algo / "Continual-Acrobot-v1_1" / "0.monitor.csv").read_text().splitlines()
    assert monitor[1] == "r,l,t,task_id"
    assert {line.split(",")[3] for line in monitor[2:]} == {"0", "1"}


def test_evaluation_in_a_zoo_run_follows_the_task(tmp_path):
    """The evaluation environments are the zoo's own; their monitors say which task their episodes were of."""
    (tmp_path / "spy.py").write_text("""
import json
from pathlib import Path
from stable_baselines3.common import callbacks

evaluate_policy = callbacks.evaluate_policy

def spying_evaluate_policy(model, env, **kwargs):
    result = evaluate_policy(model, env, **kwargs)
    with open("tasks.jsonl", "a") as file:
        file.write(json.dumps([model.num_timesteps, env.get_attr("task_id")]) + chr(10))
    return result

callbacks.evaluate_policy = spying_evaluate_policy
import sb3_cchain.zoo.cli
sb3_cchain.zoo.cli.main()
""")
    for algo in ("ppo", "ppo_cchain"):
        arguments = ("train", "--algo", algo, "--env", "Continual/Acrobot-v1", "-n", "2400", "-f", "logs")
        run("spy", *arguments, *SHORT, "--env-kwargs", "steps_per_task:800", "--eval-freq", "400", cwd=tmp_path)
    tasks = [json.loads(line) for line in (tmp_path / "tasks.jsonl").read_text().splitlines()]
    # The step that ends a task is still of that task
    assert tasks == [[400, [0]], [800, [0]], [1200, [1]], [1600, [1]], [2000, [2]], [2400, [2]]] * 2


def test_enjoy(trained):
    output = run(
        *("sb3_cchain.zoo.cli", "enjoy", "--algo", "ppo_cchain", "--env", "Continual/Acrobot-v1", "-f", "logs", "-n", "801"),
        *("--no-render", "--device", "cpu", "--env-kwargs", "first_task:1"),
        cwd=trained,
    )
    # 801 steps are at least two of at most 400
    (n_episodes,) = re.findall(r"^(\d+) Episodes", output, flags=re.MULTILINE)
    assert int(n_episodes) >= 2
    (mean_reward,) = re.findall(r"^Mean reward: (-?[\d.]+)", output, flags=re.MULTILINE)
    assert -20 <= float(mean_reward) < 0  # scaled by 1/20


def test_continue_training(trained):
    agent = "logs/ppo_cchain/Continual-Acrobot-v1_1/Continual-Acrobot-v1.zip"
    output = run(
        *("sb3_cchain.zoo.cli", "train", "--algo", "ppo_cchain", "--env", "Continual/Acrobot-v1", "-n", "800"),
        *("-f", "logs2", "-i", agent, *SHORT),
        cwd=trained,
    )
    assert "Loading pretrained agent" in output


def test_plots(trained, tmp_path):
    # RL Zoo compares algorithms of several runs each
    for algo in ("ppo", "ppo_cchain"):
        for number in (1, 2):
            shutil.copytree(
                trained / "logs" / algo / "Continual-Acrobot-v1_1", tmp_path / "logs" / algo / f"Continual-Acrobot-v1_{number}"
            )
    run(
        "sb3_cchain.zoo.cli",
        "plot_train",
        "-a",
        "ppo_cchain",
        "-e",
        "Continual-Acrobot",
        "-f",
        "logs",
        "-w",
        "2",
        cwd=tmp_path,
    )
    run(
        *(
            "sb3_cchain.zoo.cli",
            "all_plots",
            "-a",
            "ppo",
            "ppo_cchain",
            "-e",
            "Continual-Acrobot",
            "-f",
            "logs",
            "--no-million",
        ),
        *("-o", "results"),
        cwd=tmp_path,
    )
    arguments = ("-i", "results.pkl", "-l", "PPO", "C-CHAIN", "--skip-timesteps", "-b", "-o", "plot.png", "--format", "png")
    run("sb3_cchain.zoo.cli", "plot_from_file", *arguments, cwd=tmp_path)
    assert (tmp_path / "plot.png").stat().st_size > 1000


def test_optimize(tmp_path):
    run(
        *("sb3_cchain.zoo.cli", "train", "--algo", "ppo_cchain", "--env", "Continual/CartPole-v1", "-n", "400", "-optimize"),
        *("--n-trials", "2", "--n-evaluations", "1", "--eval-episodes", "1", "-f", "logs", "--no-optim-plots", *SHORT),
        cwd=tmp_path,
    )
    (report,) = tmp_path.glob("logs/ppo_cchain/report_*.csv")
    header, *trials = report.read_text().splitlines()
    position = header.split(",").index("params_target_churn_ratio")
    ratios = [float(trial.split(",")[position]) for trial in trials]
    assert len(set(ratios)) == 2 and all(1e2 <= ratio <= 1e6 for ratio in ratios)


def test_stock_rl_zoo_through_a_callback(tmp_path, trained):
    run(
        *("rl_zoo3.train", "--algo", "ppo", "--env", "Continual/Acrobot-v1", "--gym-packages", "sb3_cchain", "-n", "3200"),
        *("-conf", str(ROOT / "zoo_hyperparams" / "ppo_cchain_callback.yml"), "-f", "logs", "-tb", "tb", *SHORT),
        cwd=tmp_path,
    )
    stock = PPO.load(tmp_path / "logs/ppo/Continual-Acrobot-v1_1/Continual-Acrobot-v1.zip", device="cpu")
    ours = CChainPPO.load(trained / "logs/ppo_cchain/Continual-Acrobot-v1_1/Continual-Acrobot-v1.zip", device="cpu")
    for name, tensor in ours.policy.state_dict().items():
        assert th.equal(tensor, stock.policy.state_dict()[name]), name
    assert len(read_returns(next((tmp_path / "tb").glob("*/PPO_1/returns.csv")))) == 4


# Three games of 100 steps, the random ones at the beginning of each cut to 20
MINATAR = [
    *("--env", "Continual/MinAtar-v0", "-n", "300", "--env-kwargs", "steps_per_task:100", "--eval-freq", "100"),
    *("--eval-episodes", "2", "--num-threads", "1", "--device", "cpu", "--seed", "1", "-f", "logs", "-tb", "tb", "-params"),
    "callback:['sb3_cchain.TaskSync', 'sb3_cchain.ContinualMetrics', "
    "{'sb3_cchain.callbacks.TaskLearningStarts': {'learning_starts': 20}}]",
    *("buffer_size:1000", "churn_warmup:10"),
]


def test_train_on_minatar_by_dqn_cchain(tmp_path):
    run("sb3_cchain.zoo.cli", "train", "--algo", "dqn_cchain", *MINATAR, "--save-replay-buffer", cwd=tmp_path)
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
    arguments = ("enjoy", "--algo", "dqn_cchain", "--env", "Continual/MinAtar-v0", "-f", "logs", "-n", "600", "--no-render")
    assert re.search(
        r"^Mean reward: \d", run("sb3_cchain.zoo.cli", *arguments, "--device", "cpu", cwd=tmp_path), flags=re.MULTILINE
    )


def test_optimize_dqn_cchain(tmp_path):
    run(
        *("sb3_cchain.zoo.cli", "train", "--algo", "dqn_cchain", *MINATAR, "-optimize", "--n-trials", "2"),
        *("--n-evaluations", "1", "--no-optim-plots"),
        cwd=tmp_path,
    )
    (report,) = tmp_path.glob("logs/dqn_cchain/report_*.csv")
    header, *trials = report.read_text().splitlines()
    columns = header.split(",")
    assert "params_net_arch" not in columns
    ratios = [float(trial.split(",")[columns.index("params_target_churn_ratio")]) for trial in trials]
    assert len(set(ratios)) == 2 and all(1e-3 <= ratio <= 1e-1 for ratio in ratios)


def test_stock_rl_zoo_trains_dqn_on_minatar(tmp_path):
    settings = str(ROOT / "zoo_hyperparams" / "dqn.yml")
    arguments = [argument for argument in MINATAR if argument != "churn_warmup:10"]
    run("rl_zoo3.train", "--algo", "dqn", "--gym-packages", "sb3_cchain", "-conf", settings, *arguments, cwd=tmp_path)
    model = DQN.load(tmp_path / "logs/dqn/Continual-MinAtar-v0_1/Continual-MinAtar-v0.zip", device="cpu")
    assert model._n_updates == 79 + 79 + 80


@pytest.mark.skipif(sys.version_info >= (3, 13), reason="dm_control has no wheels")
def test_train_on_walker_with_normalisation_that_restarts(tmp_path):
    run(
        *("sb3_cchain.zoo.cli", "train", "--algo", "ppo_cchain", "--env", "Continual/Walker-v0", "-n", "4096", "-f", "logs"),
        *("-tb", "tb", "--env-kwargs", "steps_per_task:3000", "--eval-freq", "2048", "--eval-episodes", "1"),
        *("--num-threads", "1", "--device", "cpu", "--seed", "1", "-params", "n_epochs:1"),
        cwd=tmp_path,
    )
    folder = tmp_path / "logs" / "ppo_cchain" / "Continual-Walker-v0_1"
    with open(folder / "Continual-Walker-v0" / "vecnormalize.pkl", "rb") as file:
        statistics = pickle.load(file)
    assert type(statistics) is TaskVecNormalize
    # Of the second task alone: 1096 steps and the observation they begin with; RunningMeanStd begins with a count of 1e-4
    assert statistics.obs_rms.count == pytest.approx(1097, abs=1e-3)
    model = CChainPPO.load(folder / "Continual-Walker-v0.zip", device="cpu")
    assert (model.n_steps, model.batch_size, model.churn_reducer.coefficient.initial) == (2048, 64, 100)
    assert model.churn_reducer.coefficient.target_ratio == 0.5
    assert [type(layer) for layer in model.policy.mlp_extractor.policy_net] == [th.nn.Linear, th.nn.ReLU] * 2
    arguments = ("enjoy", "--algo", "ppo_cchain", "--env", "Continual/Walker-v0", "-f", "logs", "-n", "1001", "--no-render")
    output = run("sb3_cchain.zoo.cli", *arguments, "--device", "cpu", "--env-kwargs", "first_task:1", cwd=tmp_path)
    assert "Loading running average" in output and re.search(r"^Mean reward: ", output, flags=re.MULTILINE)


@pytest.mark.parametrize("arguments", [[], ["fly"]])
def test_usage(monkeypatch, arguments):
    monkeypatch.setattr(sys, "argv", ["sb3-cchain", *arguments])
    with pytest.raises(SystemExit, match=r"usage: sb3-cchain {train\|enjoy\|inspect\|plot_train"):
        zoo.main()


def test_unknown_environment_names_the_nearest(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["sb3-cchain", "train", "--algo", "ppo_cchain", "--env", "Continual/Acrobat-v1"])
    with pytest.raises(ValueError, match="you maybe meant Continual/Acrobot-v1"):
        zoo.main()


# --- The YAML files -------------------------------------------------------------------------------------------------------


def settings_of(algo):
    return yaml.safe_load((zoo.hyperparams_folder() / f"{algo}.yml").read_text())


def test_every_environment_has_settings():
    continual = {f"Continual/{name}" for name in CONTINUAL_ENVS}
    assert len(continual) == 24 and {*GYM_CONTROL, *PROCGEN, *DMC, "Continual/MinAtar-v0"} == continual
    for algos, env_ids in (
        (("ppo", "ppo_cchain"), {*GYM_CONTROL, *PROCGEN, *DMC}),
        (("dqn", "double_dqn", "dqn_cchain"), {"Continual/MinAtar-v0"}),
    ):
        for algo in algos:
            assert {key for key in settings_of(algo) if not key.endswith("default") and "defaults" not in key} == env_ids
    for algo in zoo.OUR_ALGOS:
        assert "default" in settings_of(algo)


# Shorter than the settings', where a rollout of those takes long
ROLLOUTS = {
    **{(algo, env_id): [] for env_id in GYM_CONTROL for algo in ("ppo", "ppo_cchain")},
    **{(algo, env_id): ["n_steps:64", "batch_size:32", "n_epochs:1"] for env_id in PROCGEN for algo in ("ppo", "ppo_cchain")},
    **{(algo, env_id): ["n_steps:256", "n_epochs:1"] for env_id in DMC for algo in ("ppo", "ppo_cchain")},
    **{(algo, "Continual/MinAtar-v0"): ["buffer_size:1000"] for algo in ("dqn", "double_dqn", "dqn_cchain")},
}


@pytest.mark.parametrize("algo, env_id", ROLLOUTS)
@pytest.mark.filterwarnings("ignore")
def test_every_environment_trains_a_rollout_with_its_settings(monkeypatch, tmp_path, algo, env_id):
    if sys.version_info >= (3, 13) and env_id in PROCGEN + DMC:
        pytest.skip("no wheels")
    changed = ROLLOUTS[algo, env_id]
    n_steps = next((change.split(":")[1] for change in changed if "n_steps" in change), "800")
    arguments = ["train", "--algo", algo, "--env", env_id, "-n", n_steps, "--eval-freq", "-1", "-f", str(tmp_path)]
    arguments += ["--seed", "0", "--num-threads", "1", "--device", "cpu", "--verbose", "0"]
    monkeypatch.setattr(sys, "argv", ["sb3-cchain", *arguments, *(["-params", *changed] if changed else [])])
    zoo.main()
    (path,) = tmp_path.glob(f"{algo}/*/*-v?.zip")
    algorithm = {"ppo": PPO, "dqn": DQN, **zoo.OUR_ALGOS}[algo]
    model = algorithm.load(path, device="cpu")
    settings = settings_of(algo)[env_id]
    assert model.num_timesteps == int(n_steps) and model.gamma == settings["gamma"]
    if "dqn" in algo:
        assert model._n_updates == 0 and model.learning_starts == 10_000  # all of it random
        return
    assert model._n_updates == (1 if changed else settings["n_epochs"])
    if algo == "ppo_cchain":
        assert model.churn_reducer.coefficient.n_seen == 1
        assert model.churn_reducer.coefficient.target_ratio == settings["target_churn_ratio"]


def test_suites_differ_in_the_churn_arguments_alone():
    ppo, cchain = (settings_of(algo) for algo in ("ppo", "ppo_cchain"))
    for env_id in PROCGEN + DMC:
        churn = {key: value for key, value in cchain[env_id].items() if "churn" in key}
        assert cchain[env_id] == {**ppo[env_id], **churn}
    for env_id in DMC:
        assert cchain[env_id]["target_churn_ratio"] == (0.5 if "Walker" in env_id else 0.05)
        assert ppo[env_id]["n_timesteps"] == (4e6 if "Dog" in env_id else 3e6)
    for env_id in PROCGEN:
        assert cchain[env_id] == cchain["Continual/Starpilot-v0"]


def test_dqn_settings_differ_where_the_algorithms_do():
    dqn, double, cchain = (settings_of(algo)["Continual/MinAtar-v0"] for algo in ("dqn", "double_dqn", "dqn_cchain"))
    assert double == {**dqn, "double_q": True, "loss": "mse"}
    churn = {key: value for key, value in cchain.items() if "churn" in key}
    assert cchain == {**double, **churn}
    assert (churn["churn_coef"], churn["target_churn_ratio"]) == ("auto_50", 0.01)
    assert (churn["churn_warmup"], churn["churn_window"], churn["reset_churn_coef"]) == (10_000, 50_000, False)


@pytest.mark.parametrize("algo, cls", [("double_dqn", DoubleDQN), ("dqn_cchain", CChainDQN), ("ppo_cchain", CChainPPO)])
def test_our_algorithms_are_known(algo, cls):
    assert zoo.OUR_ALGOS[algo] is cls
    assert zoo.hyperparams_file(algo, "CartPole-v1").name == f"{algo}.yml"


def test_c_chain_and_vanilla_differ_in_the_churn_arguments_alone():
    ppo, cchain = (yaml.safe_load(zoo.hyperparams_file(algo, GYM_CONTROL[0]).read_text()) for algo in ("ppo", "ppo_cchain"))
    callback = yaml.safe_load((zoo.hyperparams_folder() / "ppo_cchain_callback.yml").read_text())
    for env_id in GYM_CONTROL:
        churn = {key: value for key, value in cchain[env_id].items() if "churn" in key}
        assert cchain[env_id] == {**ppo[env_id], **churn}
        assert churn["target_churn_ratio"] == 1e4
    settings = callback["Continual/Acrobot-v1"]
    assert settings["callback"].pop() == {"sb3_cchain.CChainCallback": churn}
    assert settings == ppo["Continual/Acrobot-v1"]


def test_rl_zoos_own_settings_hold_where_we_have_none():
    assert zoo.hyperparams_file("ppo", "CartPole-v1") is None
    assert zoo.hyperparams_file("sac", "Continual/Acrobot-v1") is None
    assert zoo.hyperparams_file("ppo_cchain", "CartPole-v1").name == "ppo_cchain.yml"


@pytest.mark.parametrize("option", ["--conf-file", "--conf", "-conf"])
def test_a_file_of_ones_own_wins(monkeypatch, option):
    arguments = ["sb3-cchain", "train", "--alg", "ppo_cchain", option, "mine.yml", "--env", "Continual/Acrobot-v1"]
    monkeypatch.setattr(sys, "argv", arguments)
    with pytest.raises(FileNotFoundError, match=r"mine\.yml"):
        zoo.main()


def test_search_space_depends_on_the_actions():
    import optuna

    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for n_actions, low, high in ((0, 1e2, 1e6), (2, 5e-3, 5.0)):
        ratios = [zoo_search.sample_ppo_cchain_params(study.ask(), n_actions, 1, {})["target_churn_ratio"] for _ in range(20)]
        assert low <= min(ratios) < max(ratios) <= high
        assert np.ptp(np.log10(ratios)) > 1


# --- The related methods --------------------------------------------------------------------------------------------------

SUITES = {"gym_control": GYM_CONTROL, "procgen": PROCGEN, "dmc": DMC, "minatar": ["Continual/MinAtar-v0"]}
ADAM = "optimizer_kwargs=dict(eps=1e-8, fused=True)"
METRICS = ["sb3_cchain.methods.OptimizerMetrics"]
ORACLE = "sb3_cchain.methods.Oracle"
REDO = {"sb3_cchain.methods.ReDo": {"tau": 0.025, "interval": 10, "batch_size": 256}}


def optimizer(name, arguments):
    return f"optimizer_class=get_class_by_name('sb3_cchain.methods.{name}'), optimizer_kwargs=dict({arguments})"


# The callbacks that are added, and what stands for Adam's arguments among those of the policy
DIFFERENCES = {
    ("ppo_oracle", "gym_control"): ([ORACLE], ADAM),
    ("ppo_oracle", "procgen"): ([ORACLE], ""),
    ("ppo_oracle", "dmc"): ([ORACLE], ""),
    ("ppo_trac", "gym_control"): (METRICS, optimizer("TRAC", "base_kwargs=dict(eps=1e-8, fused=True)")),
    ("ppo_trac", "procgen"): (METRICS, optimizer("TRAC", "base_kwargs=dict(eps=1e-8)")),
    ("ppo_weight_clipping", "gym_control"): (
        METRICS,
        optimizer("WeightClipping", "clip_ratio=1.0, base_kwargs=dict(eps=1e-8, fused=True)"),
    ),
    ("ppo_weight_clipping", "procgen"): (METRICS, optimizer("WeightClipping", "clip_ratio=1.0, base_kwargs=dict(eps=1e-5)")),
    ("ppo_l2_init", "gym_control"): (
        METRICS,
        optimizer("L2Init", "coef=10.0, reduction='mean', base_kwargs=dict(eps=1e-8, fused=True)"),
    ),
    ("ppo_l2_init", "procgen"): (METRICS, optimizer("L2Init", "coef=10.0, reduction='mean', base_kwargs=dict(eps=1e-5)")),
    ("ppo_layer_norm", "procgen"): ([], "features_extractor_kwargs=dict(layer_norm=True)"),
    ("ppo_redo", "procgen"): ([REDO], ""),
    ("ppo_adam_rel", "procgen"): (["sb3_cchain.methods.AdamRel"], ""),
    ("double_dqn_oracle", "minatar"): ([{ORACLE: {"reset_replay_buffer": True}}], ""),
}


def parsed(settings):
    """Whatever the line breaks."""
    expression = ast.parse(settings.get("policy_kwargs", "dict()"), mode="eval")
    return {**settings, "policy_kwargs": ast.dump(expression)}


@pytest.mark.parametrize("method, algo", zoo.METHODS.items())
def test_a_method_differs_from_its_algorithm_in_itself_alone(method, algo):
    settings, vanilla = settings_of(method), settings_of(algo)
    expected = {}
    for suite in (suite for name, suite in DIFFERENCES if name == method):
        callbacks, arguments = DIFFERENCES[method, suite]
        for env_id in SUITES[suite]:
            of_env = vanilla[env_id]
            policy_kwargs = of_env.get("policy_kwargs", f"dict({ADAM})" if arguments else "dict()").replace(ADAM, arguments)
            expected[env_id] = {**of_env, "callback": [*of_env["callback"], *callbacks], "policy_kwargs": policy_kwargs}
    covered = {env_id: of_env for env_id, of_env in settings.items() if not env_id.endswith("-defaults")}
    assert {env_id: parsed(of_env) for env_id, of_env in covered.items()} == {
        env_id: parsed(of_env) for env_id, of_env in expected.items()
    }


METHOD_ROLLOUTS = {
    "gym_control": ("Continual/Acrobot-v1", 64, 32),
    "procgen": ("Continual/Starpilot-v0", 32, 16),
    "dmc": ("Continual/Walker-v0", 64, 32),
}


def train(monkeypatch, folder, method, env_id, n_steps, *arguments):
    arguments = [*arguments, "--eval-freq", "-1", "--seed", "0", "--num-threads", "1", "--device", "cpu", "--verbose", "0"]
    monkeypatch.setattr(
        sys,
        "argv",
        ["sb3-cchain", "train", "--algo", method, "--env", env_id, "-n", str(n_steps), "-f", str(folder), *arguments],
    )
    zoo.main()


@pytest.mark.parametrize("method, suite", [key for key in DIFFERENCES if key[1] != "minatar"])
@pytest.mark.filterwarnings("ignore")
def test_every_method_trains_a_rollout_of_two_tasks_with_its_settings(monkeypatch, tmp_path, method, suite):
    if sys.version_info >= (3, 13) and suite in ("procgen", "dmc"):
        pytest.skip("no wheels")
    env_id, n_steps, batch_size = METHOD_ROLLOUTS[suite]
    short = [f"n_steps:{n_steps}", f"batch_size:{batch_size}", "n_epochs:1"]
    train(
        *(monkeypatch, tmp_path, method, env_id, 2 * n_steps),
        *("--env-kwargs", f"steps_per_task:{n_steps}", "-params", *short),
    )
    (path,) = tmp_path.glob(f"{method}/*/*-v?.zip")
    model = PPO.load(path, device="cpu")
    assert type(model) is PPO and model.num_timesteps == 2 * n_steps and model._n_updates == 2
    optimizer = model.policy.optimizer
    names = {"ppo_trac": "TRAC", "ppo_weight_clipping": "WeightClipping", "ppo_l2_init": "L2Init"}
    assert type(optimizer).__name__ == names.get(method, "Adam")
    assert optimizer.param_groups[0]["eps"] == (1e-8 if suite == "gym_control" or method == "ppo_trac" else 1e-5)
    # Two updates for each task, or those since the reset
    n_updates = 2 if method in ("ppo_oracle", "ppo_adam_rel") else 4
    assert {int(optimizer.state[parameter]["step"]) for parameter in model.policy.parameters()} == {n_updates}
    assert sum(isinstance(module, th.nn.LayerNorm) for module in model.policy.features_extractor.modules()) == (
        2 if method == "ppo_layer_norm" else 0
    )


def test_oracle_of_minatar_begins_each_game_with_an_empty_buffer(monkeypatch, tmp_path):
    arguments = ["--env-kwargs", "steps_per_task:100", "-params", "buffer_size:1000"]
    train(monkeypatch, tmp_path, "double_dqn_oracle", "Continual/MinAtar-v0", 250, *arguments, "--save-replay-buffer")
    (folder,) = tmp_path.glob("double_dqn_oracle/Continual-MinAtar-v0_1")
    model = DoubleDQN.load(folder / "Continual-MinAtar-v0.zip", device="cpu")
    assert (model.trained_task_id, model.double_q, model._n_updates) == (2, True, 0)
    assert load_from_pkl(folder / "replay_buffer.pkl").size() == 50


def test_a_method_by_either_command(tmp_path):
    """Ours, its ``enjoy``, and the stock one."""
    arguments = (
        "--env",
        "Continual/Acrobot-v1",
        "-n",
        "1600",
        "--env-kwargs",
        "steps_per_task:800",
        "-f",
        "logs",
        "-tb",
        "tb",
    )
    arguments += ("--eval-freq", "-1", "--num-threads", "1", "--device", "cpu", "--seed", "1", "-params", "n_epochs:1")
    run("sb3_cchain.zoo.cli", "train", "--algo", "ppo_trac", *arguments, cwd=tmp_path)
    settings = str(ROOT / "zoo_hyperparams" / "ppo_trac.yml")
    run("rl_zoo3.train", "--algo", "ppo", "--gym-packages", "sb3_cchain", "-conf", settings, *arguments, cwd=tmp_path)
    ours, stock = (
        PPO.load(tmp_path / "logs" / algo / "Continual-Acrobot-v1_1" / "Continual-Acrobot-v1.zip", device="cpu")
        for algo in ("ppo_trac", "ppo")
    )
    assert type(ours.policy.optimizer) is type(stock.policy.optimizer) is baselines.TRAC
    for name, tensor in ours.policy.state_dict().items():
        assert th.equal(tensor, stock.policy.state_dict()[name]), name
    for number in (1, 2):
        rows = read_returns(tmp_path / "tb" / "Continual-Acrobot-v1" / f"PPO_{number}" / "returns.csv")
        assert [(row["timesteps"], row["task_id"]) for row in rows] == [(800, 0), (1600, 1)]
    arguments = ("enjoy", "--algo", "ppo_trac", "--env", "Continual/Acrobot-v1", "-f", "logs", "-n", "401", "--no-render")
    output = run("sb3_cchain.zoo.cli", *arguments, "--device", "cpu", cwd=tmp_path)
    assert re.search(r"^Mean reward: -\d", output, flags=re.MULTILINE)


@pytest.mark.parametrize("algo", ["ppo_layer_norm", "double_dqn_oracle"])
def test_a_method_says_which_environments_it_covers(monkeypatch, tmp_path, algo):
    covered = PROCGEN if algo == "ppo_layer_norm" else SUITES["minatar"]
    error = f"{algo}.yml has no settings for Continual/Acrobot-v1, only for {', '.join(covered)}. .* -conf FILE$"
    with pytest.raises(SystemExit, match=error):
        train(monkeypatch, tmp_path, algo, "Continual/Acrobot-v1", 64)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("option", [[], ["-conf", "mine.yml"]])
@pytest.mark.parametrize("method", sorted(zoo.METHODS.keys() - zoo_search.GRIDS.keys()))
def test_a_method_with_nothing_to_search_says_so(monkeypatch, tmp_path, method, option):
    algo = zoo.METHODS[method]
    with pytest.raises(SystemExit, match=f"{method} has no hyperparameters of its own to search.* --algo {algo} -optimize"):
        train(monkeypatch, tmp_path, method, "Continual/Starpilot-v0", 64, "-optimize", *option)
    assert not list(tmp_path.iterdir())


def test_grids_are_the_papers():
    grids = {method: list(grid.values()) for method, grid in zoo_search.GRIDS.items() if method != "ppo_redo"}
    assert grids == {"ppo_weight_clipping": [[0.1, 0.5, 1, 10]], "ppo_l2_init": [[0.1, 1, 10, 100, 1000]]}
    with pytest.raises(ValueError, match=r"`--trial-id`.*'coef': 0.1.*-conf"):
        zoo_search.HYPERPARAMS_CONVERTER["ppo_l2_init"]({"coef": 0.1})


# ReDo's own settings are of ProcGen: others, for the sake of a fast test, in a file
REDO_FILE = """
Continual/CartPole-v1:
  callback:
    - sb3_cchain.TaskSync
    - sb3_cchain.methods.ReDo:
        batch_size: 16
  policy: MlpPolicy
  policy_kwargs: "dict(net_arch=[8], activation_fn=nn.ReLU)"
  n_timesteps: 64
"""


@pytest.mark.parametrize("method, part", [("ppo_weight_clipping", "WeightClipping"), ("ppo_redo", "ReDo")])
def test_optimize_keeps_all_else_of_the_settings(monkeypatch, tmp_path, method, part):
    given = []

    class Spy(getattr(baselines, part)):
        def __init__(self, *args, **kwargs):
            given.append(kwargs)
            super().__init__(*args, **kwargs)

    monkeypatch.setattr(baselines, part, Spy)
    arguments = ["-optimize", "--n-trials", "3", "--n-evaluations", "1", "--eval-episodes", "1", "--no-optim-plots"]
    if method == "ppo_redo":
        (tmp_path / "mine.yml").write_text(REDO_FILE)
        arguments += ["-conf", str(tmp_path / "mine.yml")]
    arguments += ["-params", "n_steps:64", "n_epochs:1", "batch_size:32"]
    train(monkeypatch, tmp_path, method, "Continual/CartPole-v1", 64, *arguments)
    (report,) = tmp_path.glob(f"{method}/report_*.csv")
    header, *trials = (line.split(",") for line in report.read_text().splitlines())
    grid = zoo_search.GRIDS[method]
    tried = [{name: float(trial[header.index(f"params_{name}")]) for name in grid} for trial in trials]
    assert [trial[header.index("state")] for trial in trials] == ["COMPLETE"] * 3
    assert all(value in grid[name] for trial in tried for name, value in trial.items())
    if method == "ppo_redo":
        assert given == [{"batch_size": 16}, *({"batch_size": 16, **trial} for trial in tried)]
    else:
        assert given == [{"lr": 1e-3, "base_kwargs": {"eps": 1e-8, "fused": True}, **trial} for trial in tried]


def test_optimize_needs_redo_among_the_callbacks():
    with pytest.raises(ValueError, match=r"`callback` must have sb3_cchain.methods.ReDo, got \['sb3_cchain.TaskSync'\]"):
        zoo_search.with_arguments(["sb3_cchain.TaskSync"], zoo_search.REDO, {"tau": 0.1})
    assert zoo_search.with_arguments(zoo_search.REDO, zoo_search.REDO, {"tau": 0.1}) == [{zoo_search.REDO: {"tau": 0.1}}]


def test_a_file_of_ones_own_for_a_method():
    arguments = ["--algo", "ppo_redo", "--env", "Continual/CartPole-v1", "-conf", "mine.yml"]
    assert zoo.with_our_hyperparams(arguments) == arguments
