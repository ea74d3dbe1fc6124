"""The related methods in training, alone and together, with and without C-CHAIN."""

import numpy as np
import pytest
import rl_zoo3.exp_manager
import torch as th
import yaml
from rl_zoo3.utils import get_callback_list
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.logger import configure

from sb3_cchain import CChainDQN, CChainPPO, DoubleDQN
from sb3_cchain.methods import AdamRel, OptimizerMetrics, WeightClipping
from tests.envs import RandomEnv
from tests.method_models import OPTIMIZERS, go_on, nested_optimizers, optimizer_arguments

SETTINGS = {
    PPO: dict(n_steps=16, batch_size=8, n_epochs=2),
    DQN: dict(learning_starts=10, buffer_size=100, batch_size=4, train_freq=1, target_update_interval=7),
}
METHODS = {
    **{
        name: dict(optimizer_class=row.optimizer_class, optimizer_kwargs=optimizer_arguments(row))
        for name, row in OPTIMIZERS.items()
    },
    "all": nested_optimizers(),
}
# Besides the one key or more that each method logs
ALL_KEYS = {
    "trac/scale",
    "weight_clipping/share",
    "l2_init/loss",
    "l2_init/distance",
    "parseval/loss",
    "normalize_and_project/norm",
    "spectral_regularization/loss",
    "ewc/loss",
    "upgd/greatest_utility",
    "muon/share",
}


def make(cls, method):
    settings = SETTINGS[PPO if issubclass(cls, PPO) else DQN]
    policy_kwargs = dict(net_arch=[4, 4], **METHODS[method])
    return cls("MlpPolicy", RandomEnv(), policy_kwargs=policy_kwargs, learning_rate=0.01, seed=0, device="cpu", **settings)


@pytest.mark.parametrize(
    "cls, method",
    [
        *((cls, "all") for cls in (PPO, DQN, DoubleDQN)),
        *((cls, method) for cls in (CChainPPO, CChainDQN) for method in METHODS),
    ],
)
def test_saved_and_loaded_goes_on_as_if_never_stopped(tmp_path, cls, method):
    model = make(cls, method)
    metrics = OptimizerMetrics()
    model.learn(48, callback=[metrics, AdamRel()], log_interval=1000)
    logged = model.logger.name_to_value
    assert OPTIMIZERS.keys() & {key.split("/")[0] for key in logged} == (set(OPTIMIZERS) if method == "all" else {method})
    assert method != "all" or ALL_KEYS <= logged.keys()
    assert logged["adam_rel/n_resets"] >= 2
    if issubclass(cls, (CChainPPO, CChainDQN)):
        assert "churn/loss" in logged

    model.save(tmp_path / "model")
    loaded = cls.load(tmp_path / "model", env=RandomEnv(), device="cpu")
    in_place = make(cls, method)
    in_place.learn(16)
    in_place.set_parameters(tmp_path / "model", device="cpu")
    if isinstance(model, DQN):
        model.save_replay_buffer(tmp_path / "buffer")
        loaded.load_replay_buffer(tmp_path / "buffer")
    for other in (loaded, in_place):
        assert other.policy.optimizer.metrics() == model.policy.optimizer.metrics()
    for each in (model, loaded):
        go_on(each, AdamRel())
    for p, q in zip(model.policy.parameters(), loaded.policy.parameters(), strict=True):
        assert th.equal(p, q)
    assert loaded.policy.optimizer.metrics() == model.policy.optimizer.metrics()


@pytest.mark.parametrize("cls", [PPO, DQN])
def test_l2_init_remembers_the_initial_parameters(tmp_path, cls):
    model = make(cls, "l2_init")
    initial = [p.detach().clone() for p in model.policy.optimizer.parameters()]
    model.learn(32)
    model.save(tmp_path / "model")
    loaded = cls.load(tmp_path / "model", device="cpu")
    assert all(map(th.equal, loaded.policy.optimizer.reference(), initial))
    distance = np.sqrt(
        sum(((p - q) ** 2).sum().item() for p, q in zip(loaded.policy.optimizer.parameters(), initial, strict=True))
    )
    assert loaded.policy.optimizer.metrics()["l2_init/distance"] == pytest.approx(distance)
    assert distance > 0


def test_actor_and_critic_apart():
    policy_kwargs = dict(net_arch=[4], optimizer_class=WeightClipping)
    model = SAC("MlpPolicy", "Pendulum-v1", policy_kwargs=policy_kwargs, buffer_size=300, learning_starts=5, device="cpu")
    model.set_logger(configure(None, []))
    model.learn(210, callback=OptimizerMetrics(), log_interval=1000)
    assert {key for key in model.logger.name_to_value if "clipping" in key} == {
        "weight_clipping/share_actor",
        "weight_clipping/share_critic",
    }


def test_metrics_need_an_optimiser_that_has_them():
    with pytest.raises(TypeError, match=r"policy_kwargs=dict\(optimizer_class=TRAC\); PPO has Adam"):
        PPO("MlpPolicy", RandomEnv(), device="cpu").learn(10, callback=OptimizerMetrics())


def test_from_yaml():
    """What RL Zoo makes of a YAML file."""
    hyperparams = yaml.safe_load("""
        callback:
          - sb3_cchain.methods.OptimizerMetrics
          - sb3_cchain.methods.AdamRel
        policy_kwargs: "dict(
          net_arch=[4],
          optimizer_class=get_class_by_name('sb3_cchain.methods.TRAC'),
          optimizer_kwargs=dict(
            base_class=get_class_by_name('sb3_cchain.methods.WeightClipping'),
            base_kwargs=dict(clip_ratio=1.0, base_kwargs=dict(eps=1e-5)),
            ),
          )"
        """)
    policy_kwargs = eval(hyperparams["policy_kwargs"], vars(rl_zoo3.exp_manager))
    callbacks = get_callback_list(hyperparams)
    assert [type(callback) for callback in callbacks] == [OptimizerMetrics, AdamRel]
    model = PPO("MlpPolicy", RandomEnv(), n_steps=16, batch_size=8, policy_kwargs=policy_kwargs, device="cpu")
    model.learn(32, callback=callbacks, log_interval=100)
    assert {"trac/scale", "weight_clipping/share", "adam_rel/n_resets"} <= set(model.logger.name_to_value)
    assert model.policy.optimizer.param_groups[0]["eps"] == 1e-5
