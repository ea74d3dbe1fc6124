"""
Double DQN and C-CHAIN DQN on continual MinAtar: trains, and writes a table and learning curves of the greedy evaluations.

    python -m benchmarks.minatar --steps-per-task 100000 --seeds 0 1
"""

import argparse
from pathlib import Path

import gymnasium as gym
import numpy as np

from benchmarks.report import report
from benchmarks.runs import Run, complete

ENV_ID = "Continual/MinAtar-v0"
GAMES = ["SpaceInvaders", "Asterix", "Seaquest"]
ALGOS = ["double_dqn", "dqn_cchain"]


def random_return(game: str, n_episodes: int = 1000) -> float:
    """
    :param game: A MinAtar game
    :param n_episodes: Episodes
    :return: Mean return of uniformly random actions
    """
    env = gym.make(ENV_ID, games=[game])
    env.action_space.seed(0)
    env.reset(seed=0)
    returns = []
    for _ in range(n_episodes):
        env.reset()
        done = False
        while not done:
            *_, terminated, truncated, info = env.step(env.action_space.sample())
            done = terminated or truncated
        returns.append(info["episode_return"])
    return float(np.mean(returns))


def main() -> None:
    """Parse the command line, train, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algo", nargs="+", default=ALGOS, choices=ALGOS, help="Algorithms")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="Seeds of the agents")
    parser.add_argument("--steps-per-task", type=int, default=1_500_000, help="Environment steps per game")
    parser.add_argument("--eval-freq", type=int, help="Environment steps between evaluations, by default 30 in a game")
    parser.add_argument("--jobs", type=int, default=2, help="Processes at a time")
    parser.add_argument("--output", type=Path, default=Path("logs/minatar"), help="Folder of the runs")
    args = parser.parse_args()

    folder = args.output / f"3x{args.steps_per_task}"
    eval_freq = args.eval_freq or args.steps_per_task // 30  # every 50 000 of 1.5M steps in the paper
    runs = [
        Run(algo, ENV_ID, seed, 3, args.steps_per_task, folder / f"{algo}_seed{seed}", eval_freq=eval_freq)
        for seed in args.seeds
        for algo in args.algo
    ]
    complete(runs, args.jobs)
    random_returns = [random_return(game) for game in GAMES]
    report(runs, folder, ENV_ID, Run.evaluations, random_returns, window=1, task_names=GAMES, own_scales=True)


if __name__ == "__main__":
    main()
