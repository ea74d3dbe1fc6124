"""Churn reduction of all algorithms of Stable-Baselines3 and sb3-contrib, from one table."""

import copy
import gc
import pickle
import sys
import warnings
from dataclasses import dataclass
from inspect import Parameter, signature
from typing import Any
from weakref import ref

import numpy as np
import pytest
import sb3_contrib
import stable_baselines3
import torch as th
from gymnasium import spaces
from sb3_contrib.common.wrappers import ActionMasker
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

import sb3_cchain
from sb3_cchain import CChainCallback, ChurnMonitor
from sb3_cchain.algorithms.churn_targets import KINDS, churn_kind
from sb3_cchain.algorithms.reference_batches import PreviousRollout
from sb3_cchain.churn import cross_entropy, mean_squared_difference
from tests.churn_models import DICT, IMAGE, NormalisedExtractor, assert_close, assert_equal, differ, go_on
from tests.envs import RandomEnv
from tests.sb3_source import COEF, NUMBERED_MINIBATCHES, rewritten

BOX = spaces.Box(-2, 2, (2,), np.float32)
SMALL = dict(seed=0, device="cpu", policy_kwargs=dict(net_arch=[16]))
OFF_POLICY = dict(learning_starts=20, buffer_size=200, batch_size=16, train_freq=1, learning_rate=1e-3, **SMALL)
PPO_SETTINGS = dict(n_steps=32, batch_size=8, n_epochs=2, learning_rate=3e-3, **SMALL)


@dataclass(frozen=True)
class Member:
    """
    :param name: Of the stock algorithm
    :param settings: Its arguments
    :param targets: What it can hold still, the default first
    :param continuous: Whether its actions are
    """

    name: str
    settings: dict[str, Any]
    targets: tuple[str, ...] = ("policy", "value", "both")
    continuous: bool = False

    @property
    def stock(self):
        return getattr(stable_baselines3, self.name, None) or getattr(sb3_contrib, self.name)

    @property
    def algorithm(self):
        return getattr(sb3_cchain, f"CChain{self.name}")

    def make_env(self, observation_space=None, action_space=None):
        env = RandomEnv(observation_space, action_space or (BOX if self.continuous else None))
        return ActionMasker(env, mask) if self.name == "MaskablePPO" else env

    def make(self, algorithm=None, env=None, policy="Mlp", **kwargs):
        algorithm = self.algorithm if algorithm is None else algorithm
        policy = policy + ("LstmPolicy" if self.name == "RecurrentPPO" else "Policy")
        return algorithm(policy, self.make_env() if env is None else env, **copy.deepcopy({**self.settings, **kwargs}))


def mask(env):
    return np.array([True, bool(env.unwrapped.n_steps % 2), True])


LSTM = dict(PPO_SETTINGS, policy_kwargs=dict(net_arch=[16], lstm_hidden_size=8))
QUANTILES = dict(OFF_POLICY, policy_kwargs=dict(net_arch=[16], n_quantiles=5))
FAMILY = {
    member.name: member
    for member in (
        Member("PPO", PPO_SETTINGS),
        Member("A2C", dict(n_steps=8, **SMALL)),
        Member("TRPO", dict(n_steps=32, batch_size=8, n_critic_updates=4, **SMALL), ("value",)),
        Member("MaskablePPO", PPO_SETTINGS),
        Member("RecurrentPPO", LSTM),
        Member("DQN", OFF_POLICY, ("value",)),
        Member("QRDQN", QUANTILES, ("value",)),
        Member("TQC", QUANTILES, continuous=True),
        *(Member(name, OFF_POLICY, continuous=True) for name in ("SAC", "TD3", "DDPG", "CrossQ")),
    )
}
each = pytest.mark.parametrize("member", FAMILY.values(), ids=FAMILY)
each_target = pytest.mark.parametrize(
    "member, target",
    [pytest.param(member, target, id=f"{name}-{target}") for name, member in FAMILY.items() for target in member.targets],
)
N_STEPS = 100
FEW_STEPS = 60  # two rollouts, or 40 updates


def logged(model):
    return {key: value for key, value in model.logger.name_to_value.items() if key.startswith("churn/")}


def learn(model, n_steps=N_STEPS, callback=None):
    """Nothing is written, so that what the last updates recorded can be looked at."""
    return model.learn(n_steps, callback, log_interval=10**6)


# --- Off, on, and the same by a callback -----------------------------------------------------------------------------------


@each
def test_with_a_coefficient_of_0_it_is_its_base(member):
    target = member.targets[-1]
    arguments = dict(double_q=False) if member.name == "DQN" else {}  # otherwise CChainDQN is a Double DQN
    stock, number = learn(member.make(member.stock)), np.random.random()
    zero = {"policy": 0, "value": 0.0} if target == "both" else 0
    off = learn(member.make(churn_target=target, churn_coef=zero, **arguments))
    assert np.random.random() == number
    assert_equal(stock, off)
    assert logged(off) == {}


@each_target
def test_trains_and_logs(member, target):
    model = learn(member.make(churn_target=target), FEW_STEPS)
    targets = ("policy", "value") if target == "both" else (target,)
    expected = {f"churn/{name}_churn" for name in targets}
    for name in targets:
        prefix = f"churn/{name}" if target == "both" else "churn"
        expected |= {f"{prefix}/{key}" for key in ("loss", "coef", "relative_loss")}
    extra = {"PPO": {"churn/value_churn"}, "DQN": {"churn/greedy_action_changes"}}.get(member.name, set())
    assert expected <= logged(model).keys() <= expected | extra
    assert all(np.isfinite(value) for value in logged(model).values())
    # Of the absolute value of the loss, which some have below 0
    assert all(value > 0 for key, value in logged(model).items() if key.endswith("/relative_loss"))
    assert list(model.churn_reducers) == list(targets)
    assert model.policy.state_dict().keys() == member.make(member.stock).policy.state_dict().keys()
    # Nothing of it stays on SB3's objects
    optimizers = [getattr(model.policy, name, None) for name in ("optimizer", "actor", "critic")]
    assert not any("zero_grad" in vars(getattr(owner, "optimizer", owner)) for owner in optimizers if owner is not None)


@each
def test_the_callback_trains_the_stock_algorithm_alike(member):
    arguments = dict(churn_target=member.targets[-1], churn_warmup=1, churn_window=5)
    stock = learn(member.make(member.stock), callback=CChainCallback(**arguments))
    if member.name == "DQN":  # CChainDQN has a loop of its own, in which reference batches are drawn earlier
        assert logged(stock).keys() == {f"churn/{key}" for key in ("loss", "coef", "relative_loss", "value_churn")}
    else:
        assert_equal(learn(member.make(**arguments)), stock)
    assert "train" not in vars(stock)
    with pytest.raises(TypeError, match=f"CChain{member.name} reduces churn by itself"):
        member.make().learn(10, CChainCallback())
    with pytest.raises(ValueError, match="give it one"):
        member.make(member.stock).learn(10, [CChainCallback(), CChainCallback()])


# --- SB3's own source with the term written into its loss ------------------------------------------------------------------


def term(loss, target):
    """The line that computes a loss, and the line that logs it, which comes before the term is added."""
    return f"{loss} = {loss} + self.churn_term({target!r})"


ACTOR_CRITIC = [
    ("self.critic.optimizer.zero_grad()", term("critic_loss", "value") + "\nself.critic.optimizer.zero_grad()"),
    ("self.actor.optimizer.zero_grad()", term("actor_loss", "policy") + "\nself.actor.optimizer.zero_grad()"),
]
MINIBATCHES = [
    NUMBERED_MINIBATCHES,
    (
        "self.policy.optimizer.zero_grad()",
        "self.minibatches, self.position = minibatches, position\n"
        + term("loss", "policy")
        + "\n"
        + term("loss", "value")
        + "\nself.policy.optimizer.zero_grad()",
    ),
]
A2C_REPLACEMENTS = [
    (
        "for rollout_data in self.rollout_buffer.get(batch_size=None):",
        "for rollout_data in self.noted(self.rollout_buffer.get()):",
    ),
    (MINIBATCHES[1][0], MINIBATCHES[1][1].replace("self.minibatches, self.position = minibatches, position\n", "")),
]
SOURCES = {
    "A2C": A2C_REPLACEMENTS,
    "MaskablePPO": MINIBATCHES,
    "RecurrentPPO": MINIBATCHES,
    "QRDQN": [("self.policy.optimizer.zero_grad()", term("loss", "value") + "\nself.policy.optimizer.zero_grad()")],
    **dict.fromkeys(("SAC", "TD3", "DDPG", "TQC", "CrossQ"), ACTOR_CRITIC),
}


def written_out_outputs(self, target, sample):
    x, policy = sample.observations, self.policy
    if hasattr(sample, "lstm_states"):
        start = sample.lstm_states.pi if target == "policy" else sample.lstm_states.vf
        if target == "value":
            return policy.predict_values(x, start, sample.episode_starts)[sample.mask > 0]
        return policy.get_distribution(x, start, sample.episode_starts)[0].distribution.probs[sample.mask > 0]
    if hasattr(policy, "quantile_net"):
        return policy.quantile_net(x)
    if hasattr(policy, "critic"):
        if target == "policy":
            return policy._predict(x, deterministic=True)
        values = policy.critic(x, sample.actions)
        return th.cat(values, dim=1) if isinstance(values, tuple) else values
    if target == "value":
        return policy.predict_values(x)
    masks = [sample.action_masks] if hasattr(sample, "action_masks") else []
    return policy.get_distribution(x, *masks).distribution.probs


def written_out(member):
    class WrittenOut(member.stock):
        """SB3's, with the churn term in its losses."""

        train = rewritten(member.stock.train, *SOURCES[member.name])

        def noted(self, minibatches):
            for minibatch in minibatches:
                self.minibatches, self.position = [minibatch], 0
                yield minibatch
                self.previous = minibatch

        def reference(self):
            if hasattr(self, "replay_buffer"):
                return self.replay_buffer.sample(self.batch_size)
            if member.name == "A2C":
                return getattr(self, "previous", None)
            return self.minibatches[(self.position + (len(self.minibatches) + 1) // 2) % len(self.minibatches)]

        outputs = written_out_outputs

        def churn_term(self, target):
            pending = vars(self).setdefault("pending", {})
            loss = 0.0
            modes = {module: module.training for module in self.policy.modules()}
            self.policy.train(False)
            if target in pending:
                reference, old = pending[target]
                new = self.outputs(target, reference)
                categorical = target == "policy" and not hasattr(self, "replay_buffer")
                difference = -(old * (new + 1e-8).log()).sum() / len(old) if categorical else (new - old).square().mean()
                loss = COEF * difference
                self.n_terms = getattr(self, "n_terms", 0) + 1
            reference = self.reference()
            if reference is not None:
                pending[target] = reference, self.outputs(target, reference).detach()
            for module, mode in modes.items():
                module.training = mode
            return loss

    return WrittenOut


@pytest.mark.parametrize("name", SOURCES)
def test_equals_the_source_of_the_base_with_the_term_in_its_loss(name):
    member = FAMILY[name]
    reference = learn(member.make(written_out(member)), FEW_STEPS)
    model = learn(member.make(churn_target=member.targets[-1], churn_coef=COEF), FEW_STEPS)
    assert reference.n_terms > 10
    assert_close(reference, model, atol=1e-5)
    stock = learn(member.make(member.stock), FEW_STEPS)
    largest = max(
        (p - q).abs().max().item() for p, q in zip(stock.policy.parameters(), model.policy.parameters(), strict=True)
    )
    assert largest > 1e-3  # the term makes a difference


# --- Churn falls -----------------------------------------------------------------------------------------------------------

# β in a tiny network on random data, and the share of the change by an update, without churn reduction, that is left. A2C and
# CrossQ are not among them: see docs/modules/family.md
STRONG = {
    "PPO": {"policy": (1e5, 0.9), "value": (1.0, 0.9)},
    "TRPO": {"value": (1.0, 0.9)},
    "MaskablePPO": {"policy": (1e5, 0.9), "value": (1.0, 0.9)},
    "RecurrentPPO": {"policy": (1e5, 0.9), "value": (1.0, 0.9)},
    **{name: {"value": (1.0, 0.5)} for name in ("DQN", "QRDQN")},
    **{name: {"policy": (0.1, 0.5), "value": (1.0, 0.5)} for name in ("SAC", "TD3", "DDPG", "TQC")},
}


@pytest.mark.parametrize("name", STRONG)
def test_updates_change_the_outputs_less_on_held_out_data(name):
    member, targets = FAMILY[name], STRONG[name]
    target = "both" if len(targets) == 2 else "value"
    ratios = {key: ratio for key, (ratio, _) in targets.items()}
    churn = []
    for coef in (0.0, "auto"):
        model = member.make(churn_target=target, churn_coef=coef, target_churn_ratio=ratios, churn_warmup=0)
        learn(model, 160, [ChurnMonitor(interval=1, batch_size=64)])
        churn.append({key: model.logger.name_to_value[f"churn_monitor/fixed/{key}_churn"] for key in targets})
    without, with_reduction = churn
    for key, (_, factor) in targets.items():
        assert with_reduction[key] < factor * without[key], (key, with_reduction[key] / without[key])


# --- Saved, copied, resumed ------------------------------------------------------------------------------------------------

ADAPTIVE = dict(churn_warmup=2, churn_window=4)


@each
def test_goes_on_as_if_never_stopped(member, tmp_path):
    model = learn(member.make(churn_target=member.targets[-1], **ADAPTIVE), 64)
    model.save(tmp_path / "model")
    loaded, forgetful = (member.algorithm.load(tmp_path / "model", member.make_env(), device="cpu") for _ in range(2))
    assert loaded.churn_target == member.targets[-1]
    for each_model in (loaded, forgetful):
        if hasattr(model, "replay_buffer"):
            model.save_replay_buffer(tmp_path / "buffer")
            each_model.load_replay_buffer(tmp_path / "buffer")
    for reducer in forgetful.churn_reducers.values():
        reducer.forget_reference()
    coefs = [reducer.coefficient.value for reducer in model.churn_reducers.values()]
    assert coefs == [reducer.coefficient.value for reducer in loaded.churn_reducers.values()] and 1 not in coefs
    for each_model in (model, loaded, forgetful):
        go_on(each_model)
    assert_equal(model, loaded)
    if member.name != "TRPO":  # which forgets it by itself, because its policy's step is no churn
        assert differ(loaded, forgetful)
    # The stock algorithm loads it, and a callback goes on with λ
    stock = member.stock.load(tmp_path / "model", member.make_env(), device="cpu")
    callback = CChainCallback(churn_target=member.targets[-1], **ADAPTIVE)
    stock.set_logger(model.logger)
    callback.init_callback(stock)
    assert coefs == [reducer.coefficient.value for reducer in callback.churn_reducers.values()]


@each
def test_a_copy_has_reducers_of_its_own(member):
    model = learn(member.make(churn_target=member.targets[-1]), 48)
    other = pickle.loads(pickle.dumps(model))
    n_seen = [int(reducer.coefficient.n_seen) for reducer in model.churn_reducers.values()]
    assert n_seen == [int(reducer.coefficient.n_seen) for reducer in other.churn_reducers.values()]
    learn(other, 64)
    assert other.churn_state.reducers is other.churn_reducers is not model.churn_reducers
    assert n_seen == [int(reducer.coefficient.n_seen) for reducer in model.churn_reducers.values()]
    assert min(int(reducer.coefficient.n_seen) for reducer in other.churn_reducers.values()) > 0


@pytest.mark.parametrize("form", ["untrained", "trained", "callback"])
@each
def test_a_model_is_freed_at_once(member, form):
    """As SB3's: the garbage collector may come late for a replay buffer that fills the memory."""
    model = member.make(member.stock if form == "callback" else None)
    if form != "untrained":
        learn(model, FEW_STEPS, CChainCallback() if form == "callback" else None)
    gc.collect()  # SB3's callbacks hold the model, and themselves by their `locals`
    gc.disable()
    try:
        there = ref(model)
        del model
        assert there() is None
    finally:
        gc.enable()


@each
def test_its_signature_shows_the_arguments_of_its_base_and_then_its_own(member):
    shown, of_base = (list(signature(cls).parameters.values()) for cls in (member.algorithm, member.stock))
    n_of_base = len(of_base)
    assert [(each.name, each.default) for each in shown[:n_of_base]] == [(each.name, each.default) for each in of_base]
    assert {each.kind for each in shown[n_of_base:]} == {Parameter.KEYWORD_ONLY}
    assert {"churn_coef", "target_churn_ratio", "reset_churn_coef"} <= {each.name for each in shown[n_of_base:]}


# --- Wherever the base runs ------------------------------------------------------------------------------------------------


# sb3-contrib's CrossQ takes vectors only
@pytest.mark.parametrize(
    "member", [member for name, member in FAMILY.items() if name != "CrossQ"], ids=lambda member: member.name
)
@pytest.mark.parametrize("policy, observation_space", [("MultiInput", DICT), ("Cnn", IMAGE)], ids=["Dict", "images"])
def test_observations(member, policy, observation_space):
    env = member.make_env(observation_space)
    learning_starts = dict(learning_starts=8) if "learning_starts" in member.settings else {}
    model = member.make(env=env, policy=policy, churn_target=member.targets[-1], churn_warmup=0, **learning_starts)
    learn(model, 64 if not learning_starts else 14)
    assert all(int(reducer.coefficient.n_seen) for reducer in model.churn_reducers.values())


@each
def test_several_normalised_environments(member):
    env = VecNormalize(make_vec_env(member.make_env, 2))
    model = member.make(env=env, churn_target=member.targets[-1])
    learn(model, 160, ChurnMonitor(interval=3))
    assert all(int(reducer.coefficient.n_seen) for reducer in model.churn_reducers.values())
    assert any(key.startswith("churn_monitor/") for key in model.logger.name_to_value)


@pytest.mark.parametrize("name", ["A2C", "TRPO", "SAC", "TQC", "CrossQ", "RecurrentPPO"])
def test_gsde(name):
    member = FAMILY[name]
    model = learn(member.make(env=member.make_env(None, BOX), use_sde=True, churn_target=member.targets[-1]))
    assert {f"churn/{target}_churn" for target in model.churn_reducers} <= logged(model).keys()


@pytest.mark.parametrize(
    "arguments", [dict(train_freq=4, gradient_steps=3), dict(train_freq=(1, "episode"), gradient_steps=-1)]
)
@pytest.mark.parametrize("name", ["TD3", "SAC", "QRDQN"])
def test_several_updates_in_a_training(name, arguments):
    """λ counts gradient updates; the first of them has no churn loss."""
    member = FAMILY[name]
    model = learn(member.make(**arguments))
    n_updates = model._n_updates // getattr(model, "policy_delay", 1)
    assert int(model.churn_reducer.coefficient.n_seen) == n_updates - 1 > 10


@pytest.mark.parametrize("name", ["A2C", "SAC", "QRDQN", "TRPO"])
def test_batch_norm_does_not_move_by_reference_batches(name):
    member = FAMILY[name]
    policy_kwargs = dict(net_arch=[8], features_extractor_class=NormalisedExtractor)
    models = [
        learn(member.make(algorithm, policy_kwargs=policy_kwargs, **arguments), 24)
        for algorithm, arguments in ((member.stock, {}), (None, dict(churn_coef=1e-30)))
    ]
    if member.name in ("A2C", "TRPO"):  # off-policy, the reference batches draw random numbers
        assert_equal(*models)
    statistics = [dict(model.policy.named_buffers()) for model in models]
    counts = [[value for key, value in each.items() if key.endswith("num_batches_tracked")] for each in statistics]
    assert counts[0] == counts[1] and len(counts[0]) > 0


# --- Arguments -------------------------------------------------------------------------------------------------------------


def test_one_coefficient_and_ratio_for_each_target():
    member = FAMILY["SAC"]
    model = member.make(
        churn_target="both", churn_coef={"policy": 2.0, "value": "auto"}, target_churn_ratio={"policy": 3.0, "value": 0.5}
    )
    policy, value = model.churn_reducers["policy"].coefficient, model.churn_reducers["value"].coefficient
    assert policy.value == 2.0 and value.target_ratio == 0.5
    assert model.churn_reducer is model.churn_reducers["policy"]
    learn(member.make(churn_target="both", churn_coef={"policy": "auto", "value": 0}), 40)


@pytest.mark.parametrize(
    "name, arguments, message",
    [
        ("SAC", dict(churn_target="actor"), "`churn_target` must be one of 'auto', 'policy', 'value', 'both', got 'actor'"),
        ("SAC", dict(churn_coef={"policy": 1.0, "value": 1.0}), r"`churn_coef` must be one value or a dict with the keys"),
        ("SAC", dict(target_churn_ratio={"critic": 1.0}), "`target_churn_ratio` must be one value or a dict with the keys"),
        ("PPO", dict(churn_coef={}), r"`churn_coef` must be one value or a dict .*, got \{\}"),
        ("DQN", dict(churn_target="both"), "`churn_target` of CChainDQN must be \"value\" .*no policy of its own.*'both'"),
        ("QRDQN", dict(churn_target="policy"), '`churn_target` of CChainQRDQN must be "value"'),
        ("TRPO", dict(churn_target="policy"), '`churn_target` of CChainTRPO must be "value" .its policy has no optimiser'),
        ("PPO", dict(churn_target="both", churn_component="projection"), '`churn_component` must be "full"'),
    ],
)
def test_bad_arguments(name, arguments, message):
    with pytest.raises(ValueError, match=message):
        FAMILY[name].make(env="no environment is made", **arguments)


@pytest.mark.parametrize(
    "argument", [dict(churn_component="projection"), dict(churn_reference="next"), dict(churn_batch_size=2)]
)
def test_the_callback_refuses_what_is_for_ppo_alone(argument):
    with pytest.raises(ValueError, match=f"`{next(iter(argument))}` must be .* for A2C that holds still"):
        FAMILY["A2C"].make(stable_baselines3.A2C).learn(10, CChainCallback(**argument))


# SAC's actions are continuous, the others' discrete: their churn loss, a cross-entropy, is not 0 without churn
@pytest.mark.parametrize("name", ["SAC", "PPO", "A2C", "MaskablePPO", "RecurrentPPO"])
def test_a_coefficient_that_can_do_nothing_is_warned_of_once(name):
    model = FAMILY[name].make(learning_rate=0.0, churn_warmup=0, churn_window=5)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        learn(model, 12 * FAMILY[name].settings.get("n_steps", 5))
    assert name == "SAC" or model.logger.name_to_value["churn/loss"] > 0.1
    messages = [str(warning.message) for warning in caught if "churn" in str(warning.message)]
    assert len(messages) == 1
    assert "Over 5 iterations of churn reduction, the outputs of the network hardly change" in messages[0]


def test_defaults_are_the_tables():
    expected = {
        "policy": {"PPO": 1e4, "MaskablePPO": 1e2, "RecurrentPPO": 1e2, "A2C": 10, "SAC": 5e-6, "TD3": 5e-5},
        "value": {"TRPO": 1e-3, "QRDQN": 1e-3},
    }
    for target, ratios in expected.items():
        for name, ratio in ratios.items():
            model = FAMILY[name].make()
            assert list(model.churn_reducers) == [target]
            assert model.churn_reducer.coefficient.target_ratio == ratio
    for name, stock in {"DDPG": "TD3", "CrossQ": "TD3", "TQC": "SAC"}.items():
        assert churn_kind(FAMILY[name].algorithm) is churn_kind(FAMILY[stock].stock)


def test_the_reference_batch_of_a2c_is_the_rollout_before():
    model, seen = FAMILY["A2C"].make(), []

    class Look(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_end(self):
            seen.append(self.model.rollout_buffer.observations[:, 0].copy())

    learn(model, 32, Look())
    assert len(seen) == 4
    for reference, rollout in ((model.churn_reducer.reference, seen[-2]), (model.churn_reducer.next_reference, seen[-1])):
        assert np.array_equal(np.sort(reference, axis=0), np.sort(rollout, axis=0))
    assert PreviousRollout(model.rollout_buffer, None).reference() is None


def test_without_sb3_contrib(monkeypatch):
    for name in [name for name in sys.modules if name.startswith(("sb3_contrib", "sb3_cchain.algorithms.contrib"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    with pytest.raises(ImportError, match=r'pip install "sb3-cchain\[contrib\]"'):
        sb3_cchain.CChainTQC  # noqa: B018
    with pytest.raises(AttributeError, match="no attribute 'CChainARS'"):
        sb3_cchain.CChainARS  # noqa: B018
    assert "CChainTQC" in dir(sb3_cchain)


def expected_base_loss(member, target, logged, model):
    if member.name in ("SAC", "TQC", "CrossQ", "TD3", "DDPG"):
        return logged["train/actor_loss" if target == "policy" else "train/critic_loss"]
    if member.name in ("DQN", "QRDQN"):
        return logged["train/loss"]
    if target == "value":
        return logged["train/value_loss"] * (1 if member.name == "TRPO" else model.vf_coef)
    policy = logged["train/policy_loss" if member.name == "A2C" else "train/policy_gradient_loss"]
    return policy + model.ent_coef * logged["train/entropy_loss"]


@pytest.mark.filterwarnings("ignore:Over 1 iterations")
@each_target
def test_lambda_compares_with_the_loss_that_was_logged(member, target):
    of_actor_critic = dict(ent_coef=0.3, vf_coef=0.7) if member.name in ("PPO", "A2C", "MaskablePPO", "RecurrentPPO") else {}
    model = learn(member.make(churn_target=target, churn_warmup=0, churn_window=1, **of_actor_critic), FEW_STEPS)
    for name, reducer in model.churn_reducers.items():
        expected = abs(expected_base_loss(member, name, model.logger.name_to_value, model))
        assert reducer.coefficient.base_losses.item() == pytest.approx(expected, rel=1e-5), name


DEFAULTS = {  # β of discrete and of continuous policies, of values; warm-up and window
    **dict.fromkeys(("MaskablePPO", "RecurrentPPO"), (1e2, 0.05, 0.01, 10, 50)),
    **dict.fromkeys(("SAC", "TQC"), (None, 5e-6, 1e-3, 0, 1000)),
    **dict.fromkeys(("CrossQ", "TD3"), (None, 5e-5, 1e-3, 0, 1000)),
    "PPO": (1e4, 0.05, 0.01, 10, 50),
    "A2C": (10, 5e-5, 1e-3, 0, 1000),
    "TRPO": (None, None, 1e-3, 0, 50),
    "DQN": (None, None, 0.01, 0, 1000),
    "QRDQN": (None, None, 1e-3, 0, 1000),
}


def test_all_defaults_are_the_tables():
    assert DEFAULTS.keys() == KINDS.keys()
    for name, (discrete, continuous, value, *lengths) in DEFAULTS.items():
        kind = KINDS[name]
        policy = kind.targets["policy"].target_ratios if "policy" in kind.targets else {}
        assert (policy.get(cross_entropy), policy.get(mean_squared_difference)) == (discrete, continuous), name
        assert kind.targets["value"].target_ratios == {mean_squared_difference: value}, name
        assert [kind.warmup, kind.window] == lengths, name


def test_the_least_coefficient_arrives():
    assert FAMILY["PPO"].make(churn_coef_min=3.0).churn_reducer.coefficient.minimum == 3.0


@pytest.mark.parametrize("name, n_steps, n_losses", [("PPO", 32, 8), ("SAC", 1, 1)])
def test_losses_of_an_interrupted_train_do_not_count(name, n_steps, n_losses):
    model, n_updates, seen = FAMILY[name].make(), 0, []
    reducer = model.churn_reducer
    end = reducer.end_iteration
    reducer.end_iteration = lambda *args, **kwargs: (seen.append(len(reducer.losses)), end(*args, **kwargs))

    def stop(*_):
        nonlocal n_updates
        n_updates += 1
        if n_updates == 5:
            raise KeyboardInterrupt

    (model.policy.optimizer if name == "PPO" else model.policy.actor.optimizer).register_step_post_hook(stop)
    with pytest.raises(KeyboardInterrupt):
        learn(model, 64)
    seen.clear()
    model.learn(n_steps, reset_num_timesteps=False)
    assert seen == [n_losses]


@pytest.mark.parametrize("name", ["SAC", "QRDQN"])
def test_value_churn_is_the_mean_absolute_change(name):
    model, seen = FAMILY[name].make(churn_target="value"), []
    backward = model.churn_reducer.backward

    def spy(*args, **kwargs):
        old, new = model.churn_reducer.old_outputs, backward(*args, **kwargs)
        if new is not None:
            seen.append((old - new).abs().mean().item())
        return new

    model.churn_reducer.backward = spy
    learn(model, 64)
    assert model.logger.name_to_value["churn/value_churn"] == pytest.approx(np.mean(seen), rel=1e-4)


# --- Buffers of a user's own -----------------------------------------------------------------------------------------------


def spoiling(buffer):
    """Let a buffer overwrite each minibatch when it makes the next one, as one does that fills the same memory each time."""

    class Spoiling(type(buffer)):
        given = ()

        def _get_samples(self, *args, **kwargs):
            for tensor in self.given:
                tensor.zero_()
            samples = super()._get_samples(*args, **kwargs)
            self.given = [leaf for leaf in th.utils._pytree.tree_leaves(samples) if th.is_tensor(leaf)]
            return samples

    buffer.__class__ = Spoiling


@pytest.mark.parametrize(
    "name", ["PPO", "A2C", "TRPO", "MaskablePPO", "RecurrentPPO", "DQN", "QRDQN", "SAC", "TD3", "TQC", "CrossQ"]
)
def test_a_buffer_may_fill_the_same_memory_for_each_minibatch(name):
    models = []
    for spoil in (False, True):
        model = FAMILY[name].make(churn_target=FAMILY[name].targets[-1])
        if spoil:
            spoiling(getattr(model, "rollout_buffer", None) or model.replay_buffer)
        models.append(learn(model, FEW_STEPS))
    assert_equal(*models)
    assert logged(models[0]) == logged(models[1])
