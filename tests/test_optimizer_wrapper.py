"""Optimisers around optimisers can be used as one optimiser."""

import copy
import pickle

import pytest
import torch as th
from torch import nn

from sb3_cchain.methods import TRAC, L2Init, OptimizerWrapper, Parseval, WeightClipping
from tests.method_models import OPTIMIZERS, optimizer_arguments

ADAM = dict(base_kwargs=dict(eps=1e-5))
CLIPPED = dict(base_class=WeightClipping, base_kwargs=dict(clip_ratio=0.8, **ADAM))
# Where the arguments of the registry's test models do not fit this network
ARGUMENTS = {
    "trac": dict(s_init=1e-2),
    "weight_clipping": dict(clip_ratio=0.8),
    "l2_init": dict(coef=0.3),
    "parseval": dict(n_output_layers=1, coef=0.1),
    "normalize_and_project": dict(n_output_layers=1),
    "muon": dict(n_output_layers=1),
}
WRAPPERS = {
    **{
        name: (row.optimizer_class, {**optimizer_arguments(row), **ARGUMENTS.get(name, {}), **ADAM})
        for name, row in OPTIMIZERS.items()
    },
    "l2": (L2Init, dict(coef=0.3, towards="zero", **ADAM)),
    "nested": (
        L2Init,
        dict(
            coef=0.3,
            base_class=Parseval,
            base_kwargs=dict(n_output_layers=1, base_class=TRAC, base_kwargs=dict(s_init=1e-2, **CLIPPED)),
        ),
    ),
    "around AMSGrad": (TRAC, dict(s_init=1e-2, base_kwargs=dict(amsgrad=True))),
    "around SGD": (L2Init, dict(base_class=th.optim.SGD, base_kwargs=dict(momentum=0.9))),
    "around Adagrad": (L2Init, dict(base_class=th.optim.Adagrad)),
    "around RMSprop": (WeightClipping, dict(base_class=th.optim.RMSprop)),
}
DATA = th.randn(200, 16, 5, generator=th.Generator().manual_seed(1))


def make_network():
    th.manual_seed(0)
    return nn.Sequential(nn.Linear(5, 6), nn.Tanh(), nn.Linear(6, 2))


def make(name, network):
    cls, kwargs = WRAPPERS[name]
    return cls(network.parameters(), lr=1e-2, **kwargs)


def train(network, optimizer, steps):
    th.manual_seed(0)  # for methods that draw random numbers
    for step in steps:
        loss = (network(DATA[step]) - DATA[step, :, :2] ** 2).square().mean()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 0.5)
        optimizer.step()


def assert_same(network, other):
    for p, q in zip(network.parameters(), other.parameters(), strict=True):
        assert th.equal(p, q)


@pytest.mark.parametrize("name", WRAPPERS)
@pytest.mark.parametrize("n_before", [0, 1, 7])
def test_state_round_trips(tmp_path, name, n_before):
    network = make_network()
    optimizer = make(name, network)
    train(network, optimizer, range(n_before))
    th.save([network.state_dict(), optimizer.state_dict()], tmp_path / "state")

    loaded_network = nn.Sequential(nn.Linear(5, 6), nn.Tanh(), nn.Linear(6, 2))
    loaded = make(name, loaded_network)
    train(loaded_network, loaded, range(100, 103))  # which loading undoes
    saved_network, saved = th.load(tmp_path / "state", weights_only=True)
    loaded_network.load_state_dict(saved_network)
    loaded.load_state_dict(saved)
    assert loaded.metrics() == optimizer.metrics()

    train(network, optimizer, range(10, 20))
    train(loaded_network, loaded, range(10, 20))
    assert_same(network, loaded_network)


@pytest.mark.parametrize("name", WRAPPERS)
@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda pair: pickle.loads(pickle.dumps(pair))])
def test_copies(name, duplicate):
    network = make_network()
    optimizer = make(name, network)
    train(network, optimizer, range(7))
    copied_network, copied = duplicate((network, optimizer))
    assert copied.parameters()[0] is next(copied_network.parameters())
    train(network, optimizer, range(10, 20))
    train(copied_network, copied, range(10, 20))
    assert_same(network, copied_network)


@pytest.mark.parametrize("name", ["trac", "l2_init", "nested"])
def test_a_loaded_state_is_not_shared(name):
    networks = [make_network(), make_network()]
    optimizer, other = (make(name, network) for network in networks)
    train(networks[0], optimizer, range(5))
    other.load_state_dict(optimizer.state_dict())

    def remembered():
        own = {key: value for key, value in optimizer.state.items() if isinstance(key, str)}
        return [number for values in own.values() for key, number in values.items() if key != "reference"], [
            p for values in own.values() for p in values.get("reference", [])
        ]

    numbers, reference = copy.deepcopy(remembered())
    train(networks[1], other, range(5))
    assert remembered()[0] == numbers
    assert all(map(th.equal, remembered()[1], reference))


@pytest.mark.parametrize("name", ["trac", "l2_init"])
def test_takes_the_state_of_its_base(name):
    network = make_network()
    adam = th.optim.Adam(network.parameters(), lr=1e-2, eps=1e-5)
    train(network, adam, range(5))
    optimizer = make(name, network)
    optimizer.load_state_dict(adam.state_dict())
    assert optimizer.state[optimizer.parameters()[0]]["step"] == 5
    start = [p.clone() for p in network.parameters()]
    train(network, optimizer, range(5, 6))
    assert all(map(th.equal, optimizer.reference(), start))


@pytest.mark.parametrize("neutral", [(L2Init, dict(coef=0.0)), (WeightClipping, dict(clip_ratio=1e9))])
def test_is_its_base_in_all_else(neutral):
    cls, kwargs = neutral
    networks = [make_network(), make_network()]
    adam = th.optim.Adam(networks[0].parameters(), lr=1e-2, eps=1e-5)
    optimizer = cls(networks[1].parameters(), lr=1e-2, base_kwargs=dict(eps=1e-5), **kwargs)
    for network, each in zip(networks, (adam, optimizer), strict=True):
        schedule = th.optim.lr_scheduler.ExponentialLR(each, gamma=0.5)
        for step in range(5):
            train(network, each, [step])
            schedule.step()
        assert each.param_groups[0]["lr"] == 1e-2 / 32
        for group in each.param_groups:  # as SB3's schedules
            group["lr"] = 3e-3
        train(network, each, range(10, 15))
    assert_same(*networks)
    assert optimizer.state_dict()["param_groups"] == adam.state_dict()["param_groups"]


def test_changes_something():
    networks = {name: make_network() for name in WRAPPERS if name != "ewc"}  # which begins at the first task switch
    for name, network in networks.items():
        train(network, make(name, network), range(10))
    plain = make_network()
    train(plain, th.optim.Adam(plain.parameters(), lr=1e-2, eps=1e-5), range(10))
    sums = [sum(p.sum().item() for p in network.parameters()) for network in (plain, *networks.values())]
    assert len(set(sums)) == len(sums)


def test_each_part_runs_once():
    network = make_network()
    optimizer = make("nested", network)
    calls = []
    nest = [optimizer]
    while isinstance(nest[-1], OptimizerWrapper):
        nest.append(nest[-1].base)
    assert len(nest) == 5
    for part in nest:
        part.register_step_pre_hook(lambda part, *_: calls.append(("before", type(part))))
        part.register_step_post_hook(lambda part, *_: calls.append(("after", type(part))))
    train(network, optimizer, range(1))
    classes = [type(part) for part in nest]
    assert calls == [("before", cls) for cls in classes] + [("after", cls) for cls in reversed(classes)]
    assert optimizer.state[optimizer.parameters()[0]]["step"] == 1
    # Another instance of the class has no hooks, and torch has not wrapped its step again
    train(network, make("nested", network), range(1))
    assert len(calls) == 10


@pytest.mark.parametrize("name", ["trac", "nested"])
def test_closure(name):
    networks = [make_network(), make_network()]
    optimizers = [make(name, network) for network in networks]
    n_calls = 0

    def closure():
        nonlocal n_calls
        n_calls += 1
        optimizers[1].zero_grad()
        loss = networks[1](DATA[0]).square().mean()
        loss.backward()
        return loss

    for _ in range(5):
        optimizers[0].zero_grad()
        loss = networks[0](DATA[0]).square().mean()
        loss.backward()
        assert optimizers[0].step() is None
        assert optimizers[1].step(closure) == loss
    assert n_calls == 5
    assert_same(*networks)


WITH_OUTPUT_LAYERS = ("parseval", "normalize_and_project", "muon", "nested")  # they would be other ones


@pytest.mark.parametrize("name", [name for name in WRAPPERS if name not in WITH_OUTPUT_LAYERS])
def test_parameters_can_be_added(name):
    networks = [make_network(), make_network()]
    together = make(name, networks[0])
    first = [networks[1][0].weight, networks[1][0].bias]
    cls, kwargs = WRAPPERS[name]
    apart = cls(first, lr=1e-2, **kwargs)
    apart.add_param_group(dict(params=list(networks[1][2].parameters())))
    assert len(apart.param_groups) == 2
    train(networks[0], together, range(5))
    train(networks[1], apart, range(5))
    assert_same(*networks)
    # After the first update, too: initial values are those of when a parameter came
    extra = nn.Parameter(th.ones(3))
    apart.add_param_group(dict(params=[extra]))
    extra.grad = th.ones(3)
    apart.step()
    assert extra.shape == (3,) and not th.equal(extra, th.ones(3))


def test_gradients_stay_enabled_when_the_base_fails():
    class Failing(th.optim.SGD):
        def step(self, closure=None):
            raise RuntimeError("no")

    network = make_network()
    optimizer = TRAC(network.parameters(), base_class=Failing)
    with pytest.raises(RuntimeError, match="no"):
        train(network, optimizer, range(1))
    assert th.is_grad_enabled()


def test_zero_grad_accepts_either_mode():
    networks = [make_network(), make_network()]
    for set_to_none, network in zip([True, False], networks, strict=True):
        optimizer = make("l2", network)
        for _ in range(3):
            optimizer.zero_grad(set_to_none=set_to_none)
            optimizer.step()
    assert_same(*networks)


def test_refuses():
    parameters = list(make_network().parameters())
    with pytest.raises(TypeError, match="`base_class` must be a class of optimisers, got 'Adam'"):
        TRAC(parameters, base_class="Adam")
    with pytest.raises(TypeError, match=r"`base_class` must not need a closure, .* got LBFGS"):
        TRAC(parameters, base_class=th.optim.LBFGS)
    with pytest.raises(TypeError, match=r"`base_kwargs` must be a dictionary, got \[1e-05\]"):
        TRAC(parameters, base_kwargs=[1e-5])
    with pytest.raises(ValueError, match="`base_class` must not contain another TRAC, got WeightClipping"):
        TRAC(parameters, base_class=WeightClipping, base_kwargs=dict(base_class=TRAC))
    for cls, argument in [
        (L2Init, dict(coef=-1)),
        (L2Init, dict(towards="mean")),
        (L2Init, dict(reduction="max")),
        (WeightClipping, dict(clip_ratio=0)),
        (Parseval, dict(n_output_layers=2.5)),
        (Parseval, dict(n_output_layers=2)),
        (Parseval, dict(n_output_layers=1, scale=0)),
        (TRAC, dict(betas=[2])),
        (TRAC, dict(s_init=0)),
        (TRAC, dict(eps=-1)),
    ]:
        name, value = list(argument.items())[-1]
        with pytest.raises(ValueError, match=f"`{name}` must .*got {value if name != 'betas' else 2!r}"):
            cls(parameters, **argument)
    with pytest.raises(TypeError, match="`betas` must be a list"):
        TRAC(parameters, betas=0.9)


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_arguments_of_the_optimiser_inside_are_named(name):
    cls, kwargs = WRAPPERS[name]
    with pytest.raises(TypeError, match=rf"{cls.__name__} has no argument amsgrad, foreach\. .* `base_kwargs=dict\(\.\.\.\)`"):
        cls(make_network().parameters(), **kwargs, amsgrad=True, foreach=True)
