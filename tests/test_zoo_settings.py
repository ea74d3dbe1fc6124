"""The YAML files, and which of them the command line takes."""

import ast
import re
from collections import OrderedDict

import gymnasium as gym
import pytest
import torch as th
import yaml
from gymnasium.envs.registration import EnvSpec
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import CallbackList, EveryNTimesteps
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy

from benchmarks.grid.run import suite_methods
from sb3_cchain import CChainDQN, CChainPPO, DoubleDQN
from sb3_cchain.envs.registration import CONTINUAL_ENVS, OTHER_ENVS
from sb3_cchain.methods import UPGD
from sb3_cchain.methods.registry import BY_ALGO, REGISTRY
from sb3_cchain.zoo.settings import (
    SettingsLoader,
    add_settings_file,
    base_algo,
    hyperparams_folder,
    missing_parts,
    settings_file,
)
from tests.envs import RandomEnv
from tests.extras import NO_WHEELS
from tests.zoo_command import (
    DMC,
    ENV_IDS,
    FAST,
    GYM_CONTROL,
    NO_EVALUATION,
    PROCGEN,
    ROOT,
    SHORT_PPO,
    command,
    shipped_settings,
)

# Algorithms of which RL Zoo has no settings
NEW_ALGOS = ["ppo_cchain", "dqn_cchain", "double_dqn"]
# The related methods that have a YAML file
METHODS = [row.algo for row in REGISTRY if row.is_related and (hyperparams_folder() / f"{row.algo}.yml").is_file()]


OTHER = [f"Continual/{name}" for name in OTHER_ENVS]


def train(folder, algo, env_id, n_steps, *arguments):
    command(
        *("train", "--algo", algo, "--env", env_id, "-n", n_steps, "-f", folder, *NO_EVALUATION, "--seed", "0", *FAST),
        *arguments,
    )


def algos_of(suite):
    """Names on the command line of the algorithms that train in a suite, with and without churn reduction."""
    stock = ["dqn"] if suite == "minatar" else []
    return [*stock, *(suite_methods(suite)[name].algo for name in ("vanilla", "cchain"))]


def test_quickstart_has_the_shipped_settings_in_python(tmp_path):
    section = (ROOT / "docs" / "quickstart.md").read_text().partition("### In Python")[2]
    snippet = re.search(r"```python\n(.*?)```", section, flags=re.DOTALL)[1]
    kwargs = "env_kwargs=dict(n_tasks=2, steps_per_task=800)"
    shorter = snippet.replace('"Continual/Acrobot-v1", ', f'"Continual/Acrobot-v1", {kwargs}, ').replace("1_600_000", "1600")
    names = {}
    exec(shorter, names)
    train(tmp_path, "ppo_cchain", "Continual/Acrobot-v1", 1600, "--env-kwargs", "n_tasks:2", "steps_per_task:800")
    (saved,) = tmp_path.rglob("Continual-Acrobot-v1.zip")
    from_command = CChainPPO.load(saved)
    assert from_command.num_timesteps == names["model"].num_timesteps == 1600
    # What makes no difference so early
    for name in ("churn_warmup", "churn_window", "churn_coef_min", "reset_churn_coef", "gamma", "gae_lambda"):
        assert getattr(from_command, name) == getattr(names["model"], name), name
    for name, parameter in from_command.policy.state_dict().items():
        assert th.equal(parameter, names["model"].policy.state_dict()[name]), name


def test_every_environment_has_settings():
    papers = ("gym_control", "procgen", "dmc", "minatar")
    assert sum(len(ENV_IDS[suite]) for suite in papers) == 24
    assert {f"Continual/{name}" for name in CONTINUAL_ENVS} == {env_id for env_ids in ENV_IDS.values() for env_id in env_ids}
    covered = {}
    for suite, env_ids in ENV_IDS.items():
        for algo in algos_of(suite):
            covered.setdefault(algo, set()).update(env_ids)
    for algo in ("ppo", "ppo_cchain"):
        covered[algo].update(OTHER)
    for algo, env_ids in covered.items():
        assert {key for key in shipped_settings(algo) if not key.endswith("default") and "defaults" not in key} == env_ids
    for algo in NEW_ALGOS:
        assert "default" in shipped_settings(algo)


# Shorter than the settings', where a rollout of those takes long, but for one environment
WHOLE = "Continual/CartPole-v1"
SHORTER = {
    "gym_control": ["n_epochs:1"],
    "procgen": ["n_steps:32", "batch_size:16", "n_epochs:1"],
    "dmc": ["n_steps:128", "n_epochs:1"],
    "minatar": ["buffer_size:1000"],
}
ROLLOUTS = {
    (algo, env_id): [] if env_id == WHOLE else SHORTER.get(suite, ["n_steps:64", "batch_size:32", "n_epochs:1"])
    for suite, env_ids in ENV_IDS.items()
    for env_id in (env_ids[:2] if suite == "procgen" else env_ids)  # the games have the same settings
    for algo in algos_of(suite)
} | {("ppo_cchain", env_id): ["n_envs:1", "n_steps:64", "batch_size:32", "n_epochs:1"] for env_id in OTHER}


@pytest.mark.parametrize("algo, env_id", ROLLOUTS)
@pytest.mark.filterwarnings("ignore")
def test_every_environment_trains_a_rollout_with_its_settings(tmp_path, algo, env_id):
    if NO_WHEELS and env_id in PROCGEN + DMC:
        pytest.skip("no wheels")
    changed = ROLLOUTS[algo, env_id]
    n_steps = next((change.split(":")[1] for change in changed if "n_steps" in change), "800")
    train(tmp_path, algo, env_id, n_steps, *(["-params", *changed] if changed else []))
    (path,) = tmp_path.glob(f"{algo}/*/*-v?.zip")
    algorithm = {"ppo": PPO, "dqn": DQN, "ppo_cchain": CChainPPO, "dqn_cchain": CChainDQN, "double_dqn": DoubleDQN}[algo]
    model = algorithm.load(path, device="cpu")
    settings = shipped_settings(algo)[env_id]
    assert model.num_timesteps == int(n_steps) and model.gamma == settings.get("gamma", 0.99)
    if "dqn" in algo:
        assert model._n_updates == 0 and model.learning_starts == 10_000  # all of it random
        return
    assert model._n_updates == (1 if changed else settings["n_epochs"])
    if algo == "ppo_cchain":
        assert model.churn_reducer.coefficient.n_seen == 1
        if "target_churn_ratio" in settings:
            assert model.churn_reducer.coefficient.target_ratio == settings["target_churn_ratio"]


def test_suites_differ_in_the_churn_arguments_alone():
    ppo, cchain = (shipped_settings(algo) for algo in ("ppo", "ppo_cchain"))
    for env_id in PROCGEN + DMC:
        churn = {key: value for key, value in cchain[env_id].items() if "churn" in key}
        assert cchain[env_id] == {**ppo[env_id], **churn}
    for env_id in DMC:
        assert cchain[env_id]["target_churn_ratio"] == (0.5 if "Walker" in env_id else 0.05)
        assert ppo[env_id]["n_timesteps"] == (4e6 if "Dog" in env_id else 3e6)
        # As the released code does
        assert cchain[env_id]["churn_base_loss"] == "last" and "returns_over_cuts=True" in ppo[env_id]["normalize"]
        assert ppo[env_id]["callback"][-1] == "sb3_cchain.callbacks.NoBootstrapAtCuts"
    for env_id in PROCGEN:
        assert cchain[env_id] == cchain["Continual/Starpilot-v0"]
    for env_id in OTHER:
        assert cchain[env_id] == ppo[env_id]


def test_dqn_settings_differ_where_the_algorithms_do():
    dqn, double, cchain = (shipped_settings(algo)["Continual/MinAtar-v0"] for algo in ("dqn", "double_dqn", "dqn_cchain"))
    assert double == {**dqn, "double_q": True, "loss": "mse"}
    churn = {key: value for key, value in cchain.items() if "churn" in key}
    assert cchain == {**double, **churn}
    assert (churn["churn_coef"], churn["target_churn_ratio"]) == ("auto_50", 0.01)
    assert (churn["churn_warmup"], churn["churn_window"], churn["reset_churn_coef"]) == (10_000, 50_000, False)


def test_c_chain_and_vanilla_differ_in_the_churn_arguments_alone():
    ppo, cchain, callback = (shipped_settings(algo) for algo in ("ppo", "ppo_cchain", "ppo_cchain_callback"))
    for env_id in GYM_CONTROL:
        churn = {key: value for key, value in cchain[env_id].items() if "churn" in key}
        assert cchain[env_id] == {**ppo[env_id], **churn}
        assert churn["target_churn_ratio"] == 1e4
    settings = callback["Continual/Acrobot-v1"]
    assert settings["callback"].pop() == {"sb3_cchain.CChainCallback": churn}
    assert settings == ppo["Continual/Acrobot-v1"]


@pytest.mark.parametrize("algo", NEW_ALGOS)
def test_defaults_hold_for_algorithms_that_rl_zoo_does_not_have(algo):
    assert settings_file(algo, "CartPole-v1").name == f"{algo}.yml"


class AtariEnv(RandomEnv):
    """By its name RL Zoo takes it for an Atari game."""


@pytest.mark.parametrize("algo, arguments", [("ppo_cchain", SHORT_PPO), ("double_dqn", ())])
def test_defaults_hold_for_atari_games(algo, arguments, tmp_path, monkeypatch):
    monkeypatch.setitem(gym.registry, "Game-v0", EnvSpec("Game-v0", f"{__name__}:AtariEnv"))
    train(tmp_path, algo, "Game-v0", 32, *arguments)
    assert (tmp_path / algo / "Game-v0_1" / "Game-v0.zip").exists()


# Those of PPO, MaskablePPO and DQN are trained elsewhere
@pytest.mark.parametrize("name", ["a2c", "trpo", "ppo_lstm", "qrdqn", "sac", "td3", "ddpg", "tqc", "crossq"])
def test_the_defaults_of_the_family_train(name, tmp_path):
    algo, env_id = f"{name}_cchain", "Pendulum-v1"
    algorithm = BY_ALGO[algo].algorithm
    if issubclass(algorithm, OnPolicyAlgorithm):
        short = ["n_steps:16", *([] if name == "a2c" else ["batch_size:8"])]
    else:
        short = ["learning_starts:8", "buffer_size:100", "batch_size:4"]
        env_id = "CartPole-v1" if name == "qrdqn" else env_id
    train(tmp_path, algo, env_id, 48, "-params", *short)
    (path,) = tmp_path.rglob(f"{env_id}.zip")
    model = algorithm.load(path, device="cpu")
    assert model._n_updates > 0 and all(reducer.reference is not None for reducer in model.churn_reducers.values())


def test_rl_zoos_own_settings_hold_where_we_have_none():
    assert settings_file("ppo", "CartPole-v1") is None
    assert settings_file("sac", "Continual/Acrobot-v1") is None
    arguments = ["--algo", "ppo", "--env", "CartPole-v1"]
    assert add_settings_file(arguments) == arguments


@pytest.mark.parametrize("option", ["--conf-file", "--conf", "-conf"])
def test_a_file_of_the_user_wins(option):
    with pytest.raises(FileNotFoundError, match=r"mine\.yml"):
        command("train", "--alg", "ppo_cchain", option, "mine.yml", "--env", "Continual/Acrobot-v1")


# --- The related methods --------------------------------------------------------------------------------------------------

ADAM = "optimizer_kwargs=dict(eps=1e-8, fused=True)"
METRICS = ["sb3_cchain.methods.OptimizerMetrics"]
ORACLE = "sb3_cchain.methods.Oracle"
REDO = {"sb3_cchain.methods.ReDo": {"tau": 0.025, "interval": 10, "batch_size": 256}}


def optimizer(name, arguments):
    return f"optimizer_class=get_class_by_name('sb3_cchain.methods.{name}'), optimizer_kwargs=dict({arguments})"


# Of the paper's methods: the callbacks that are added, and what stands for Adam's arguments among those of the policy
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
    ("ppo_layer_norm", "gym_control"): ([], ADAM),
    ("ppo_redo", "gym_control"): ([REDO], ADAM),
    ("ppo_adam_rel", "gym_control"): (["sb3_cchain.methods.AdamRel"], ADAM),
    ("ppo_layer_norm", "procgen"): ([], "features_extractor_kwargs=dict(layer_norm=True)"),
    ("ppo_redo", "procgen"): ([REDO], ""),
    ("ppo_adam_rel", "procgen"): (["sb3_cchain.methods.AdamRel"], ""),
    ("ppo_trac", "dmc"): (METRICS, optimizer("TRAC", "base_kwargs=dict(eps=1e-5)")),
    ("ppo_weight_clipping", "dmc"): (METRICS, optimizer("WeightClipping", "clip_ratio=1.0, base_kwargs=dict(eps=1e-5)")),
    ("ppo_l2_init", "dmc"): (METRICS, optimizer("L2Init", "coef=10.0, reduction='mean', base_kwargs=dict(eps=1e-5)")),
    ("ppo_layer_norm", "dmc"): ([], ""),
    ("ppo_redo", "dmc"): ([REDO], ""),
    ("ppo_adam_rel", "dmc"): (["sb3_cchain.methods.AdamRel"], ""),
    ("double_dqn_oracle", "minatar"): ([{ORACLE: {"reset_replay_buffer": True}}], ""),
}


def parsed(settings):
    """Whatever the line breaks."""
    expression = ast.parse(settings.get("policy_kwargs", "dict()"), mode="eval")
    return {**settings, "policy_kwargs": ast.dump(expression)}


def keywords(settings):
    """The arguments in ``policy_kwargs``, by name."""
    call = ast.parse(settings.get("policy_kwargs", "dict()"), mode="eval").body
    return {keyword.arg: ast.dump(keyword.value) for keyword in call.keywords}


@pytest.mark.parametrize("method", METHODS)
def test_a_method_differs_from_its_algorithm_in_what_its_row_has(method):
    row, settings = BY_ALGO[method], shipped_settings(method)
    vanilla = shipped_settings(base_algo(row))
    network = {"features_extractor_kwargs", *row.policy_kwargs} if row.policy != "MlpPolicy" else set()
    allowed = network | ({"optimizer_class", "optimizer_kwargs"} if row.optimizer_class else set())
    for env_id in (name for name in settings if not name.endswith("-defaults")):
        own, base = settings[env_id], vanilla[env_id]
        differing = {name for name in own.keys() | base.keys() if own.get(name) != base.get(name)}
        assert differing <= {"callback", "policy_kwargs"} | ({"policy"} if network else set())
        n_base = len(base["callback"])
        assert own["callback"][:n_base] == base["callback"]
        added = [entry if isinstance(entry, str) else next(iter(entry)) for entry in own["callback"][n_base:]]
        assert [name.split(".")[-1] for name in added] == [callback.__name__ for callback in row.callbacks]
        of_method, of_base = keywords(own), keywords(base)
        assert {n for n in of_method.keys() | of_base.keys() if of_method.get(n) != of_base.get(n)} <= allowed


@pytest.mark.parametrize("method", dict.fromkeys(method for method, _ in DIFFERENCES))
def test_the_papers_methods_have_these_settings(method):
    settings, vanilla = shipped_settings(method), shipped_settings(base_algo(BY_ALGO[method]))
    expected = {}
    for suite in (suite for name, suite in DIFFERENCES if name == method):
        callbacks, arguments = DIFFERENCES[method, suite]
        for env_id in ENV_IDS[suite]:
            env_settings = vanilla[env_id]
            policy_kwargs = env_settings.get("policy_kwargs", "dict()")
            if suite == "gym_control":
                policy_kwargs = policy_kwargs.replace(ADAM, arguments)
            elif arguments:
                policy_kwargs = policy_kwargs[:-1] + (", " if suite == "dmc" else "") + arguments + ")"
            expected[env_id] = {
                **env_settings,
                "callback": [*env_settings["callback"], *callbacks],
                "policy_kwargs": policy_kwargs,
            }
            if method == "ppo_layer_norm" and suite != "procgen":
                expected[env_id]["policy"] = "sb3_cchain.networks.LayerNormPolicy"
    covered = {env_id: env_settings for env_id, env_settings in settings.items() if not env_id.endswith("-defaults")}
    assert {env_id: parsed(env_settings) for env_id, env_settings in covered.items()} == {
        env_id: parsed(env_settings) for env_id, env_settings in expected.items()
    }


METHOD_ROLLOUTS = {
    "gym_control": ("Continual/Acrobot-v1", 64, 32),
    "procgen": ("Continual/Starpilot-v0", 32, 16),
    "dmc": ("Continual/Walker-v0", 64, 32),
}


ROW_SUITES = [
    (method, suite) for method in METHODS for suite in BY_ALGO[method].suites or ("gym_control",) if suite in METHOD_ROLLOUTS
]


@pytest.mark.parametrize("method, suite", ROW_SUITES)
@pytest.mark.filterwarnings("ignore")
def test_every_method_trains_a_rollout_of_two_tasks_with_its_settings(tmp_path, method, suite):
    if NO_WHEELS and suite in ("procgen", "dmc"):
        pytest.skip("no wheels")
    env_id, n_steps, batch_size = METHOD_ROLLOUTS[suite]
    short = [f"n_steps:{n_steps}", f"batch_size:{batch_size}", "n_epochs:1"]
    train(tmp_path, method, env_id, 2 * n_steps, "--env-kwargs", f"steps_per_task:{n_steps}", "-params", *short)
    (path,) = tmp_path.glob(f"{method}/*/*-v?.zip")
    model = PPO.load(path, device="cpu")
    assert type(model) is PPO and model.num_timesteps == 2 * n_steps and model._n_updates == 2
    optimizer = model.policy.optimizer
    assert type(optimizer) is (BY_ALGO[method].optimizer_class or th.optim.Adam)
    if method == "ppo_kron":  # not around Adam
        assert optimizer.param_groups[0]["step"] == 4
        return
    assert optimizer.param_groups[0]["eps"] == (1e-8 if suite == "gym_control" or method == "ppo_trac" else 1e-5)
    # Two updates for each task, or those since the reset; of other parameters before the injection than after it
    n_updates = {2} if method in ("ppo_oracle", "ppo_adam_rel", "ppo_plasticity_injection") else {4}
    if method == "ppo_fire":  # of weights, and of biases
        n_updates = {2, 4}
    states = [optimizer.state[parameter] for parameter in model.policy.parameters()]
    assert {int(state["step"]) for state in states if state} == n_updates
    assert all(states) != (method == "ppo_plasticity_injection")
    assert sum(isinstance(module, th.nn.LayerNorm) for module in model.policy.features_extractor.modules()) == (
        2 if method == "ppo_layer_norm" else 0
    )


@pytest.mark.parametrize("algo, suite", [("ppo_parseval", "gym_control"), ("double_dqn_oracle", "minatar")])
def test_a_method_says_which_environments_it_covers(tmp_path, algo, suite):
    error = f"{algo}.yml has no settings for CartPole-v1, only for {', '.join(ENV_IDS[suite])}. .* -conf FILE$"
    with pytest.raises(SystemExit, match=error):
        train(tmp_path, algo, "CartPole-v1", 64)
    assert not list(tmp_path.iterdir())


def test_a_method_without_a_yaml_file_says_so(monkeypatch, tmp_path):
    monkeypatch.setattr("sb3_cchain.zoo.settings.hyperparams_folder", lambda: tmp_path)
    with pytest.raises(SystemExit, match=r"ppo_trac\.yml has no settings for CartPole-v1, and for no other.* -conf FILE"):
        train(tmp_path / "logs", "ppo_trac", "CartPole-v1", 64)


def test_the_file_of_the_user_for_a_method():
    arguments = ["--algo", "ppo_redo", "--env", "CartPole-v1", "-conf", "mine.yml"]
    assert add_settings_file(arguments) == arguments


# All parts of a method, without what only logs
PARTS = {
    "ppo_trac": ["TRAC"],
    "ppo_redo": ["ReDo"],
    "ppo_layer_norm": ["LayerNormPolicy"],
    "ppo_ewc": ["EWCConsolidation", "EWC"],
    "ppo_normalize_and_project": ["NormalizeAndProject", "LayerNormPolicy"],
    "ppo_plasticity_injection": ["PlasticityInjection", "InjectionPolicy"],
    "ppo_cchain": [],
}


@pytest.mark.parametrize("algo, parts", PARTS.items())
def test_what_settings_lack_of_a_method_is_found(algo, parts):
    method = BY_ALGO[algo]
    assert missing_parts(method, {"policy": "MlpPolicy"}, []) == parts
    assert missing_parts(method, {"policy": "MlpPolicy", "policy_kwargs": {"features_extractor_class": object}}, []) == [
        part for part in parts if not part.endswith("Policy")
    ]
    there = {"policy": method.policy, "policy_kwargs": {"optimizer_class": method.optimizer_class}}
    callbacks = [callback() for callback in method.callbacks]
    assert missing_parts(method, there, callbacks) == []
    assert missing_parts(method, there, [EveryNTimesteps(10, CallbackList(callbacks))]) == []
    stock = [part for part in parts if part.endswith("Policy")]
    assert missing_parts(method, {**there, "policy": ActorCriticPolicy}, callbacks) == stock
    # An optimiser inside of others
    inside = {"optimizer_class": UPGD, "optimizer_kwargs": {"base_class": method.optimizer_class, "base_kwargs": None}}
    assert missing_parts(method, {**there, "policy_kwargs": inside}, callbacks) == []


def test_a_file_of_the_user_without_the_method_is_refused(tmp_path):
    file, logs = tmp_path / "mine.yml", tmp_path / "logs"
    file.write_text("CartPole-v1:\n  policy: MlpPolicy\n  n_timesteps: 64\n  n_steps: 32\n")
    with pytest.raises(SystemExit, match=r"ppo_trac: the settings of CartPole-v1 in .*mine\.yml lack TRAC, .*ppo_trac\.yml"):
        train(logs, "ppo_trac", "CartPole-v1", 64, "-conf", file)
    assert not logs.exists()
    with pytest.raises(SystemExit, match=r"lack TRAC, .* -params replaces the whole of policy_kwargs\. .*ppo_trac\.yml"):
        train(logs, "ppo_trac", "Continual/CartPole-v1", 64, "-params", "policy_kwargs:dict(net_arch=[8])")
    train(logs, "ppo_cchain", "CartPole-v1", 64, "-conf", file)


# --- What RL Zoo saved beside a model -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "value",
    [
        OrderedDict(env="CartPole-v1", env_kwargs=None, seed=3, track=False, learning_rate=1e-3),
        OrderedDict(),
        OrderedDict(env_kwargs={"size": (3, 4), "nested": OrderedDict(a=[1.5, "b"])}),
        OrderedDict(policy_kwargs=dict(net_arch=[8], activation_fn=th.nn.ReLU)),
    ],
)
def test_what_rl_zoo_writes_is_read(value):
    read = yaml.load(yaml.dump(value), SettingsLoader)
    assert read == value and type(read) is OrderedDict


def test_settings_in_a_python_file_are_read_back(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(
        "import numpy as np\n"
        "from gymnasium.wrappers import TimeLimit\n"
        "from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes\n"
        "hyperparams = {'CartPole-v1': dict(policy='MlpPolicy', n_timesteps=np.int64(32), n_steps=32, gamma=np.float32(0.5),"
        " env_wrapper=[{TimeLimit: dict(max_episode_steps=9)}])}\n"
    )
    train(tmp_path, "ppo_cchain", "CartPole-v1", 32, "-conf", file)
    command("enjoy", "--algo", "ppo_cchain", "--env", "CartPole-v1", "-f", tmp_path, "-n", 10, "--no-render")
    with file.open("a") as settings:
        settings.write("hyperparams['CartPole-v1']['callback'] = [StopTrainingOnMaxEpisodes(9)]\n")
    with pytest.warns(UserWarning, match=r"will not play this model: .*config\.yml cannot be read: .*StopTraining"):
        train(tmp_path, "ppo_cchain", "CartPole-v1", 32, "-conf", file)


@pytest.mark.parametrize(
    "text",
    [
        "!!python/object/apply:os.mkdir [made]",
        "env_kwargs: !!python/object/apply:os.mkdir [made]",
        "!!python/object/apply:collections.OrderedDict\n- - - env\n    - !!python/object/apply:os.mkdir [made]",
        "!!python/object/new:os.mkdir [made]",
        '!!python/object/apply:eval [\'__import__("os").mkdir("made")\']',
        "!!python/module:antigravity",
        "!!python/object/apply:collections.OrderedDict {a: 1}",
    ],
)
def test_nothing_in_a_file_is_called(text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(yaml.YAMLError):
        yaml.load(text, SettingsLoader)
    # enjoy, too, reads it by this loader
    CChainPPO("MlpPolicy", "CartPole-v1", device="cpu").save("ppo_cchain/CartPole-v1.zip")
    (tmp_path / "ppo_cchain" / "CartPole-v1").mkdir()
    for name in ("args.yml", "config.yml"):
        path = tmp_path / "ppo_cchain" / "CartPole-v1" / name
        path.write_text(text)
        with pytest.raises(SystemExit, match=r"(?s)cannot be read: .*give their names in a YAML file"):
            command("enjoy", "--algo", "ppo_cchain", "--env", "CartPole-v1", "-f", ".", "--exp-id", "-1", "--no-render")
        path.unlink()
    assert not (tmp_path / "made").exists()
    assert yaml.UnsafeLoader is not SettingsLoader
