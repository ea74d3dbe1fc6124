"""``python -m benchmarks.speed.overhead`` and the timer that it shares with ``monitor_cost``."""

import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks.speed import overhead
from benchmarks.speed.monitor_cost import cost
from benchmarks.speed.overhead import PARTS, BareDQN, BarePPO, as_table, first_task, time_in_turn
from benchmarks.speed.time_inside import TimeInside
from sb3_cchain import CChainDQN, CChainPPO

PPO_SETTINGS = dict(n_steps=32, batch_size=16, n_epochs=1, seed=0, device="cpu", reset_churn_coef=True)
DQN_SETTINGS = dict(learning_starts=8, buffer_size=100, train_freq=1, seed=0, device="cpu", reset_churn_coef=True)


def test_time_inside_by_hand(monkeypatch):
    clock = iter([0, 3, 10, 14])
    monkeypatch.setattr("benchmarks.speed.time_inside.time.process_time", lambda: next(clock))
    words, inside = [], TimeInside()
    owner = type("Owner", (), {"say": lambda self, word, end: words.append(word + end), "ask": lambda self: "yes"})()
    inside.watch(owner, "say", "ask")
    owner.say("a", end="b")
    assert inside.seconds == 3 and words == ["ab"]
    assert owner.ask() == "yes" and inside.seconds == 7


def test_cost_of_a_callback():
    class Idle(BaseCallback):
        def _on_step(self):
            return True

    settings = dict(policy="MlpPolicy", env="CartPole-v1", n_steps=64, batch_size=64, device="cpu")
    inside, rest = cost(PPO, settings, Idle(), 64)
    assert 0 < inside < rest


@pytest.mark.parametrize("algorithm, bare, settings", [(CChainPPO, BarePPO, PPO_SETTINGS), (CChainDQN, BareDQN, DQN_SETTINGS)])
def test_both_trainings_make_the_same_steps_and_updates(algorithm, bare, settings):
    env_id = "Continual/CartPole-v1"
    models = algorithm("MlpPolicy", env_id, **settings), bare("MlpPolicy", first_task(env_id), **settings)
    before = [parameter.clone() for parameter in models[0].policy.parameters()]
    timings = time_in_turn(models, 64, 2)
    assert len(timings) == 2 and models[0].num_timesteps == models[1].num_timesteps == 3 * 64
    one, other = (list(model.policy.parameters()) for model in models)
    assert all(map(th.equal, one, other)) and not all(map(th.equal, one, before))
    assert len(models[0].continual_returns) > 1 and not hasattr(models[1], "continual_returns")
    for timing in (timing for pair in timings for timing in pair):
        assert 0 < sum(timing[part] for part in PARTS) < timing["all but train()"] < timing["all"]
        assert timing["around the simulation"] > 0 and timing["callbacks"] > 0


def test_first_task_keeps_the_limit_of_steps():
    env = first_task("Continual/Acrobot-v1")
    env.reset(seed=0)
    ends = [env.step(0)[3] for _ in range(400)]
    assert ends.index(True) == 399


def test_table_by_hand():
    zero = dict.fromkeys(PARTS, 0.0)

    def timing(first_part, everything):
        return {**zero, PARTS[0]: first_part, "all but train()": everything / 2, "all": everything}

    table = as_table("title", [(timing(3, 30), timing(1, 20)), (timing(2, 22), timing(2, 40))], 1_000_000)
    rows = list(zip(*(column.cells for column in table.columns), strict=True))
    assert [row[0] for row in rows] == [*PARTS, "these parts", "all but train()"]
    assert rows[0] == (PARTS[0], "2.5", "1.5", "5.00%", "0.00%", "10.00%")
    assert rows[1] == (PARTS[1], "0.0", "0.0", "0.00%", "0.00%", "0.00%")
    assert rows[-2][1:] == rows[0][1:]
    assert rows[-1] == ("all but train()", "13.0", "15.0", "1.25%", "-22.50%", "25.00%")
    assert table.caption == "All, without: 30 µs"


def test_every_case_has_a_name_on_the_command_line(monkeypatch, capsys):
    made = []
    monkeypatch.setattr(overhead, "CASES", {"tiny": lambda: made.append("tiny") or (*_tiny(), 32)})
    monkeypatch.setattr("sys.argv", ["overhead", "--rounds", "1"])
    overhead.main()
    assert made == ["tiny"] and "CChainPPO, tiny, rounds: 1" in capsys.readouterr().out


def _tiny():
    env_id = "Continual/CartPole-v1"
    return CChainPPO("MlpPolicy", env_id, **PPO_SETTINGS), BarePPO("MlpPolicy", first_task(env_id), **PPO_SETTINGS)
