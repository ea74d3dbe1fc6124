"""The command ``speed``: what is timed, how figures are made of seconds, where tables are written."""

import re
import sys
from dataclasses import replace
from functools import partial
from importlib.metadata import version

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.logger import configure
from torch import nn

from benchmarks.family import cases as family
from benchmarks.grid.run import ROOT
from benchmarks.grid.suites import SUITES
from benchmarks.report.places import PLACE, write_tables
from benchmarks.sensitivity.runs import PARAMETERS
from benchmarks.speed import __main__ as speed
from benchmarks.speed import big_rollout, cases, gpu, memory, sbx_ppo
from benchmarks.speed.checkpoint_cost import measure_share
from benchmarks.speed.settings import model_settings
from benchmarks.speed.tables import Table
from benchmarks.speed.timing import TRAIN, Case, Entry, Product, n_operations, time_case
from benchmarks.speed.update_parts import PARTS, REFERENCE, dqn_parts, parts_of_an_update, ppo_parts, watched
from benchmarks.supervised.tasks import PROBLEMS
from sb3_cchain import CChainPPO
from sb3_cchain.methods.registry import REGISTRY
from sb3_cchain.networks.joint_evaluation import can_evaluate_jointly

# Two updates of tiny networks
TINY = dict(n_steps=16, batch_size=8, n_epochs=1, policy_kwargs=dict(net_arch=[8], activation_fn=nn.ReLU))


def tiny_case(**changed):
    return cases.ppo("Continual/CartPole-v1", partial(cases.matrix_product, 8, 8, 8), n_rounds=1, **{**TINY, **changed})


def test_figures_by_hand(monkeypatch):
    """Two rounds: the base takes 1 and 2 seconds for 100 operations, the other 3 and 8 for 150."""
    seconds = {"base": iter([1, 2]), "other": iter([3, 8])}
    entries = {
        name: Entry(lambda name=name: {TRAIN: next(seconds[name]), "all": 10.0}, operations)
        for name, operations in (("base", 100), ("other", 150))
    }
    monkeypatch.setattr(Product, "operations_per_second", lambda self: 200.0)
    table = time_case(Case(entries, ["base"], n_rounds=2, product=Product("a product", None), note="Said by the case."))
    assert table.header == ["", "", "seconds", "time / base", "operations / base", "speed"]
    assert table.rows == [
        [TRAIN, "base", "1.5", "1", "1.00", "38 %"],  # 100 and 50 of 200
        [TRAIN, "other", "5.5", "3.50 (3.00 to 4.00)", "1.50", "17 %"],  # 50 and 18.75 of 200
        ["all", "base", "10", "1", "", ""],
        ["all", "other", "10", "1.00 (1.00 to 1.00)", "", ""],
    ]
    assert table.note.startswith("2 rounds.") and "a product" in table.note and table.note.endswith("Said by the case.")


def test_entries_are_timed_in_turn():
    order = []
    entries = {name: Entry(lambda name=name: order.append(name) or {"all": 1.0}) for name in "ab"}
    assert time_case(Case(entries, ["b"], n_rounds=5), 2).header == ["", "", "seconds", "time / b"]
    assert order == ["a", "b", "a", "b"]


def test_operations_by_hand():
    assert n_operations(lambda: th.ones(2, 3) @ th.ones(3, 4)) == 2 * 2 * 3 * 4
    assert n_operations(cases.matrix_product(2, 3, 4).compute) == 2 * 2 * 3 * 4
    # Each output is the sum of 3 × 3 × 5 products
    assert n_operations(cases.convolution(2, 6, 5, 7).compute) == 2 * 2 * 6 * 6 * 7 * 3 * 3 * 5


def test_a_product_is_repeated_until_it_can_be_timed(monkeypatch):
    clock = iter([0.0, 0.5])
    monkeypatch.setattr("benchmarks.speed.timing.time.process_time", lambda: next(clock))
    monkeypatch.setattr("benchmarks.speed.timing.PRODUCT_OPERATIONS", 100)
    calls = []
    product = Product("", lambda: calls.append(1) or th.ones(2, 3) @ th.ones(3, 4))  # 48 operations
    assert product.operations_per_second() == 3 * 48 / 0.5
    assert len(calls) == 1 + 3  # counted, timed


def test_ppo_is_timed_with_its_shipped_settings(monkeypatch):
    monkeypatch.setattr(sbx_ppo, "is_installed", lambda: False)
    entries = tiny_case().entries
    assert list(entries) == ["PPO", "lean PPO", "CChainPPO", 'CChainPPO, `churn_reference="next"`', "deep copy"]
    models = {name: entry.round.args[0] for name, entry in entries.items()}
    assert all(model.gamma == 0.99 and model.n_steps == 16 for model in models.values())
    assert type(models["PPO"]) is type(models["lean PPO"]) is PPO
    assert type(models["PPO"].policy.action_dist) is not type(models["lean PPO"].policy.action_dist)
    operations = {name: entry.n_operations for name, entry in entries.items()}
    assert operations["PPO"] == operations["lean PPO"]
    # A tiny network has as many operations in its policy as in its value function; a reference batch costs 4/3 of the former
    assert 1.5 < operations["deep copy"] / operations["PPO"] < 1.9
    assert operations['CChainPPO, `churn_reference="next"`'] < operations["CChainPPO"]
    for entry in entries.values():
        timed = entry.round()
        assert 0 < timed[TRAIN] < timed["iteration (rollout and `train()`)"]
    assert all(model.num_timesteps == 2 * 16 for model in models.values())


def test_related_methods_are_timed_as_the_registry_has_them(monkeypatch):
    """Each row of PPO, with its parts."""
    trained = []

    def learn(self, total_timesteps, callback, *args, **kwargs):
        trained.append((self, callback))

    monkeypatch.setattr(PPO, "learn", learn)
    case = cases.related()
    rows = [row for row in REGISTRY if issubclass(row.algorithm, PPO)]
    assert list(case.entries) == [row.label for row in rows] and len(trained) == len(rows) > 10
    assert list(case.bases) == ["PPO"]
    for row, (model, callbacks) in zip(rows, trained, strict=True):
        assert type(model) is row.algorithm
        assert [type(callback) for callback in callbacks[2:]] == list(row.callbacks)
        assert row.optimizer_class is None or isinstance(model.policy.optimizer, row.optimizer_class)
        assert row.policy == "MlpPolicy" or isinstance(model.policy, row.policy)


def test_sbx_has_the_same_settings():
    """In a process of its own; in this one, the model that is made there."""
    pytest.importorskip("sbx")
    model = sbx_ppo.make_sbx_ppo("Continual/Acrobot-v1")
    stock = PPO(**model_settings("ppo", "Continual/Acrobot-v1"))
    for name in ("n_steps", "batch_size", "n_epochs", "learning_rate", "gamma", "gae_lambda", "ent_coef", "vf_coef"):
        assert getattr(model, name) == getattr(stock, name)
    shapes = {
        state: sorted(value.shape for layer in parameters["params"].values() for value in layer.values())
        for state, parameters in (("actor", model.policy.actor_state.params), ("critic", model.policy.vf_state.params))
    }
    assert shapes["actor"] == sorted([(6, 256), (256,), (256, 256), (256,), (256, 256), (256,), (256, 3), (3,)])
    assert shapes["critic"] == sorted([(6, 256), (256,), (256, 256), (256,), (256, 256), (256,), (256, 1), (1,)])
    inputs = th.tensor([-2.0, 3.0])
    for module in (nn.LeakyReLU(0.1), nn.ReLU()):
        assert np.allclose(sbx_ppo.flax_activation(module)(inputs.numpy()), module(inputs))
    with pytest.raises(TypeError, match="Tanh"):
        sbx_ppo.flax_activation(nn.Tanh())


@pytest.mark.slow
def test_sbx_is_timed():
    pytest.importorskip("sbx")
    entry = tiny_case(policy_kwargs=dict(net_arch=[8], activation_fn=nn.ReLU)).entries["SBX's PPO"]
    timed = entry.round()
    assert 0 < timed[TRAIN] < timed["iteration (rollout and `train()`)"]


def test_memory_is_that_of_a_train_that_has_begun():
    model = big_rollout.with_rollout(PPO, "ppo", n_envs=2, n_steps=16, batch_size=8)
    model.set_logger(configure(None, [""]))
    assert 100 < model.rollout_buffer.observations.mean() < 155
    steps = []
    model.policy.optimizer.register_step_post_hook(lambda *_: steps.append(1))
    memory.start_train(model, 2)
    assert len(steps) == 2
    with pytest.raises(RuntimeError, match=r"has only \d+ updates"):
        memory.start_train(model, 1000)
    assert 0.05 < big_rollout.peak_memory() < 50


def test_tables_are_written_between_their_comments(tmp_path):
    page = tmp_path / "folder" / "page.md"
    page.parent.mkdir()
    before = "Before.\n<!-- table: one -->\n<!-- end -->\n\n<!-- table: two -->\n\nold\n\n<!-- end -->\nAfter.\n"
    page.write_text(before)
    write_tables({"one": "new"}, tmp_path)
    assert page.read_text() == before.replace("one -->\n", "one -->\n\nnew\n\n")
    write_tables({"one": "newer", "two": "2"}, tmp_path)
    expected = "Before.\n<!-- table: one -->\n\nnewer\n\n<!-- end -->\n\n<!-- table: two -->\n\n2\n\n<!-- end -->\nAfter.\n"
    assert page.read_text() == expected
    with pytest.raises(ValueError, match="three"):
        write_tables({"three": "3"}, tmp_path)


def test_a_table_in_markdown():
    table = Table(["", "a"], [["b", "1"]], "A note. " * 30)
    lines = table.markdown().splitlines()
    assert lines[:4] == ["|  | a |", "| --- | --- |", "| b | 1 |", ""]
    assert max(map(len, lines)) <= 120


@pytest.mark.parametrize("algorithm", [PPO, DQN])
def test_the_share_of_a_run_that_saving_takes(monkeypatch, algorithm):
    monkeypatch.setitem(SUITES, "gym_control", replace(SUITES["gym_control"], checkpoint_freq=2000))
    arguments = dict(n_steps=32) if algorithm is PPO else dict(buffer_size=100, learning_starts=10**9, train_freq=1)
    steps, training, saved, share = measure_share(
        lambda: algorithm("MlpPolicy", "CartPole-v1", batch_size=32, device="cpu", **arguments), "gym_control", 100
    )
    assert steps == "2 000" and training != "0 s" and float(saved.removesuffix(" s")) > 0
    assert 0 < float(share.removesuffix(" %")) < 50


def test_the_command_writes_what_it_measured(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(speed.os, "sched_setaffinity", lambda *_: None, raising=False)
    monkeypatch.setattr(speed, "ROOT", tmp_path)
    monkeypatch.setattr(speed, "CASES", {"one": lambda: Case({"a": Entry(lambda: {"all": 1.0})}, ["a"], n_rounds=3)})
    monkeypatch.setattr(speed, "OTHERS", {"other": lambda: Table(["another way"], [], "")})
    (tmp_path / "docs").mkdir()
    page = tmp_path / "docs" / "page.md"
    names = ["made_with", "one", "other"]
    page.write_text("".join(f"<!-- table: {name} -->\n<!-- end -->\n" for name in names))
    monkeypatch.setattr(sys, "argv", ["speed", "--rounds", "2"])
    speed.main()
    assert "2 rounds." in capsys.readouterr().out and "rounds" not in page.read_text()
    monkeypatch.setattr(sys, "argv", ["speed", "--write"])
    speed.main()
    for part in ("3 rounds.", "| another way |", f"torch {version('torch')}"):
        assert part in page.read_text()


def test_each_table_has_one_place_in_the_documentation():
    places = [name for page in (ROOT / "docs").rglob("*.md") for name in PLACE.findall(page.read_text())]
    of_family = [f"family_{name}" for name in family.CASES]
    of_family += ["family_evidence", *(f"falls_{name}" for name, case in family.CASES.items() if case.solved is not None)]
    others = [
        "made_with",
        "gpu",
        "shelf",
        "gym_control_scores",
        "cartpole_tasks",
        "acrobot_tasks",
        "lunarlander_tasks",
        "mountaincar_tasks",
        "gym_control_collapses",
        *(f"supervised_{name}" for name in PROBLEMS),
    ]
    others += ["plasticity", "sensitivity_cost", *(f"sensitivity_{name}" for name in PARAMETERS)]
    others += ["doctor_findings", "doctor_confusion", "doctor_wrong", "doctor_sick"]
    assert sorted(places) == sorted([*others, *speed.CASES, *speed.OTHERS, *of_family])
    assert not re.search(r"<!-- table: \w+ -->(?!\n)", "".join(page.read_text() for page in (ROOT / "docs").rglob("*.md")))


def test_updates_are_timed_on_each_device(monkeypatch):
    def make(device):
        yield "base", lambda: times.append(1.0)
        yield "other", lambda: times.append(3.0)

    times = []
    monkeypatch.setattr(gpu, "CASES", {"a case": make})
    monkeypatch.setattr(gpu, "wall_clock", lambda call, device: call() or times[-1])
    table = gpu.gpu_table(2, ("cpu",))
    assert table.header == ["", "", "cpu, seconds", "cpu, time / base"]
    assert table.rows == [["a case", "base", "1", "1"], ["a case", "other", "3", "3.00 (3.00 to 3.00)"]]


@pytest.mark.parametrize("algorithm, algo", [(PPO, "ppo"), (CChainPPO, "ppo_cchain")])
def test_parts_of_an_update(algorithm, algo):
    model = algorithm(**model_settings(algo, "Continual/CartPole-v1", **TINY)).learn(32)
    before = th.Tensor.backward, th.nn.utils.clip_grad_norm_, dict(vars(model.policy)), dict(vars(model.policy.optimizer))
    if algorithm is CChainPPO:
        with watched(model):
            assert can_evaluate_jointly(model.policy)  # as when nobody watches
    parts = parts_of_an_update(model, model.train, n_updates=2)
    # Only C-CHAIN has reference batches
    assert (parts.pop(REFERENCE) > 0) == (algorithm is CChainPPO)
    assert all(seconds > 0 for seconds in parts.values())
    assert before[:2] == (th.Tensor.backward, th.nn.utils.clip_grad_norm_)
    assert before[2:] == (vars(model.policy), vars(model.policy.optimizer))


def test_tables_of_the_parts():
    table = ppo_parts(n_rounds=1, **TINY)
    assert [row[0] for row in table.rows] == [*PARTS, "everything else", "all"]
    total = [sum(int(row[column]) for row in table.rows[:-1]) for column in range(1, 5)]
    assert total == pytest.approx([int(cell) for cell in table.rows[-1][1:]], abs=len(PARTS))
    table = dqn_parts(n_rounds=1, n_updates=2, buffer_size=100, learning_starts=10)
    assert table.header[:3] == ["", "DoubleDQN", "CChainDQN"] and REFERENCE not in {row[0] for row in table.rows}
    assert all(int(cell) > 0 for row in table.rows for cell in row[1:])
