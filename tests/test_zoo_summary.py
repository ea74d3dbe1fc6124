"""What ``sb3-cchain train`` says at its end."""

import io
import shlex

import pytest
from rich.console import Console

from sb3_cchain.tasks.clock import TaskClock
from sb3_cchain.zoo.summary import TaskSummary, summarise_tasks, task_steps, task_table
from tests.zoo_command import FAST, NO_EVALUATION, SHORT_PPO, command

COLUMNS = ("timesteps", "task_id", "n_episodes", "mean_return")
ROWS = [
    dict(zip(COLUMNS, row, strict=True))
    for row in [(800, 0, 4, 10.0), (1600, 0, 8, 40.0), (2400, 0, 4, 10.0), (3200, 1, 12, 50.0), (3500, 2, 0, -1.0)]
]
TASKS = [
    # The last twelve episodes: 8 of 40 and 4 of 10. The mean over rollouts is another one than over episodes
    TaskSummary(0, 2500, 16, 20.0, 30.0),
    TaskSummary(1, 1000, 12, 50.0, 50.0),
    TaskSummary(2, 500, 0, -1.0, -1.0),
]


def test_tasks_by_hand():
    assert summarise_tasks(ROWS, {0: 2500, 1: 1000, 2: 500}) == TASKS


@pytest.mark.parametrize(
    "clock, num_timesteps, steps",
    [
        (TaskClock([2500, 1000, 900]), 4000, {0: 2500, 1: 1000, 2: 500}),
        (TaskClock([2500, 1000, 900]), 2500, {0: 2500}),  # the second has not begun
        (TaskClock([100, 2500, 1000], first_task=1), 2600, {1: 2500, 2: 100}),
        (None, 4000, {0: 2400, 1: 800, 2: 800}),
    ],
)
def test_steps_of_tasks_by_hand(clock, num_timesteps, steps):
    assert task_steps(ROWS, clock, num_timesteps) == steps


def test_steps_of_tasks_that_come_back_by_hand():
    rows = [dict(timesteps=100 * i, task_id=task) for i, task in enumerate([0, 1, 0, 1, 0], start=1)]
    assert task_steps(rows, None, 500) == {0: 300, 1: 200}
    assert task_steps(rows[:-1], None, 450) == {0: 200, 1: 250}
    assert task_steps([], None, 500) == {}


def test_the_table_fits_a_terminal():
    console = Console(file=io.StringIO(), width=80)
    console.print(task_table([TASKS[0]._replace(steps=5_000_000, episodes=100_000)], ["MiniGrid-DoorKey-16x16-v0"]))
    shown = console.file.getvalue().splitlines()
    assert [part.strip() for part in shown[3].split("|")[3:7]] == ["5,000,000", "100,000", "20", "30"]
    name = "".join(line.split("|")[2].strip() for line in shown[3:-1])  # on several lines
    assert name == "MiniGrid-DoorKey-16x16-v0" and max(map(len, shown)) <= 80


def train(folder, capsys, env, *arguments, params=()):
    command(
        *("train", "--algo", "ppo_cchain", "--env", env, "-f", folder / "logs", "--seed", "0", *FAST, *NO_EVALUATION),
        *(*arguments, *SHORT_PPO, *params),
    )
    lines = capsys.readouterr().out.splitlines()
    return lines[next(number for number, line in enumerate(lines) if line.startswith("ppo_cchain in")) :]


def test_the_end_of_training(tmp_path, capsys):
    arguments = ("-n", 160, "-tb", tmp_path / "tb", "-P", "--checkpoint-freq", 64)
    shown = train(tmp_path, capsys, "Continual/CartPole-v1", *arguments, "--env-kwargs", "n_tasks:3", "steps_per_task:64")
    assert shown[0].startswith("ppo_cchain in Continual/CartPole-v1: step 160 of 160, in 0:00:")
    assert [line.split("|")[1:3] for line in shown[4:7]] == [
        ["    0 ", "    64 "],
        ["    1 ", "    64 "],
        ["    2 ", "    32 "],
    ]
    assert shown[8].startswith("J(T), the mean over the tasks: ")
    where = dict(line.split(":", 1) for line in shown[9:])
    run, logs = tmp_path / "logs/ppo_cchain/Continual-CartPole-v1_1", tmp_path / "tb/Continual-CartPole-v1/CChainPPO_1"
    assert {title: text.strip() for title, text in where.items()} == {
        "Model": f"{run}/Continual-CartPole-v1.zip",
        "Checkpoint": f"{run}/checkpoints/step_000000000128",
        "TensorBoard": str(logs),
        "Returns": f"{logs}/returns.csv",
        "Watch it": "sb3-cchain enjoy --algo ppo_cchain --env Continual/CartPole-v1 "
        f"-f {tmp_path}/logs --exp-id 1 --env-kwargs first_task:2",
        "See curves": f"tensorboard --logdir {tmp_path}/tb",
    }
    command(*shlex.split(where["Watch it"])[1:], "--no-render", "-n", 5)


def test_tasks_of_a_signal_have_its_numbers(tmp_path, capsys):
    """And not the names of the environment's own."""
    callbacks = "callback:['sb3_cchain.TaskSync', {'sb3_cchain.TaskSignal': dict(switch_at=[96])}]"
    options = ("-n", 160, "--env-kwargs", "n_tasks:2", "steps_per_task:64")
    shown = train(tmp_path, capsys, "Continual/CartPole-v1", *options, params=[callbacks])
    assert [line.split("|")[1:3] for line in shown[4:6]] == [["    0 ", "    96 "], ["    1 ", "    64 "]]


def test_the_end_of_training_without_tasks(tmp_path, capsys):
    shown = train(tmp_path, capsys, "CartPole-v1", "-n", 64)
    assert shown[1].startswith("Mean return of the last 2 episodes: ")
    assert [line.split(":")[0] for line in shown[2:]] == ["Model", "Watch it"]
