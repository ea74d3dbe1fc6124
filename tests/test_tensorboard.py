"""TensorBoard shows a run in groups, with its hyperparameters: what TensorBoard itself reads from the files of tiny runs."""

import json

import gymnasium as gym
import pytest
import torch as th
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import HParam, configure
from stable_baselines3.common.vec_env import SubprocVecEnv
from tensorboard.backend.event_processing.data_provider import MultiplexerDataProvider
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader
from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
from tensorboard.context import RequestContext
from tensorboard.plugins.base_plugin import TBContext
from tensorboard.plugins.custom_scalar.custom_scalars_plugin import CustomScalarsPlugin
from tensorboard.plugins.hparams import metadata
from tensorboard.plugins.hparams.backend_context import Context
from tensorboard.plugins.scalar.scalars_plugin import ScalarsPlugin

from sb3_cchain import CChainCallback, CChainDQN, CChainPPO, ContinualEnv, ContinualMetrics, TaskSync, TensorBoardOverview
from sb3_cchain.methods import ReDo
from sb3_cchain.methods.registry import FAMILY_PAGE, REGISTRY
from sb3_cchain.tensorboard.hyperparameters import hyperparameters
from sb3_cchain.tensorboard.layout import LAYOUT, add_charts, layout_of
from tests.envs import CountEnv, RandomEnv
from tests.method_models import make_method

SETTINGS = dict(n_steps=16, batch_size=8, n_epochs=2, seed=0, device="cpu", policy_kwargs=dict(net_arch=[8]))
RETURNS = list(LAYOUT["Returns"])
PPO_CHURN = [title for title in LAYOUT["C-CHAIN"] if "Greedy" not in title]
DQN_CHURN = [title for title in LAYOUT["C-CHAIN"] if "Policy" not in title]


def make_env():
    return ContinualEnv([lambda: CountEnv(length=8), lambda: CountEnv(length=8)], 32)


class TensorBoard:
    """The plug-ins of a TensorBoard that has read a folder."""

    def __init__(self, folder):
        multiplexer = EventMultiplexer()
        multiplexer.AddRunsFromDirectory(str(folder)).Reload()
        context = TBContext(data_provider=MultiplexerDataProvider(multiplexer, str(folder)), plugin_name_to_instance={})
        context.plugin_name_to_instance["scalars"] = ScalarsPlugin(context)
        self._custom_scalars = CustomScalarsPlugin(context)
        self._hparams = Context(context)
        self._multiplexer = multiplexer

    def layout(self):
        """Category → title → tags matched in any run."""
        layout = self._custom_scalars.layout_impl(RequestContext(), "")
        if not layout:
            return {}
        return {
            category["title"]: {
                chart["title"]: {tag for regex in chart["multiline"]["tag"] for tag in self._matches(regex)}
                for chart in category["chart"]
            }
            for category in json.loads(layout)["category"]
        }

    def _matches(self, regex):
        for run in self._multiplexer.Runs():
            found = self._custom_scalars.scalars_impl(RequestContext(), run, regex, "")
            assert found["regex_valid"]
            yield from found["tag_to_events"]

    def titles(self):
        return {category: list(charts) for category, charts in self.layout().items()}

    def scalars(self):
        return {tag for content in self._multiplexer.Runs().values() for tag in content["tensors"]}

    def hparams(self, run="."):
        """Hyperparameters of a run."""
        content = self._multiplexer.PluginRunToTagToContent("hparams")[run][metadata.SESSION_START_INFO_TAG]
        values = metadata.parse_session_start_info_plugin_data(content).hparams
        return {name: value.string_value or value.number_value for name, value in values.items()}

    def columns(self):
        """Hyperparameters and metrics that the HPARAMS tab shows of all runs."""
        contents = self._hparams.hparams_metadata(RequestContext(), "")
        experiment = self._hparams.experiment_from_metadata(RequestContext(), "", True, contents, [], None)
        return {info.name for info in experiment.hparam_infos}, {info.name.tag for info in experiment.metric_infos}


def count_written(folder, tag):
    """How often a tag was written to the files of a run."""
    events = [event for file in folder.glob("events.*") for event in EventFileLoader(str(file)).Load()]
    return sum(value.tag == tag for event in events for value in event.summary.value)


def test_ppo_in_a_continual_environment(tmp_path):
    CChainPPO("MlpPolicy", make_env(), tensorboard_log=str(tmp_path), **SETTINGS).learn(80)
    board = TensorBoard(tmp_path)
    assert board.titles() == {"Returns": RETURNS, "C-CHAIN": PPO_CHURN}
    charts = [tags for charts in board.layout().values() for tags in charts.values()]
    assert all(charts)
    # Every metric of own is in one chart
    shown = [tag for tags in charts for tag in tags]
    own = {tag for tag in board.scalars() if tag.startswith(("continual/", "churn/"))}
    assert sorted(shown) == sorted(own - {"continual/n_switches"} | {"rollout/ep_rew_mean"})
    assert board.layout()["Returns"]["Average return of each task"] == {"continual/average_task_0", "continual/average_task_1"}


def test_dqn_in_an_environment_that_is_not_continual(tmp_path):
    model = CChainDQN(
        "MlpPolicy", RandomEnv(), learning_starts=8, buffer_size=100, device="cpu", tensorboard_log=str(tmp_path)
    )
    model.learn(160)
    board = TensorBoard(tmp_path)
    assert board.titles() == {"Returns": ["Reward per episode"], "C-CHAIN": DQN_CHURN}
    assert board.hparams("CChainDQN_1")["algorithm"] == "CChainDQN"


def logged_by_methods():
    for method in [row for row in REGISTRY if row.page != FAMILY_PAGE]:
        model, callbacks = make_method(method)
        model.learn(48, callback=callbacks, log_interval=1000)
        yield from (tag for tag in model.logger.name_to_value if not tag.startswith(("rollout/", "time/", "train/", "churn/")))


METHOD_TAGS = {"trac/scale", "l2_init/distance", "l2_init/loss", "parseval/loss", "weight_clipping/share", "redo/n_recycled"}
METHOD_TAGS |= {"redo/dormant_share", "oracle/n_resets", "adam_rel/n_resets", "shrink_and_perturb/n_steps"}
METHOD_TAGS |= {"layer_reset/n_resets", "plasticity_injection/is_injected", "normalize_and_project/norm"}
METHOD_TAGS |= {"continual_backprop/n_recycled", "regrama/n_recycled", "self_normalized_resets/n_recycled", "fire/n_resets"}
METHOD_TAGS |= {"spectral_regularization/loss", "ewc/loss", "ewc/n_tasks", "upgd/greatest_utility", "muon/share"}


def test_each_tag_of_a_method_has_one_chart():
    tags = set(logged_by_methods())
    assert tags >= METHOD_TAGS
    for tag in tags - {"continual/n_switches"}:
        assert sum(map(len, layout_of({tag}).values())) == 1, f"{tag} has no chart, or several: see add_charts"
    assert layout_of(tags)["Related methods"] == LAYOUT["Related methods"]
    for tag in ("redo/dormant_share/q_net.q_net.0", "trac/scale_actor", "parseval/loss_critic"):
        assert sum(map(len, layout_of({tag}).values())) == 1


def test_charts_can_be_added(monkeypatch):
    monkeypatch.setattr("sb3_cchain.tensorboard.layout.LAYOUT", {"Returns": {"Return": "a/return"}})
    add_charts("Returns", {"Length": "a/length"})
    add_charts("Mine", {"Any": "mine/.*"})
    assert layout_of({"a/length", "mine/x"}) == {"Returns": {"Length": "a/length"}, "Mine": {"Any": "mine/.*"}}


def test_each_tag_of_the_monitors_has_one_chart():
    names = ("dormant_share", "active_share", "feature_srank", "feature_effective_rank", "weight_norm", "distance_from_init")
    tags = {
        *(f"health/{name}{group}" for name in (*names, "gradient_norm") for group in ("", "/mlp_extractor.policy_net")),
        *(f"ntk/{name}" for name in ("srank", "effective_rank", "off_diagonal_sum", "diagonal_sum", "condition_number")),
        *(
            f"churn_monitor/{batch}/{name}"
            for batch in ("fixed", "fresh")
            for name in ("policy_churn", "value_churn", "greedy_action_changes")
        ),
    }
    of_tags = [
        [title for charts in layout_of({tag}).values() for title in charts] for tag in sorted({*tags, "eval/mean_reward"})
    ]
    assert [len(titles) for titles in of_tags] == [1] * len(of_tags)
    monitors = ("Churn, monitored", "Neural tangent kernel", "Network health")
    assert layout_of(tags) == {category: LAYOUT[category] for category in monitors}
    # Whole tags
    assert layout_of({"churn/coefficient", "my_ntk/srank", "health/dormant_shares", "continual/average_task_x"}) == {}


def test_hyperparameters(tmp_path):
    model = CChainPPO(
        "MlpPolicy",
        gym.make("Continual/CartPole-v1"),
        learning_rate=lambda remaining: 1e-3 * remaining,
        clip_range=0.3,
        churn_coef="auto_10",
        churn_window=7,
        tensorboard_log=str(tmp_path),
        **{**SETTINGS, "policy_kwargs": dict(net_arch=[8], activation_fn=th.nn.ReLU, optimizer_kwargs=dict(betas=(0.9, 0.9)))},
    )
    model.learn(32)
    assert TensorBoard(tmp_path).hparams("CChainPPO_1") == {
        "algorithm": "CChainPPO",
        "policy": "ActorCriticPolicy",
        "policy_kwargs.net_arch": "[8]",
        "policy_kwargs.activation_fn": "ReLU",
        "policy_kwargs.optimizer_kwargs.betas": "(0.9, 0.9)",
        "env": "Continual/CartPole-v1",
        "n_envs": 1,
        "seed": 0,
        "learning_rate": 1e-3,
        "n_steps": 16,
        "batch_size": 8,
        "n_epochs": 2,
        "gamma": 0.99,
        "gae_lambda": 0.95,
        "clip_range": 0.3,
        "normalize_advantage": "True",
        "ent_coef": 0,
        "vf_coef": 0.5,
        "max_grad_norm": 0.5,
        "use_sde": "False",
        "sde_sample_freq": -1,
        "rollout_buffer_class": "RolloutBuffer",
        "churn_coef": "auto_10",
        "target_churn_ratio": "auto",
        "churn_target": "auto",
        "churn_warmup": 10,
        "churn_window": 7,
        "churn_coef_min": 0,
        "reset_churn_coef": "False",
        "churn_base_loss": "actor",
        "churn_component": "full",
        "churn_reference": "independent",
        "churn_batch_size": 1.0,
        "lean": "True",
    }


def test_hyperparameters_of_dqn():
    values = hyperparameters(DQN("MlpPolicy", "CartPole-v1", buffer_size=50, train_freq=(2, "episode"), device="cpu"))
    assert (values["env"], values["train_freq"], values["buffer_size"]) == ("CartPole-v1", "2 episode", 50)
    assert "seed" not in values and "verbose" not in values


def test_infinity_which_tensorboard_cannot_show_is_a_string():
    assert hyperparameters(PPO("MlpPolicy", RandomEnv(), max_grad_norm=float("inf"), device="cpu"))["max_grad_norm"] == "inf"


def test_an_environment_in_another_process_is_not_asked_for_its_name():
    env = make_vec_env("CartPole-v1", n_envs=2, vec_env_cls=SubprocVecEnv, vec_env_kwargs=dict(start_method="forkserver"))
    values = hyperparameters(PPO("MlpPolicy", env, **SETTINGS))
    env.close()
    assert "env" not in values and values["n_envs"] == 2
    assert "env" not in hyperparameters(PPO("MlpPolicy", RandomEnv(), **SETTINGS))  # has none


@pytest.mark.parametrize(
    "callbacks, category",
    [
        (lambda: [TensorBoardOverview()], "Returns"),
        (lambda: [TaskSync(), ContinualMetrics()], "Returns"),
        (lambda: [ReDo(interval=1)], "Related methods"),
        (lambda: [CChainCallback()], "C-CHAIN"),
    ],
)
def test_stock_ppo(tmp_path, callbacks, category):
    PPO("MlpPolicy", make_env(), tensorboard_log=str(tmp_path), **SETTINGS).learn(64, callback=callbacks())
    board = TensorBoard(tmp_path)
    assert category in board.titles()
    assert all(tags for charts in board.layout().values() for tags in charts.values())
    assert board.hparams("PPO_1")["algorithm"] == "PPO"


@pytest.mark.parametrize("algorithm, kwargs", [(A2C, dict(n_steps=8)), (DQN, dict(learning_starts=8, buffer_size=100))])
def test_other_algorithms(tmp_path, algorithm, kwargs):
    model = algorithm("MlpPolicy", RandomEnv(), device="cpu", tensorboard_log=str(tmp_path), **kwargs)
    model.learn(64, callback=TensorBoardOverview(), log_interval=1)
    board = TensorBoard(tmp_path)
    assert board.titles() == {"Returns": ["Reward per episode"]}
    assert board.hparams(f"{algorithm.__name__}_1")["algorithm"] == algorithm.__name__


def test_nothing_is_written_twice(tmp_path):
    model = CChainPPO("MlpPolicy", make_env(), **SETTINGS)
    model.set_logger(configure(str(tmp_path), ["tensorboard"]))
    callbacks = [TensorBoardOverview(), ContinualMetrics(), ReDo(interval=1), TensorBoardOverview()]
    model.learn(64, callback=callbacks)
    model.learn(64, callback=callbacks, reset_num_timesteps=False)
    model.logger.close()
    assert count_written(tmp_path, metadata.SESSION_START_INFO_TAG) == 1
    # When the first rollout is over, and when the first updates are logged
    assert count_written(tmp_path, "custom_scalars__config__") == 2
    board = TensorBoard(tmp_path)
    assert board.titles() == {
        "Returns": RETURNS,
        "C-CHAIN": PPO_CHURN,
        "Related methods": ["ReDo: dormant units, share", "ReDo: units recycled"],
    }


def test_resumed_in_the_same_folder(tmp_path):
    model = CChainPPO("MlpPolicy", make_env(), tensorboard_log=str(tmp_path), **SETTINGS).learn(48)
    model.save(tmp_path / "model")
    loaded = CChainPPO.load(tmp_path / "model", env=make_env(), device="cpu", churn_coef=3.0)
    loaded.learn(48, reset_num_timesteps=False)
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == ["CChainPPO_1"]
    board = TensorBoard(tmp_path)
    assert board.titles() == {"Returns": RETURNS, "C-CHAIN": PPO_CHURN}
    assert board.hparams("CChainPPO_1")["churn_coef"] == "auto"  # TensorBoard shows what the run began with


def test_two_runs_side_by_side(tmp_path):
    CChainPPO("MlpPolicy", make_env(), tensorboard_log=str(tmp_path), **SETTINGS).learn(48)
    stock = PPO("MlpPolicy", make_env(), tensorboard_log=str(tmp_path), **SETTINGS)
    stock.learn(48, callback=[TaskSync(), ContinualMetrics()])
    board = TensorBoard(tmp_path)
    assert board.titles() == {"Returns": RETURNS, "C-CHAIN": PPO_CHURN}
    # Whichever comes first, the table has what only one of them has
    names, metrics = board.columns()
    assert names == set(board.hparams("CChainPPO_1")) > set(board.hparams("PPO_1"))
    assert {"continual/average_performance", "rollout/ep_rew_mean"} <= metrics


class HParamCallback(BaseCallback):
    """As in SB3's documentation."""

    def _on_training_start(self):
        hparams = HParam({"mine": 1.0}, {"rollout/ep_rew_mean": 0.0})
        self.logger.record("hparams", hparams, exclude=("stdout", "log", "json", "csv"))

    def _on_step(self):
        return True


@pytest.mark.parametrize("callbacks", [[HParamCallback(), TensorBoardOverview()], [TensorBoardOverview(), HParamCallback()]])
def test_hyperparameters_that_the_user_records_are_left_alone(tmp_path, callbacks):
    PPO("MlpPolicy", RandomEnv(), tensorboard_log=str(tmp_path), **SETTINGS).learn(16, callback=callbacks)
    board = TensorBoard(tmp_path)
    assert board.hparams("PPO_1") == {"mine": 1}
    assert board.columns() == ({"mine"}, {"rollout/ep_rew_mean"})


def test_tags_that_are_not_for_tensorboard_are_not_laid_out(tmp_path):
    class Excluding(TensorBoardOverview):
        def _on_rollout_end(self):
            self.logger.record("ntk/srank", 1.0, exclude="tensorboard")
            self.logger.record("ntk/diagonal_sum", 1.0)

    PPO("MlpPolicy", RandomEnv(), tensorboard_log=str(tmp_path), **SETTINGS).learn(32, callback=Excluding())
    assert TensorBoard(tmp_path).titles()["Neural tangent kernel"] == ["Sum of |diagonal|"]


def test_other_outputs_are_left_alone(tmp_path, capsys):
    model = CChainPPO("MlpPolicy", make_env(), **SETTINGS)
    model.set_logger(configure(str(tmp_path), ["stdout", "log", "json", "csv", "tensorboard"]))
    model.learn(48)
    printed = capsys.readouterr().out
    assert "coef" in printed and "hparams" not in printed
    for name in ("log.txt", "progress.json", "progress.csv"):
        written = (tmp_path / name).read_text()
        assert "coef" in written and "hparams" not in written


def test_without_tensorboard_nothing_happens(tmp_path):
    silent = CChainPPO("MlpPolicy", make_env(), **SETTINGS).learn(48, callback=TensorBoardOverview())
    assert len(silent.logger.output_formats) == 0
    # And with it, training is the same to the bit
    shown = CChainPPO("MlpPolicy", make_env(), tensorboard_log=str(tmp_path), **SETTINGS).learn(48)
    for name, parameter in silent.policy.state_dict().items():
        assert th.equal(parameter, shown.policy.state_dict()[name]), name


def test_from_yaml():
    zoo = pytest.importorskip("rl_zoo3.utils")
    (callback,) = zoo.get_callback_list({"callback": "sb3_cchain.TensorBoardOverview"})
    assert isinstance(callback, TensorBoardOverview)
