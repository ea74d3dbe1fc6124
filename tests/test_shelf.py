"""
What holds for each related method: it trains what its optimiser holds, repeats with the seed, can be without effect, and
changes outputs and moments outside of updates as ``SHELF`` says.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import pytest
import torch as th
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn

from sb3_cchain import TaskSync, networks
from sb3_cchain.methods import ContinualBackprop, OptimizerMetrics, ReDo, ReGraMa, SelfNormalizedResets
from sb3_cchain.methods.registry import REGISTRY
from sb3_cchain.methods.unit_recycling import UnitRecycling
from tests.method_models import (
    STEPS_PER_TASK,
    make_callback,
    make_env,
    make_method,
    make_model,
    make_random_env,
    optimizer_arguments,
    parameters,
)

METHODS = {method.algo: method for method in REGISTRY if method.is_related}
BY_NAME = {method.name: method for method in METHODS.values()}
ALGORITHMS = ("PPO", "DQN", "CChainPPO", "CChainDQN")


@dataclass(frozen=True)
class Row:
    """
    :param off: Arguments of the optimiser or callback with which nothing happens; None where it has none
    :param changes: Whether it changes parameters outside of the optimiser's steps
    :param keeps_outputs: Whether the outputs stay the same then; None where it depends on the units
    :param keeps_moments: Whether the optimiser's moments stay the same then; otherwise those of what changed are forgotten
    :param algorithms: Those that it is for
    """

    off: dict[str, Any] | None = None
    changes: bool = False
    keeps_outputs: bool | None = True
    keeps_moments: bool = True
    algorithms: tuple[str, ...] = ALGORITHMS


NEVER = dict(interval=10**9)
RESET = dict(changes=True, keeps_outputs=False, keeps_moments=False)
RECYCLING = dict(changes=True, keeps_outputs=None, keeps_moments=False)
# By the method's name in the registry
SHELF = {
    "oracle": Row(**RESET),
    "trac": Row(),
    "weight_clipping": Row(dict(clip_ratio=1e9)),
    "l2_init": Row(dict(coef=0)),
    "layer_norm": Row(),
    "redo": Row(NEVER, **RECYCLING),
    "adam_rel": Row(),
    "parseval": Row(dict(coef=0)),
    "shrink_and_perturb": Row(dict(shrink=0.5, **NEVER), changes=True, keeps_outputs=False),
    "crelu": Row(),
    "layer_reset": Row(NEVER, **RESET),
    "plasticity_injection": Row(dict(timestep=10**9), changes=True, keeps_moments=False),
    "normalize_and_project": Row(NEVER),
    "fourier": Row(),
    "continual_backprop": Row(dict(replacement_rate=0), **RECYCLING),
    "regrama": Row(NEVER, **RECYCLING),
    "self_normalized_resets": Row(NEVER, **RECYCLING),
    "fire": Row(NEVER, **RESET),
    "spectral_regularization": Row(dict(coef=0)),
    "ewc": Row(dict(coef=0)),
    "upgd": Row(),
    "muon": Row(),
    "kron": Row(),
    "spectral_norm": Row(),
    "simba": Row(),
}
# Arguments with which exactly the silent units are recycled, at the end of the first rollout or update
SILENT = {
    ReDo: dict(tau=0.0, interval=1),
    ReGraMa: dict(tau=0.0, interval=1),
    SelfNormalizedResets: dict(max_threshold=1, interval=1),
    ContinualBackprop: dict(replacement_rate=0.5, maturity_threshold=3),  # half of the units at the 4th update
}


def test_tables_have_all_methods():
    missing, unknown = BY_NAME.keys() - SHELF.keys(), SHELF.keys() - BY_NAME.keys()
    assert not missing, f"SHELF in tests/test_shelf.py lacks a Row for {sorted(missing)}"
    assert not unknown, f"SHELF in tests/test_shelf.py has rows that the registry lacks: {sorted(unknown)}"
    for name, row in SHELF.items():
        acts = set(BY_NAME[name].callbacks) - {OptimizerMetrics}
        assert acts or not row.changes, f"SHELF says that {name} changes parameters outside of updates, but it has no callback"
    recycling = {cls for method in METHODS.values() for cls in method.callbacks if issubclass(cls, UnitRecycling)}
    assert SILENT.keys() == recycling, f"SILENT in tests/test_shelf.py must have {sorted(map(str, recycling))}"


CASES = [
    pytest.param(BY_NAME[name], algorithm, id=f"{name}-{algorithm}")
    for name, row in SHELF.items()
    if name in BY_NAME
    for algorithm in row.algorithms
]
# Without callbacks of its own, a method can act in updates alone
CASES_WITH_CALLBACKS = [case for case in CASES if set(case.values[0].callbacks) - {OptimizerMetrics}]
CASES_OFF = [case for case in CASES if SHELF[case.values[0].name].off is not None]


def policy_of(method, algorithm):
    """The row's policy, or the one for DQN that is called alike."""
    if isinstance(method.policy, str) or "DQN" not in algorithm:
        return method.policy
    return getattr(networks, method.policy.__name__.replace("Policy", "DQNPolicy"))


def make(method, algorithm, off=False, env=None, **settings):
    """A model and callbacks: the method with another algorithm, and without effect on request."""
    policy_kwargs = {**method.policy_kwargs, "net_arch": [8, 8]}
    arguments = SHELF[method.name].off if off else {}
    if method.optimizer_class is not None:
        kwargs = {**optimizer_arguments(method), **arguments}
        if "n_output_layers" in kwargs and "DQN" in algorithm:
            kwargs["n_output_layers"] = 1
        if off:
            kwargs["base_kwargs"] = {} if "DQN" in algorithm else dict(eps=1e-5)  # SB3's
        policy_kwargs |= dict(optimizer_class=method.optimizer_class, optimizer_kwargs=kwargs)
        callbacks = []
    elif off:
        callbacks = [method.callbacks[0](**arguments)]
    else:
        callbacks = [make_callback(cls) for cls in method.callbacks]
    model = make_model(algorithm, env=env, policy=policy_of(method, algorithm), policy_kwargs=policy_kwargs, **settings)
    return model, callbacks


def trained(model):
    """The parameters that an update may change. The target network follows by itself."""
    return {id(p) for name, p in model.policy.named_parameters() if p.requires_grad and "target" not in name}


def held(model):
    return {id(p) for group in model.policy.optimizer.param_groups for p in group["params"]}


def outputs(model):
    observations = th.linspace(-1, 1, 12).reshape(3, 4)[:, : model.observation_space.shape[0]]
    training = model.policy.training
    model.policy.set_training_mode(False)
    with th.no_grad():
        if isinstance(model, DQN):
            found = model.q_net(observations)
        else:
            distribution = model.policy.get_distribution(observations).distribution
            found = th.cat([distribution.logits, model.policy.predict_values(observations)], dim=1)
    model.policy.set_training_mode(training)
    return found


def moments(model):
    """Of each parameter the moments, by name."""
    state = model.policy.optimizer.state
    return {
        name: {k: v.clone() for k, v in state.get(p, {}).items() if th.is_tensor(v) and v.shape == p.shape}
        for name, p in model.policy.named_parameters()
    }


@pytest.mark.parametrize("algo", METHODS)
def test_trains_what_its_optimiser_holds_and_repeats_with_the_seed(algo):
    ends = []
    for _ in range(2):
        model, callbacks = make_method(METHODS[algo])
        before = held(model)
        assert trained(model) <= before
        model.learn(2 * STEPS_PER_TASK + 16, callback=callbacks)
        assert held(model) == before and trained(model) <= before
        ends.append(parameters(model))
    assert all(th.equal(ends[0][name], ends[1][name]) for name in ends[0])


@cache
def plain_outputs(algorithm, policy):
    """After as much training without a method."""
    return outputs(make_model(algorithm, env=make_random_env(), policy=policy, policy_kwargs=dict(net_arch=[8, 8])).learn(48))


@pytest.mark.parametrize("method, algorithm", CASES_OFF)
def test_without_effect_it_is_plain_training(method, algorithm):
    plain = "MlpPolicy" if method.policy is networks.InjectionPolicy else policy_of(method, algorithm)
    expected = plain_outputs(algorithm, plain)
    model, callbacks = make(method, algorithm, off=True, env=make_random_env())
    model.learn(48, callback=callbacks)
    assert th.allclose(outputs(model), expected, rtol=0, atol=1e-6)


class Watch(BaseCallback):
    """
    Stands before or behind a method in the list of callbacks, and takes a snapshot when it may act: when a rollout starts, and
    after an update.
    """

    def __init__(self, snapshots):
        super().__init__()
        self.snapshots = snapshots

    def _on_training_start(self):
        self.handle = self.model.policy.optimizer.register_step_post_hook(lambda *_: self._take())

    def _on_training_end(self):
        self.handle.remove()

    def _on_rollout_start(self):
        self._take()

    def _on_step(self):
        return True

    def _take(self):
        self.snapshots.append((parameters(self.model), moments(self.model), outputs(self.model)))


def touched(name, changed):
    """The entries of a parameter whose moments may be forgotten: whole rows and columns that changed, and their biases."""
    if changed[name].dim() == 1:
        return changed[name] | changed[name.replace(".bias", ".weight")].flatten(start_dim=1).all(dim=1)
    return changed[name] | changed[name].all(dim=1, keepdim=True) | changed[name].all(dim=0, keepdim=True)


@pytest.mark.parametrize("method, algorithm", CASES_WITH_CALLBACKS)
def test_what_changes_outside_of_updates(method, algorithm):
    row, before, after = SHELF[method.name], [], []
    settings = dict(train_freq=4) if "DQN" in algorithm else {}
    model, callbacks = make(method, algorithm, env=make_env(), **settings)
    model.learn(STEPS_PER_TASK + 16, callback=[TaskSync(), Watch(before), *callbacks, Watch(after)])
    has_changed = has_kept = False
    for (old, old_moments, old_outputs), (new, new_moments, new_outputs) in zip(before, after, strict=True):
        changed = {name: old[name] != new[name] for name in new}
        acted = any(entries.any() for entries in changed.values())
        has_changed |= acted
        if row.keeps_outputs:
            assert th.allclose(old_outputs, new_outputs, atol=1e-6)
        elif acted and row.keeps_outputs is False:
            assert not th.equal(old_outputs, new_outputs)
        for name, entries in changed.items():
            for key, moment in old_moments[name].items():
                now = new_moments[name].get(key, th.zeros_like(moment))
                if row.keeps_moments:
                    assert th.equal(now, moment), name
                else:
                    assert not now[entries].any(), name
                    assert th.equal(now[~touched(name, changed)], moment[~touched(name, changed)]), name
                    has_kept |= acted and bool(now.any())
    assert has_changed == row.changes
    # Only fresh networks forget all
    assert has_kept == (row.changes and not row.keeps_moments and method.name != "oracle")


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("cls", SILENT, ids=lambda cls: cls.__name__)
def test_recycling_of_silent_units_keeps_the_outputs(cls, algorithm):
    """Units of two layers whose ReLU is never active, and in DQN those of the one network."""
    policy_kwargs = dict(net_arch=[4, 4], activation_fn=nn.ReLU)
    settings = dict(learning_starts=12) if "DQN" in algorithm else dict(n_epochs=2)
    model = make_model(algorithm, env=make_random_env(), policy_kwargs=policy_kwargs, learning_rate=0.0, **settings)
    first = "q_net.q_net.0" if "DQN" in algorithm else "mlp_extractor.policy_net.0"
    second = first[:-1] + "2"
    units = {first: [0, 2], second: [1, 3]}
    with th.no_grad():
        for name, module in model.policy.named_modules():
            if isinstance(module, nn.Linear):  # all are active, whatever is observed
                module.weight.abs_().mul_(0.1)
                module.bias.fill_(1.0)
            if name in units:
                module.bias[units[name]] = -10.0
    recycled = dict(SILENT[cls])
    if "DQN" in algorithm and "interval" in recycled:
        recycled["interval"] = 4
    old, before = parameters(model), outputs(model)
    callback = cls(**recycled)
    model.learn(16, callback=callback)
    new = parameters(model)
    for name, numbers in units.items():
        changed = (old[f"{name}.weight"] != new[f"{name}.weight"]).any(dim=1)
        assert changed[numbers].all(), name
        if name == first:  # what leads out of the first layer changes the second
            assert changed.nonzero().flatten().tolist() == numbers
    assert th.allclose(outputs(model)[:, :3], before[:, :3], atol=1e-6)
