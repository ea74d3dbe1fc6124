"""All methods in pairs; those that are callbacks and networks at once, with each algorithm; and all methods with C-CHAIN."""

import re
from functools import partial

import pytest
import torch as th
from stable_baselines3 import DQN, PPO

from sb3_cchain import ContinualEnv, TaskSync
from sb3_cchain.methods import AdamRel, EWCConsolidation, OptimizerMetrics, Oracle, PlasticityInjection, ReDo, ShrinkAndPerturb
from sb3_cchain.methods.registry import REGISTRY
from sb3_cchain.networks import LayerNormDQNPolicy, LayerNormPolicy
from tests.envs import CountEnv
from tests.method_models import (
    ALGORITHMS,
    CALLBACKS,
    OPTIMIZERS,
    STEPS_PER_TASK,
    go_on,
    make_callback,
    make_env,
    make_method,
    make_model,
    make_random_env,
    nested_optimizers,
    optimizer_arguments,
    parameters,
)

PPO_METHODS = [method for method in REGISTRY if method.is_related and issubclass(method.algorithm, PPO)]

# Two methods that do not go together, and how training says so
REFUSED = {
    ("adam_rel", "kron"): "AdamRel needs an optimiser with a step count, as Adam has, got Kron",
    ("layer_reset", "plasticity_injection"): "LayerReset does not know heads for plasticity injection, got InjectionPolicy",
    ("plasticity_injection", "redo"): "ReDo does not know heads for plasticity injection, got InjectionPolicy",
    ("plasticity_injection", "regrama"): "ReGraMa does not know heads for plasticity injection, got InjectionPolicy",
    ("plasticity_injection", "self_normalized_resets"): "SelfNormalizedResets does not know heads for plasticity injection",
    ("continual_backprop", "plasticity_injection"): "ContinualBackprop does not know heads for plasticity injection",
    ("crelu", "plasticity_injection"): "`activation_fn` must keep the number of features for InjectionPolicy, got CReLU",
    (
        "fourier",
        "plasticity_injection",
    ): "`activation_fn` must keep the number of features for InjectionPolicy, got FourierFeat",
}


def compose(one, other, algorithm="PPO"):
    """A model and callbacks with two methods: the optimiser of the first around that of the second."""
    methods = (one, other)
    policy_kwargs = {**one.policy_kwargs, **other.policy_kwargs, "net_arch": [8]}
    # An activation goes into any policy, and a policy that the optimiser's row recommends gives way
    policies = sorted(
        (method for method in methods if method.policy != "MlpPolicy"),
        key=lambda method: (bool(method.callbacks) and method.optimizer_class is None, not method.policy_kwargs),
    )
    for method in reversed([method for method in methods if method.optimizer_class is not None]):
        kwargs = optimizer_arguments(method)
        if "n_output_layers" in kwargs and any(method.name == "plasticity_injection" for method in methods):
            kwargs["n_output_layers"] = 6  # an old, a new and a copied one for each head
        if "optimizer_class" in policy_kwargs:
            inside = (policy_kwargs["optimizer_class"], policy_kwargs["optimizer_kwargs"])
            kwargs.update(base_class=inside[0], base_kwargs=inside[1])
        policy_kwargs.update(optimizer_class=method.optimizer_class, optimizer_kwargs=kwargs)
    model = make_model(
        *(algorithm, ContinualEnv([partial(CountEnv, name=task) for task in range(3)], steps_per_task=16)),
        *(policies[-1].policy if policies else "MlpPolicy",),
        **dict(policy_kwargs=policy_kwargs, n_steps=8, n_epochs=1),
    )
    return model, [make_callback(cls) for cls in dict.fromkeys([*one.callbacks, *other.callbacks])]


def goes_into(one, other):
    """Whether a model can have the networks of both."""
    structures = {m.policy for m in (one, other) if m.policy != "MlpPolicy" and m.optimizer_class is None}
    activations = [method for method in (one, other) if "activation_fn" in method.policy_kwargs]
    return len(structures) < 2 or len(activations) == 1


@pytest.mark.parametrize("number", range(len(PPO_METHODS)), ids=lambda number: PPO_METHODS[number].name)
def test_each_pair_trains_or_is_refused(number):
    """The method with each of those behind it, and with the next one in C-CHAIN."""
    one, behind = PPO_METHODS[number], PPO_METHODS[number + 1 :]
    pairs = [(other, "PPO") for other in behind if goes_into(one, other)]
    pairs += [(other, "CChainPPO") for other, _ in pairs[:1]]
    for other, algorithm in pairs:
        names = tuple(sorted((one.name, other.name)))
        if names in REFUSED:
            with pytest.raises((TypeError, ValueError), match=re.escape(REFUSED[names])):
                model, callbacks = compose(one, other, algorithm)
                model.learn(8, callback=[TaskSync(), *callbacks])
            continue
        try:
            model, callbacks = compose(one, other, algorithm)
            before = parameters(model)
            model.learn(32, callback=[TaskSync(), *callbacks], log_interval=1000)
        except Exception as error:
            pytest.fail(f"{names} neither go together in {algorithm} nor are they in REFUSED: {error!r}")
        held = {id(p) for group in model.policy.optimizer.param_groups for p in group["params"]}
        assert {id(p) for p in model.policy.parameters() if p.requires_grad} <= held, names
        after = parameters(model)
        assert all(tensor.isfinite().all() for tensor in after.values()), names
        changed = any(not th.equal(tensor, before[name]) for name, tensor in after.items())
        assert changed or "trac" in names, names  # whose scale may have fallen to 0


def test_refused_pairs_are_of_the_registry():
    names = {method.name for method in PPO_METHODS}
    assert all(set(pair) <= names and tuple(sorted(pair)) == pair for pair in REFUSED)


# Oracle's networks are all fresh; that of PlasticityInjection freezes by itself
@pytest.mark.parametrize(
    "method", [m for m in PPO_METHODS if m.name not in ("oracle", "plasticity_injection")], ids=lambda method: method.name
)
def test_frozen_layers_are_left_alone(method):
    model, callbacks = make_method(method)
    model.learn(STEPS_PER_TASK, callbacks)
    frozen = model.policy.mlp_extractor.policy_net.requires_grad_(False)
    before = {name: value.clone() for name, value in frozen.named_parameters()}
    model.learn(3 * STEPS_PER_TASK, callbacks, reset_num_timesteps=False)
    assert before and all(th.equal(value, before[name]) for name, value in frozen.named_parameters())


# AdamRel changes the optimiser, and is tested with the others below. PlasticityInjection needs a policy of its own,
# EWCConsolidation an optimiser
def callbacks():
    return [
        TaskSync(),
        *(make_callback(cls) for cls in CALLBACKS if cls not in (AdamRel, PlasticityInjection, EWCConsolidation)),
    ]


def find(cls, callbacks):
    (callback,) = (callback for callback in callbacks if isinstance(callback, cls))
    return callback


@pytest.mark.parametrize("name", ALGORITHMS)
def test_train_save_load_and_go_on(tmp_path, name):
    policy = LayerNormDQNPolicy if "DQN" in name else LayerNormPolicy
    model = make_model(name, policy=policy, policy_kwargs=dict(net_arch=[16, 16], activation_fn=th.nn.ReLU))
    first = callbacks()
    model.learn(STEPS_PER_TASK + 16, callback=first).save(tmp_path / "model")
    assert find(Oracle, first).n_resets == 1
    assert find(ReDo, first).n_recycled > 0
    assert find(ShrinkAndPerturb, first).n_steps > 0

    loaded = type(model).load(tmp_path / "model", env=make_env(), device="cpu")
    assert all(th.equal(p, q) for p, q in zip(model.policy.parameters(), loaded.policy.parameters(), strict=True))
    state, loaded_state = (m.policy.optimizer.state_dict()["state"] for m in (model, loaded))
    assert len(state) > 0
    for index, moments in state.items():
        assert all(th.equal(value, loaded_state[index][key]) for key, value in moments.items())
    before, second = parameters(loaded), callbacks()
    if isinstance(loaded, DQN):
        loaded.learning_starts = loaded.num_timesteps + 4
    loaded.learn(STEPS_PER_TASK, callback=second, reset_num_timesteps=False)
    assert find(Oracle, second).n_resets == 1
    assert all(not th.equal(tensor, before[name]) for name, tensor in parameters(loaded).items() if "target" not in name)
    loaded.set_parameters(model.get_parameters())
    assert all(th.equal(p, q) for p, q in zip(model.policy.parameters(), loaded.policy.parameters(), strict=True))


@pytest.mark.parametrize("name", ALGORITHMS)
def test_repeats_with_the_seed(name):
    one, other = (make_model(name).learn(2 * STEPS_PER_TASK, callback=callbacks()) for _ in range(2))
    assert all(th.equal(p, q) for p, q in zip(one.policy.parameters(), other.policy.parameters(), strict=True))


@pytest.mark.parametrize("everything", [False, True])
@pytest.mark.parametrize("name", ["CChainPPO", "CChainDQN"])
def test_with_c_chain_goes_on_as_if_never_stopped(tmp_path, name, everything):
    """ReDo alone, and all that can be together."""

    def callbacks():
        redo = ReDo(tau=0.5, interval=4 if "DQN" in name else 1)  # updates, rollouts
        # The environment is not continual, so Oracle has nothing to do
        others = [make_callback(cls) for cls in CALLBACKS if cls not in (ReDo, Oracle, PlasticityInjection, EWCConsolidation)]
        return [redo, *others, OptimizerMetrics()] if everything else [redo]

    layer_norm = LayerNormDQNPolicy if "DQN" in name else LayerNormPolicy
    model = make_model(
        name,
        env=make_random_env(),
        policy=layer_norm if everything else "MlpPolicy",
        policy_kwargs=dict(net_arch=[16, 16], activation_fn=th.nn.ReLU, **(nested_optimizers() if everything else {})),
    )
    model.learn(48, callback=(first := callbacks()), log_interval=1000)
    assert first[0].n_recycled > 0
    keys = {"redo/n_recycled", "churn/loss"}
    if everything:
        assert OPTIMIZERS.keys() <= {key.split("/")[0] for key in model.logger.name_to_value}
        keys |= {"trac/scale", "l2_init/distance", "weight_clipping/share", "adam_rel/n_resets", "shrink_and_perturb/n_steps"}
    assert keys <= set(model.logger.name_to_value)

    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", env=make_random_env(), device="cpu")
    if isinstance(model, DQN):
        model.save_replay_buffer(tmp_path / "buffer")
        loaded.load_replay_buffer(tmp_path / "buffer")
    before = parameters(model)
    for each in (model, loaded):
        go_on(each, callbacks())
    after, after_loading = parameters(model), parameters(loaded)
    assert all(th.equal(tensor, after_loading[parameter]) for parameter, tensor in after.items())
    assert any(not th.equal(tensor, before[parameter]) for parameter, tensor in after.items())
    # TRAC's scale may have fallen to 0, the moments are of the gradients all the same
    moments, moments_after_loading = (m.policy.optimizer.state_dict()["state"] for m in (model, loaded))
    for parameter in range(len(model.policy.optimizer.param_groups[0]["params"])):
        assert moments[parameter]["momentum_buffer" if "momentum_buffer" in moments[parameter] else "exp_avg"].any()
        assert all(th.equal(value, moments_after_loading[parameter][key]) for key, value in moments[parameter].items())


def test_by_name_from_yaml():
    """As the stock RL Zoo reads `policy:`, `policy_kwargs:` and `callback:`."""
    utils = pytest.importorskip("rl_zoo3.utils")
    entries = [
        "sb3_cchain.TaskSync",
        {"sb3_cchain.methods.Oracle": {"reset_replay_buffer": True}},
        {"sb3_cchain.methods.ReDo": {"tau": 0.1, "interval": 5}},
        {"sb3_cchain.methods.ShrinkAndPerturb": {"shrink": 0.5, "interval": None}},
    ]
    made = utils.get_callback_list({"callback": entries})
    policy = utils.get_class_by_name("sb3_cchain.networks.LayerNormDQNPolicy")
    activation_fn = utils.get_class_by_name("sb3_cchain.networks.CReLU")
    model = make_model("DQN", policy=policy, policy_kwargs=dict(net_arch=[8], activation_fn=activation_fn))
    model.learn(2 * STEPS_PER_TASK, callback=made)
    assert made[1].n_resets == made[3].n_steps == 1
    assert made[2].tau == 0.1
