"""``sb3-cchain train -optimize``."""

from dataclasses import replace

import numpy as np
import optuna
import pytest
from rl_zoo3 import ALGOS
from stable_baselines3 import A2C, PPO, SAC

import sb3_cchain.methods
import sb3_cchain.zoo.cli as zoo
import sb3_cchain.zoo.search as search
import sb3_cchain.zoo.settings
from sb3_cchain.algorithms import CChainDQN, CChainPPO
from sb3_cchain.algorithms.churn_targets import KINDS
from sb3_cchain.algorithms.reference_batches import REFERENCES
from sb3_cchain.methods.registry import BY_ALGO, REGISTRY
from sb3_cchain.zoo.search import _BETAS
from tests.zoo_command import FAST, NO_EVALUATION, command, search_short_rollouts

OPTIMIZE = ("-optimize", "--n-evaluations", "1", "--eval-episodes", "1", "--no-optim-plots", "--seed", "1")


def read_report(folder):
    (report,) = folder.glob("report_*.csv")
    header, *trials = (line.split(",") for line in report.read_text().splitlines())
    return [dict(zip(header, trial, strict=True)) for trial in trials]


def test_beta_is_searched_for_ppo_cchain(tmp_path, monkeypatch):
    search_short_rollouts(monkeypatch, PPO)
    command(
        *("train", "--algo", "ppo_cchain", "--env", "Continual/CartPole-v1", "-n", "100", "-f", tmp_path, *FAST),
        *(*OPTIMIZE, "--n-trials", "2"),
    )
    ratios = [float(trial["params_target_churn_ratio"]) for trial in read_report(tmp_path / "ppo_cchain")]
    assert len(set(ratios)) == 2 and all(1e2 <= ratio <= 1e6 for ratio in ratios)


def test_beta_is_searched_for_dqn_cchain(tmp_path):
    command(
        *("train", "--algo", "dqn_cchain", "--env", "Continual/MinAtar-v0", "-n", "60", "-f", tmp_path, *FAST),
        *(
            "--env-kwargs",
            "steps_per_task:20",
            *OPTIMIZE,
            "--n-trials",
            "2",
            "-params",
            "buffer_size:1000",
            "learning_starts:0",
        ),
        "callback:['sb3_cchain.TaskSync', 'sb3_cchain.ContinualMetrics']",
    )
    trials = read_report(tmp_path / "dqn_cchain")
    assert all("params_net_arch" not in trial for trial in trials)
    ratios = [float(trial["params_target_churn_ratio"]) for trial in trials]
    assert len(set(ratios)) == 2 and all(1e-3 <= ratio <= 1e-1 for ratio in ratios)


@pytest.mark.parametrize("algo", ["dqn_cchain", "double_dqn", "ppo_cchain", "sac_cchain"])
def test_reports_show_the_values_that_powers_and_differences_stand_for(algo):
    search.register_search_spaces()
    trial = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0)).ask()
    sampled = search.HYPERPARAMS_SAMPLER[algo](trial, 0, 1, {"using_her_replay_buffer": False})
    assert {name: trial.user_attrs[name] for name in ("gamma", "batch_size")}.items() <= sampled.items()


@pytest.mark.parametrize("algo, n_actions, low, high", [("ppo_cchain", 0, 1e2, 1e6), ("ppo_cchain", 2, 5e-3, 5.0)])
def test_the_range_of_beta_depends_on_the_actions(algo, n_actions, low, high):
    search.register_search_spaces()
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    sample = search.HYPERPARAMS_SAMPLER[algo]
    ratios = [sample(study.ask(), n_actions, 1, {})["target_churn_ratio"] for _ in range(20)]
    assert low <= min(ratios) < max(ratios) <= high
    assert np.ptp(np.log10(ratios)) > 1


@pytest.mark.parametrize(
    "algo, churn_target, ranges",
    [
        ("ppo_cchain", "value", {"": (1e-3, 1e-1)}),
        ("sac_cchain", "value", {"": (1e-4, 1e-2)}),
        ("sac_cchain", "both", {"policy": (5e-7, 5e-5), "value": (1e-4, 1e-2)}),
    ],
)
def test_the_beta_of_what_is_held_still_is_searched(algo, churn_target, ranges):
    search.register_search_spaces()
    search.search_churn_target(algo, churn_target)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for trial in (study.ask() for _ in range(10)):
        ratios = search.HYPERPARAMS_SAMPLER[algo](trial, 0, 1, {"using_her_replay_buffer": False})["target_churn_ratio"]
        assert search.HYPERPARAMS_CONVERTER[algo](trial.params)["target_churn_ratio"] == ratios
        by_name = ratios if churn_target == "both" else {"": ratios}
        assert all(low <= by_name.pop(name) <= high for name, (low, high) in ranges.items()) and not by_name
    with pytest.raises(ValueError, match='`churn_target` of CChainDQN must be "value"'):
        search.search_churn_target("dqn_cchain", "policy")
    search.register_search_spaces()


def test_a_search_follows_the_settings(tmp_path):
    options = ("--algo", "a2c_cchain", "--env", "CartPole-v1", "-n", "64", "-f", tmp_path, *FAST, *OPTIMIZE, "--n-trials", "2")
    command("train", *options, "-params", "churn_target:'both'")
    for trial in read_report(tmp_path / "a2c_cchain"):
        assert 0.1 <= float(trial["params_target_churn_ratio_policy"]) <= 1e3
        assert 1e-4 <= float(trial["params_target_churn_ratio_value"]) <= 1e-2


@pytest.mark.parametrize("algo, sizes", [("ppo_cchain", {0.25, 0.5, 1.0, 2.0, 4.0, 8.0}), ("dqn_cchain", {None})])
def test_reference_batches_are_searched(algo, sizes):
    search.register_search_spaces()
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    sample = search.HYPERPARAMS_SAMPLER[algo]
    sampled = [sample(study.ask(), 0, 1, {"using_her_replay_buffer": False}) for _ in range(40)]
    assert {each["churn_reference"] for each in sampled} == set(REFERENCES)
    assert {each.get("churn_batch_size") for each in sampled} == sizes


def test_the_papers_grids():
    grids = {algo: list(BY_ALGO[algo].grid.values()) for algo in ("ppo_weight_clipping", "ppo_l2_init")}
    assert grids == {"ppo_weight_clipping": [(0.1, 0.5, 1, 10)], "ppo_l2_init": [(0.1, 1, 10, 100, 1000)]}


@pytest.mark.parametrize("method", [method for method in REGISTRY if method.grid], ids=lambda method: method.algo)
def test_trial_id_is_refused_for_grids(method):
    search.register_search_spaces()
    with pytest.raises(ValueError, match=r"`--trial-id`.*'coef': 0.1.*-conf"):
        search.HYPERPARAMS_CONVERTER[method.algo]({"coef": 0.1})


@pytest.fixture
def study(tmp_path):
    """A study of A2C with two trials, γ 0.97 and 0.98: its storage and its name."""
    path = str(tmp_path / "study.log")
    storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(path))
    study = optuna.create_study(storage=storage, study_name="mine")
    for one_minus_gamma in (0.03, 0.02):
        study.enqueue_trial({"one_minus_gamma": one_minus_gamma})
        trial = study.ask()
        search.HYPERPARAMS_SAMPLER["a2c"](trial, 0, 1, {})
        study.tell(trial, 0.0)
    return ["--storage", path, "--study-name", "mine"]


TRAIN_A2C = ("train", "--algo", "a2c", "--env", "CartPole-v1", "-n", "16", *FAST, *NO_EVALUATION)


@pytest.mark.parametrize("trial, gamma", [(0, 0.97), (1, 0.98)])
def test_trains_with_the_values_of_any_trial(tmp_path, study, trial, gamma):
    command(*TRAIN_A2C, "-f", tmp_path, *study, "--trial-id", trial, "-params", "n_steps:8", "max_grad_norm:0.25")
    model = A2C.load(tmp_path / "a2c" / "CartPole-v1_1" / "CartPole-v1.zip", device="cpu")
    assert (model.gamma, model.n_steps, model.max_grad_norm) == (pytest.approx(gamma), 8, 0.25)


def test_a_trial_that_is_not_there_is_named(tmp_path, study):
    with pytest.raises(SystemExit, match=r"--trial-id 2: the study mine in .* has no such trial"):
        command(*TRAIN_A2C, "-f", tmp_path, *study, "--trial-id", 2)
    with pytest.raises(SystemExit, match="--trial-id 0 is a trial of a study: give its --storage"):
        command(*TRAIN_A2C, "-f", tmp_path, "--trial-id", 0)


@pytest.mark.parametrize("option", [[], ["-conf", "mine.yml"]])
@pytest.mark.parametrize(
    "method", [method for method in REGISTRY if method.is_related and not method.grid], ids=lambda m: m.algo
)
def test_a_method_with_nothing_to_search_says_so(tmp_path, method, option):
    algo = {"PPO": "ppo", "DoubleDQN": "double_dqn"}[method.algorithm.__name__]
    error = f"{method.algo} has no hyperparameters of its own to search.* --algo {algo} -optimize"
    with pytest.raises(SystemExit, match=error):
        command("train", "--algo", method.algo, "--env", "Continual/Starpilot-v0", "-f", tmp_path, "-optimize", *option)
    assert not list(tmp_path.iterdir())


# Those of the shipped settings, and others for the sake of a fast test
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


@pytest.mark.parametrize("algo, part", [("ppo_weight_clipping", "WeightClipping"), ("ppo_redo", "ReDo")])
def test_a_grid_keeps_everything_else_of_the_settings(monkeypatch, tmp_path, algo, part):
    given = []

    class Spy(getattr(sb3_cchain.methods, part)):
        def __init__(self, *args, **kwargs):
            given.append(kwargs)
            super().__init__(*args, **kwargs)

    monkeypatch.setattr(sb3_cchain.methods, part, Spy)
    (tmp_path / "mine.yml").write_text(REDO_FILE)
    command(
        *("train", "--algo", algo, "--env", "Continual/CartPole-v1", "-n", "64", "-f", tmp_path, *FAST, *OPTIMIZE),
        *("--n-trials", "3", *(("-conf", tmp_path / "mine.yml") if algo == "ppo_redo" else ())),
        *("-params", "n_steps:64", "n_epochs:1", "batch_size:32"),
    )
    trials, grid = read_report(tmp_path / algo), BY_ALGO[algo].grid
    tried = [{name: float(trial[f"params_{name}"]) for name in grid} for trial in trials]
    assert [trial["state"] for trial in trials] == ["COMPLETE"] * 3
    assert all(value in grid[name] for trial in tried for name, value in trial.items())
    if algo == "ppo_redo":
        assert given == [{"batch_size": 16}, *({"batch_size": 16, **trial} for trial in tried)]
    else:
        assert given == [{"lr": 1e-3, "base_kwargs": {"eps": 1e-8, "fused": True}, **trial} for trial in tried]


def test_arguments_of_a_callback():
    redo, name = sb3_cchain.methods.ReDo, "sb3_cchain.methods.ReDo"
    with pytest.raises(ValueError, match=r"`callback` must have ReDo, got \['sb3_cchain.TaskSync'\]"):
        search.add_to_callback(["sb3_cchain.TaskSync"], redo, {"tau": 0.1})
    with pytest.raises(ValueError, match=r"-optimize: `callback` must hold names of classes, .* got <.*ReDo object"):
        search.add_to_callback([redo()], redo, {"tau": 0.1})
    assert search.add_to_callback(name, redo, {"tau": 0.1}) == [{name: {"tau": 0.1}}]
    # By another path to the same class
    name = f"{redo.__module__}.ReDo"
    assert search.add_to_callback([{name: {"interval": 2}}], redo, {"tau": 0.1}) == [{name: {"interval": 2, "tau": 0.1}}]


# --- A new row of the registry --------------------------------------------------------------------------------------------


class NewPPO(CChainPPO):
    """An algorithm with churn reduction that the command line has not heard of."""


class NewDQN(CChainDQN):
    """The same, off-policy."""


class NewSAC(SAC):
    """One without churn reduction."""


NEW_ROWS = {
    "new_ppo": (replace(BY_ALGO["ppo_cchain"], name="new", algo="new_ppo", algorithm=NewPPO), (1e2, 1e6)),
    "new_dqn": (replace(BY_ALGO["dqn_cchain"], name="new", algo="new_dqn", algorithm=NewDQN), (1e-3, 1e-1)),
    "new_sac": (replace(BY_ALGO["ppo"], name="new", algo="new_sac", algorithm=NewSAC), None),
    "new_method": (
        replace(BY_ALGO["ppo_l2_init"], name="new", algo="new_method", grid={"coef": [3.0, 5.0]}),
        None,
    ),
}


@pytest.fixture(params=NEW_ROWS)
def new_row(request, monkeypatch):
    row, beta = NEW_ROWS[request.param]
    for module in (zoo, search, sb3_cchain.zoo.settings):
        monkeypatch.setattr(module, "REGISTRY", (*REGISTRY, row))
    monkeypatch.setitem(BY_ALGO, row.algo, row)
    yield row, beta
    for table in (ALGOS, search.HYPERPARAMS_SAMPLER, search.HYPERPARAMS_CONVERTER):
        table.pop(row.algo, None)


def test_a_new_row_trains_and_is_searched(new_row, tmp_path):
    row, beta = new_row
    env_id = "Pendulum-v1" if row.algorithm is NewSAC else "Continual/CartPole-v1"
    short = {"new_dqn": "buffer_size: 100", "new_sac": "buffer_size: 100"}.get(row.algo, "n_steps: 32\n  batch_size: 16")
    optimizer = "optimizer_class=get_class_by_name('sb3_cchain.methods.L2Init')" if row.optimizer_class else ""
    (tmp_path / "mine.yml").write_text(
        f'{env_id}:\n  policy: MlpPolicy\n  n_timesteps: 64\n  {short}\n  policy_kwargs: "dict({optimizer})"\n'
    )
    options = ("--algo", row.algo, "--env", env_id, "-f", tmp_path, "-conf", tmp_path / "mine.yml", *FAST)
    command("train", *options, *NO_EVALUATION)
    (path,) = tmp_path.glob(f"{row.algo}/*_1/*.zip")
    assert row.algorithm.load(path, device="cpu").num_timesteps == 64
    search.register_search_spaces()
    trial = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0)).ask()
    additional_args = {"using_her_replay_buffer": False, "her_kwargs": {}}
    sampled = search.HYPERPARAMS_SAMPLER[row.algo](trial, 0, 1, additional_args)
    if beta is not None:
        assert beta[0] <= sampled["target_churn_ratio"] <= beta[1]
    else:
        assert "target_churn_ratio" not in sampled
    if not row.is_related:
        assert "learning_rate" in sampled and search.HYPERPARAMS_CONVERTER[row.algo](trial.params)
        return
    command("train", *options, *OPTIMIZE, "--n-trials", "2")
    assert {float(trial["params_coef"]) for trial in read_report(tmp_path / row.algo)} <= {3.0, 5.0}


def test_the_range_of_beta_is_around_the_default():
    assert {beta for kind in KINDS.values() for t in kind.targets.values() for beta in t.target_ratios.values()} <= set(_BETAS)
    assert all(low <= beta / 10 and beta * 10 <= high for beta, (low, high) in _BETAS.items())
