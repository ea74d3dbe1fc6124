"""The command ``benchmarks.family``: its runs, and its tables of results written by hand."""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from sb3_contrib.common.maskable.utils import get_action_masks
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.family import __main__ as command
from benchmarks.family import training
from benchmarks.family.betas import BETAS
from benchmarks.family.case import Case, Variant
from benchmarks.family.cases import CASES
from benchmarks.family.masked_symbols import continual_masked_symbols
from benchmarks.family.picture import plot
from benchmarks.family.tables import case_table, falls, falls_table, number, read_all, summary_table
from benchmarks.family.training import runs_of, train, train_all
from sb3_cchain import CChainPPO, resume

# Two tasks of 20 steps, four evaluations of each: the last of each task is its end
SMALL = Case(
    "Continual CartPole",
    "made up",
    "Continual/CartPole-v1",
    {"ppo": Variant("PPO", PPO), "cchain": Variant("C-CHAIN", CChainPPO, {"target_churn_ratio": 1e3})},
    steps=40,
    eval_freq=5,
    seeds=2,
    settings={"n_steps": 4, "batch_size": 2, "policy_kwargs": {"net_arch": [4]}},
    env_kwargs={"n_tasks": 2, "steps_per_task": 20},
    n_eval_episodes=1,
    n_tasks=2,
)


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr("benchmarks.family.cases.CASES", {"small": SMALL})
    for module in (training, command):
        monkeypatch.setattr(module, "CASES", {"small": SMALL})
    monkeypatch.setattr(command, "EVIDENCE", {"small": SMALL})


@pytest.fixture
def runs(small, tmp_path):
    """Of both variants, seed by seed."""
    return runs_of("small", tmp_path / "results", tmp_path / "logs")


def write(run, scores, column="mean_return"):
    run.result.parent.mkdir(parents=True, exist_ok=True)
    lines = [f"{5 * (i + 1)},{score}" for i, score in enumerate(scores)]
    run.result.write_text("\n".join([f"timesteps,{column}", *lines]) + "\n")


def rows(table):
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines() if line.startswith("|")]


def test_a_table_of_the_seeds(runs):
    for run, last in zip(runs, [10.0, 30.0, 20.0], strict=False):
        write(run, [0, 0, 0, 200, 0, 0, 0, last])
    table = case_table(SMALL, read_all(runs))
    # (200 + 10) / 8 and (200 + 20) / 8 over training; (200 + 10) / 2 and (200 + 20) / 2 at the end
    assert rows(table)[2:] == [["PPO", "26.2, 27.5", "26.9", "105, 110", "108"], ["C-CHAIN", "28.8", "28.8", "115", "115"]]
    assert table.endswith("Seeds that are not done yet: C-CHAIN: 1.")
    write(runs[3], [0] * 8)
    assert "not done" not in case_table(SMALL, read_all(runs))


def test_churn_is_shown_as_a_share_of_the_base(runs, monkeypatch):
    case = replace(SMALL, monitor={})
    monkeypatch.setattr(training, "CASES", {"small": case})

    def shares():
        _, _, base, cchain = rows(case_table(case, read_all(runs)))
        return base[-2:], cchain[-2:]

    # No update before the first evaluation
    for run, (policy, values) in zip(runs, [(1.0, 40.0), (0.5, 10.0), (3.0, 40.0)], strict=False):
        write(run, ["0,,", *[f"0,{policy},{values}"] * 7], "mean_return,policy_churn,value_churn")
    # Of the seed that both have: 0.5 of 1, 10 of 40
    assert shares() == (["1.00", "1.00"], ["0.50", "0.25"])
    write(runs[3], ["0,0.5,10"] * 8, "mean_return,policy_churn,value_churn")
    # Over both seeds: 0.5 of a mean of 2, 10 of 40
    assert shares() == (["1.00", "1.00"], ["0.25", "0.25"])


def test_churn_is_measured(runs, monkeypatch):
    monkeypatch.setattr(training, "CASES", {"small": replace(SMALL, monitor={"interval": 2, "batch_size": 4})})
    lines = train(runs[0]).result.read_text().splitlines()
    assert lines[0] == "timesteps,mean_return,policy_churn,value_churn" and len(lines) == 9
    (evaluations,) = read_all(runs)["ppo"].values()
    # Of eight evaluations the first is after step 5, when a rollout of 4 steps has been learned from
    assert evaluations.shape == (8, 4) and (evaluations[:, 2:] > 0).all()


def test_a_difference_is_bold_when_its_interval_leaves_out_0(runs):
    base = [(0.0, 100.0), (2.0, 102.0)]
    for seed, (low, high) in enumerate(base):
        write(runs[2 * seed], [low] * 8)
        write(runs[2 * seed + 1], [high] * 8)
    ((*_, means, difference, _, _),) = rows(summary_table({"small": (SMALL, read_all(runs))}))[2:]
    # Welch: each mean has the standard error 1, their difference sqrt(2), with 2 degrees of freedom: 4.303 * sqrt(2) = 6.08
    assert (means, difference) == ("1.00 → 101", "**100 (93.9 to 106)**")
    write(runs[1], [0.0] * 8)
    write(runs[3], [4.0] * 8)
    ((*_, difference, _, _),) = rows(summary_table({"small": (SMALL, read_all(runs))}))[2:]
    assert difference.startswith("1.00 (-") and " to " in difference


def test_a_difference_is_of_the_same_seeds(runs):
    for run, score in zip(runs, [1.0, 2.0, 100.0], strict=False):
        write(run, [score] * 8)
    ((_, _, seeds, means, difference, *_),) = rows(summary_table({"small": (SMALL, read_all(runs))}))[2:]
    assert (seeds, means, difference) == ("1", "1.00 → 2.00", "1.00")


def test_tables_without_runs(runs):
    evaluations = read_all(runs)
    assert summary_table({"small": (SMALL, evaluations)}).endswith("Not done yet: Continual CartPole (C-CHAIN).")
    assert case_table(SMALL, evaluations) == falls_table(replace(SMALL, solved=475), evaluations) == "No run is done yet."


def test_falls():
    evaluations = np.array([[1, 0.0], [2, 10.0], [3, 4.0], [4, 6.0], [5, 10.0], [6, 12.0]])
    assert falls(evaluations, solved=10, worst=0) == (2.0, 4.0, 0.25)
    assert falls(evaluations, solved=10, worst=4) == (2.0, 4.0, 0.5)
    # The evaluation that solved it is no fall, and nothing comes after the last one
    step, *after = falls(evaluations[:2], solved=9, worst=0)
    assert step == 2.0 and np.isnan(after).all()
    assert falls(evaluations[4:], solved=10, worst=0) == (5.0, 12.0, 0.0)
    assert falls(evaluations, solved=13, worst=0) is None


def test_a_table_of_falls(runs):
    write(runs[0], [0, 475, 500, 100, 100, 500, 500, 500])
    write(runs[1], [0] * 8)
    write(runs[3], [0] * 7 + [480])
    table = falls_table(replace(SMALL, solved=475), read_all(runs))
    assert rows(table)[2:] == [
        ["PPO", "0", "10", "100", "33%", "500", "334"],
        ["C-CHAIN", "0", "never", "", "", "0.00", "0.00"],
        ["C-CHAIN", "1", "40", "", "", "480", "60.0"],
    ]
    assert table.endswith("Seeds that are not done yet: PPO: 1.")


@pytest.mark.parametrize("value, text", [(-181.3, "-181"), (1234.5, "1234"), (23.45, "23.4"), (0.984, "0.98"), (99.96, "100")])
def test_numbers(value, text):
    assert number(value) == text


@pytest.mark.parametrize(
    "scores, column, message",
    [
        ([1.0] * 7, "mean_return", "must have 8 evaluations"),
        ([1.0] * 8, "success_rate", "must have the columns timesteps and"),
    ],
)
def test_a_result_of_another_case_is_refused(runs, scores, column, message):
    write(runs[0], scores, column)
    with pytest.raises(ValueError, match=message):
        read_all(runs)


@pytest.mark.parametrize("monitor", [None, {"interval": 2, "batch_size": 4}])
def test_a_run_goes_on_where_it_was(runs, monkeypatch, monitor):
    monkeypatch.setattr(training, "CASES", {"small": replace(SMALL, monitor=monitor)})
    run = runs[1]
    expected = train(run).result.read_text()
    assert expected.startswith("timesteps,mean_return") and len(expected.splitlines()) == 9
    assert not run.checkpoints.exists()
    run.result.unlink()

    def break_off(*args):
        raise KeyboardInterrupt

    resumed = []
    with monkeypatch.context() as context:
        context.setattr(training, "_write", break_off)
        with pytest.raises(KeyboardInterrupt):
            train(run)
    with monkeypatch.context() as context:
        context.setattr(training, "resume", lambda path, *args, **kw: resumed.append(path) or resume(path, *args, **kw))
        assert train(run).result.read_text() == expected
    assert resumed == [run.checkpoints] and not run.checkpoints.exists()


def test_runs_that_are_done_are_not_made_again(runs):
    for run in runs:
        write(run, [0] * 8)
    assert list(train_all(runs, 1)) == []


@pytest.mark.parametrize("error", [ValueError("boom"), KeyboardInterrupt()])
def test_no_run_begins_after_an_error(runs, monkeypatch, error):
    begun = []

    class Threads(ThreadPoolExecutor):
        def __init__(self, n_jobs, **_):
            super().__init__(n_jobs)

    def fail_soon(run):
        begun.append(run)
        if len(begun) == 1:
            raise error
        time.sleep(0.2)

    monkeypatch.setattr(training, "ProcessPoolExecutor", Threads)
    monkeypatch.setattr(training, "train", fail_soon)
    with pytest.raises(type(error)):
        list(train_all(10 * runs, 2))
    assert len(begun) < 6


def test_a_run_that_another_process_made_is_left_as_it_is(runs):
    write(runs[0], [0] * 8)
    before = runs[0].result.read_text()
    assert train(runs[0]) == runs[0] and runs[0].result.read_text() == before


def test_a_picture_holds_all_curves(runs, tmp_path, monkeypatch):
    limits = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: limits.extend(axes.get_ylim() for axes in figure.axes))
    write(runs[0], [10] * 8)
    write(runs[1], [90] * 8)
    plot(replace(SMALL, solved=50, worst=-5), read_all(runs), tmp_path / "curves.png")
    assert [bottom for bottom, _ in limits] == [-5, -5] and all(top > 90 for _, top in limits)


def test_the_command(runs, tmp_path, capsys):
    arguments = ["--results", str(tmp_path / "results"), "--logs", str(tmp_path / "logs"), "--docs", str(tmp_path / "docs")]
    write(runs[0], [0] * 8)
    command.main(["--case", "small", "--variant", "ppo", "--seeds", "0", "1", *arguments])
    shown = capsys.readouterr().out
    assert "small/ppo_seed_1: done" in shown and "ppo_seed_0" not in shown and "not done yet: C-CHAIN: 0, 1." in shown
    page = tmp_path / "docs" / "page.md"
    page.parent.mkdir()
    page.write_text("".join(f"<!-- table: {name} -->\n<!-- end -->\n" for name in ("family_small", "family_evidence")))
    command.main(["--write", *arguments])
    assert "small" in (shown := capsys.readouterr().out) and " 2 of  4 runs" in shown
    assert "| PPO | " in page.read_text() and "Not done yet: Continual CartPole (C-CHAIN)." in page.read_text()
    assert (tmp_path / "docs/images/family/small.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--case", "nonsense"], "invalid choice: 'nonsense'"),
        (["--case", "ppo_cartpole", "--variant", "sac"], "must be of the cases: ppo, cchain_1e4, cchain_1e3; got sac"),
        (["--case", "ppo_cartpole", "--seeds", "9"], "must be of the cases: 0, 1, 2, 3, 4; got 9"),
    ],
)
def test_what_is_unknown_is_refused(arguments, message, capsys):
    with pytest.raises(SystemExit) as error:
        command.main(arguments)
    assert error.value.code == 2 and message in capsys.readouterr().err


@pytest.mark.parametrize("name", CASES)
def test_evaluations_divide_a_case(name):
    case = CASES[name]
    assert case.eval_freq % case.n_envs == 0 and case.steps % case.eval_freq == 0
    assert case.steps // case.eval_freq % case.n_tasks == 0
    if "steps_per_task" in case.env_kwargs:
        assert case.env_kwargs["steps_per_task"] * case.n_tasks == case.steps
    base, *others = case.variants
    assert not base.startswith("cchain") and any(name.startswith("cchain") for name in others)


@pytest.mark.parametrize("name", BETAS)
def test_the_default_is_among_the_betas(name):
    labels = [variant.label for variant in BETAS[name].variants.values()]
    for target in ("policy", "value"):
        of_target = [label for label in labels if label.startswith(target)]
        assert len([label for label in of_target if "(default)" in label]) == bool(of_target)


def test_masks_of_the_present_task():
    env = make_vec_env(lambda: continual_masked_symbols(n_tasks=2, steps_per_task=60, n_symbols=6), seed=0)
    first, second = (task.answers for task in env.get_attr("tasks")[0])
    assert first != second
    (symbol,) = env.reset()
    for step in range(120):
        answers = first if step < 60 else second
        (mask,) = get_action_masks(env)
        assert mask[answers[symbol]] and mask.sum() == 3
        (symbol,), (reward,), _, _ = env.step([answers[symbol]])
        assert reward == 1
