"""Each row of the registry has what a method needs: a YAML file, a page, and a place in the tests."""

import inspect
import math
import re
from pathlib import Path

import pytest
import torch as th
import yaml
from matplotlib.colors import to_rgb
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks.grid.run import suite_methods
from benchmarks.grid.suites import SUITES
from sb3_cchain import methods
from sb3_cchain.algorithms import CChainDQN, CChainPPO
from sb3_cchain.analysis import NetworkHealth
from sb3_cchain.methods import (
    EntropyBonusRestart,
    ExplorationRateRestart,
    LogStdRestart,
    OptimizerMetrics,
    OptimizerWrapper,
    Penalty,
)
from sb3_cchain.methods.registry import BY_ALGO, FAMILY_PAGE, METHOD_NAMES, REGISTRY
from tests.method_models import go_on, make_env, make_method

ROOT = Path(__file__).parent.parent
ROWS = pytest.mark.parametrize("method", REGISTRY, ids=lambda method: method.algo)
# tests/test_family.py trains the others
ROWS_IN_DISCRETE = pytest.mark.parametrize(
    "method", [method for method in REGISTRY if method.page != FAMILY_PAGE], ids=lambda method: method.algo
)
# Classes of `sb3_cchain.methods` that are parts of methods, or go with any of them
PARTS = {OptimizerMetrics, OptimizerWrapper, Penalty, ExplorationRateRestart, LogStdRestart, EntropyBonusRestart}


def yaml_text(method):
    return (ROOT / "zoo_hyperparams" / f"{method.algo}.yml").read_text()


def settings(method):
    """The settings by environment."""
    return {name: values for name, values in yaml.safe_load(yaml_text(method)).items() if name.startswith("Continual/")}


def callback_names(values):
    return [name for entry in values["callback"] for name in ([entry] if isinstance(entry, str) else entry)]


def path_of(cls):
    """The name under which a YAML file refers to a class: that of its package."""
    room = ".".join(cls.__module__.split(".")[:2])
    return f"{room}.{cls.__name__}"


@ROWS
def test_yaml_has_settings_for_its_suites(method):
    covered = settings(method)
    if not method.in_paper and "default" in yaml.safe_load(yaml_text(method)):
        return  # for any environment
    for suite in method.suites or ("gym_control",):
        missing = set(SUITES[suite].env_ids) - covered.keys()
        assert not missing, f"{method.algo}.yml has no settings for {missing}"
    for values in covered.values():
        assert {"policy", "n_timesteps"} <= values.keys()


@ROWS
def test_yaml_names_what_the_row_names(method):
    for env_id, values in settings(method).items():
        for callback in method.callbacks:
            assert path_of(callback) in callback_names(values), f"{env_id} of {method.algo}.yml lacks {callback.__name__}"
        policy_kwargs = values.get("policy_kwargs", "")
        if method.optimizer_class is not None:
            assert f"optimizer_class=get_class_by_name('{path_of(method.optimizer_class)}')" in policy_kwargs
            for argument, value in method.optimizer_kwargs.items():
                assert f"{argument}={value!r}" in policy_kwargs
        else:
            assert "optimizer_class" not in policy_kwargs
        if method.policy != "MlpPolicy" and values["policy"] in ("MlpPolicy", path_of(method.policy)):
            assert values["policy"] == path_of(method.policy)
        elif method.policy != "MlpPolicy":  # networks for images have it as an argument
            assert f"{method.name}=True" in policy_kwargs


def test_each_yaml_of_related_settings_has_a_row():
    others = {"dqn", "ppo_cchain_callback"}  # an algorithm and a callback without a name of their own on the command line
    assert {path.stem for path in (ROOT / "zoo_hyperparams").glob("*.yml")} == BY_ALGO.keys() | others


@ROWS
def test_page_names_it(method):
    page = (ROOT / "docs" / f"{method.page}.md").read_text()
    assert re.search(rf"\b{re.escape(method.label)}\b", page), f"docs/{method.page}.md does not name {method.label!r}"
    for cls in (method.optimizer_class, *method.callbacks, method.policy, method.algorithm if not method.is_related else None):
        if inspect.isclass(cls) and cls.__module__.startswith("sb3_cchain."):
            assert cls.__name__ in page, f"docs/{method.page}.md does not name {cls.__name__}"


@ROWS
def test_grid_is_of_arguments(method):
    owner = method.optimizer_class or (method.callbacks[0] if method.callbacks else None)
    for argument, values in method.grid.items():
        assert argument in inspect.signature(owner).parameters
        for value in values:  # each is allowed
            if method.optimizer_class is None:
                owner(**{argument: value})
            else:
                parameters = [th.nn.Parameter(th.ones(2, 2)) for _ in range(3)]
                owner(parameters, **{**method.optimizer_kwargs, argument: value})


def test_each_method_of_the_package_has_a_row():
    used = {cls for row in REGISTRY for cls in (row.optimizer_class, *row.callbacks)}
    exported = {getattr(methods, name) for name in methods.__all__}
    classes = {cls for cls in exported if isinstance(cls, type)}
    assert {cls for cls in classes if issubclass(cls, (BaseCallback, th.optim.Optimizer))} - PARTS <= used


def test_names_and_colours():
    assert len(BY_ALGO) == len(REGISTRY)
    by_name = {name: {(row.color, row.page.split("/")[0]) for row in REGISTRY if row.name == name} for name in METHOD_NAMES}
    assert all(len(values) == 1 for values in by_name.values())
    colors = [to_rgb(color) for ((color, _),) in by_name.values()]
    assert len(set(colors)) == len(colors)
    for suite in SUITES:
        rows = [row for row in REGISTRY if suite in row.suites]
        assert len({row.name for row in rows}) == len({row.label for row in rows}) == len(rows)


@pytest.mark.parametrize("suite", SUITES)
def test_a_suite_has_the_methods_of_its_algorithm(suite):
    methods = suite_methods(suite)
    assert {"vanilla", "cchain"} <= methods.keys()
    assert methods["vanilla"].algo == SUITES[suite].algo
    rows = [row for row in REGISTRY if suite in row.suites]
    assert [methods[row.name] for row in rows] == rows
    assert all(issubclass(method.algorithm, methods["vanilla"].algorithm) for method in methods.values())


def test_methods_outside_the_paper_belong_to_the_suites_of_their_algorithm():
    assert suite_methods("gym_control")["parseval"].algo == "ppo_parseval"
    assert "parseval" not in suite_methods("minatar")


def test_rows_name_suites_that_there_are():
    assert {suite for row in REGISTRY for suite in row.suites} <= SUITES.keys()


BAD = {
    float: [math.nan, math.inf, -math.inf, True, "0.5", [0.5]],
    int: [math.nan, math.inf, True, "1", 1.5],
    bool: ["False", "no", 0, None],
    tuple: [[], "0.9", 0.9, [math.nan], [math.inf], [True], ["0.9"]],
    str: ["", None, 1],
}
# `lr` belongs to the optimiser inside, `verbose` to SB3
ARGUMENTS = [
    (cls, argument, value)
    for cls in dict.fromkeys(cls for row in REGISTRY for cls in (row.optimizer_class, *row.callbacks) if cls is not None)
    for argument, parameter in inspect.signature(cls).parameters.items()
    for value in BAD.get(type(parameter.default), [])
    if argument not in ("lr", "verbose")
]


@pytest.mark.parametrize("cls, argument, value", ARGUMENTS, ids=lambda value: getattr(value, "__name__", repr(value)))
def test_bad_values_are_refused(cls, argument, value):
    arguments = next(row.optimizer_kwargs for row in REGISTRY if cls in (row.optimizer_class, *row.callbacks))
    parameters = [[th.nn.Parameter(th.ones(2, 2)) for _ in range(3)]] if issubclass(cls, OptimizerWrapper) else []
    cls(*parameters, **arguments)
    with pytest.raises((ValueError, TypeError), match=f"`{argument}` must be "):
        cls(*parameters, **{**arguments, argument: value})


@pytest.mark.parametrize("with_c_chain", [False, True])
@ROWS_IN_DISCRETE
def test_trains_saves_and_loads(tmp_path, method, with_c_chain):
    """As the row has it, and with C-CHAIN in place of its algorithm."""
    model, callbacks = make_method(method, with_c_chain)
    model.learn(48, callback=callbacks, log_interval=1000)
    if isinstance(model, (CChainPPO, CChainDQN)):
        assert "churn/loss" in model.logger.name_to_value
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", env=make_env(), device="cpu")
    if isinstance(model, DQN):
        model.save_replay_buffer(tmp_path / "buffer")
        loaded.load_replay_buffer(tmp_path / "buffer")
    before = [parameter.clone() for parameter in model.policy.parameters()]
    for each in (model, loaded):
        each.env.env_method("set_clock", 0, 1)  # the environments then reset alike
        go_on(each, make_method(method, with_c_chain)[1])
    pairs = list(zip(model.policy.parameters(), loaded.policy.parameters(), strict=True))
    assert all(th.equal(one, other) for one, other in pairs)
    assert any(not th.equal(old, new) for old, (new, _) in zip(before, pairs, strict=True))


@ROWS_IN_DISCRETE
def test_a_compiled_policy_learns_as_the_policy(method):
    models = []
    for compiled in (False, True):
        model, callbacks = make_method(method, with_c_chain=False)
        if compiled:
            model.policy = th.compile(model.policy, backend="eager")
        models.append(model.learn(48, callback=[*callbacks, NetworkHealth(interval=1)], log_interval=1000))
    plain, compiled = models
    pairs = zip(plain.policy.parameters(), compiled.policy.parameters(), strict=True)
    assert all(th.equal(one, other) for one, other in pairs)
    logged = [{tag for tag in model.logger.name_to_value if tag.startswith(("health/", "redo/"))} for model in models]
    assert logged[0] == logged[1]


def test_the_page_on_choosing_has_a_row_for_each_method_of_ppo():
    page = (ROOT / "docs/which_method.md").read_text()
    rows = re.findall(r"^\| ([^|]+) \| .*\|$", page.partition("## Method by method")[2], flags=re.MULTILINE)
    labels = {method.label for method in REGISTRY if issubclass(method.algorithm, PPO) and method.name != "vanilla"}
    assert set(rows) - {"method"} == labels
