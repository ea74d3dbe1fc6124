"""
The command ``sb3-cchain train|enjoy|plot_train|all_plots|plot_from_file``: RL Zoo's own commands, which know our
algorithms and find our hyperparameters.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import yaml
from stable_baselines3.common.base_class import BaseAlgorithm

try:
    import optuna
    import rl_zoo3.cli
    import rl_zoo3.exp_manager
    from rl_zoo3 import ALGOS
    from rl_zoo3.hyperparams_opt import (
        HYPERPARAMS_CONVERTER,
        HYPERPARAMS_SAMPLER,
        convert_offpolicy_params,
        convert_onpolicy_params,
        sample_her_params,
        sample_ppo_params,
    )
except ImportError as error:
    raise ImportError(f'The sb3-cchain command needs RL Zoo ({error}): pip install "sb3-cchain[zoo]"') from error

from sb3_cchain import CChainDQN, CChainPPO, DoubleDQN
from sb3_cchain.envs import TaskVecNormalize

OUR_ALGOS: dict[str, type[BaseAlgorithm]] = {"ppo_cchain": CChainPPO, "dqn_cchain": CChainDQN, "double_dqn": DoubleDQN}


def sample_ppo_cchain_params(
    trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """
    RL Zoo's search space for PPO, and β.

    :param trial: Optuna's trial
    :param n_actions: Dimension of continuous actions, 0 for others
    :param n_envs: Number of environments
    :param additional_args: See RL Zoo
    :return: Hyperparameters of ``CChainPPO``
    """
    # A decade beyond the paper's values on either side: 1e3 to 1e5 for discrete actions, 0.05 to 0.5 for continuous ones
    low, high = (5e-3, 5.0) if n_actions > 0 else (1e2, 1e6)
    target_churn_ratio = trial.suggest_float("target_churn_ratio", low, high, log=True)
    return {**sample_ppo_params(trial, n_actions, n_envs, additional_args), "target_churn_ratio": target_churn_ratio}


def sample_double_dqn_params(
    trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """
    RL Zoo's search space for DQN, less the network: its choice would replace the whole of ``policy_kwargs``, and so the
    feature extractor of the YAML file.

    :param trial: Optuna's trial
    :param n_actions: Dimension of continuous actions, 0 for others
    :param n_envs: Number of environments
    :param additional_args: See RL Zoo
    :return: Hyperparameters of ``DoubleDQN``
    """
    train_freq = trial.suggest_int("train_freq", 1, 10)
    sampled = {
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.0001, 0.03, log=True),
        "batch_size_pow": trial.suggest_int("batch_size_pow", 2, 11),
        "learning_rate": trial.suggest_float("learning_rate", 1e-5, 0.002, log=True),
        "train_freq": train_freq,
        "subsample_steps": trial.suggest_int("subsample_steps", 1, min(train_freq, 8)),
        "exploration_final_eps": trial.suggest_float("exploration_final_eps", 0, 0.2),
        "exploration_fraction": trial.suggest_float("exploration_fraction", 0, 0.5),
        "target_update_interval": trial.suggest_int("target_update_interval", 1, 20000, log=True),
    }
    if additional_args["using_her_replay_buffer"]:
        sampled = sample_her_params(trial, sampled, additional_args["her_kwargs"])
    return convert_dqn_params(sampled)


def sample_dqn_cchain_params(
    trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """
    The search space of ``DoubleDQN``, and β.

    :param trial: Optuna's trial
    :param n_actions: Dimension of continuous actions, 0 for others
    :param n_envs: Number of environments
    :param additional_args: See RL Zoo
    :return: Hyperparameters of ``CChainDQN``
    """
    # A decade beyond the paper's 0.01 on either side
    target_churn_ratio = trial.suggest_float("target_churn_ratio", 1e-3, 1e-1, log=True)
    return {**sample_double_dqn_params(trial, n_actions, n_envs, additional_args), "target_churn_ratio": target_churn_ratio}


def convert_dqn_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: Values of a trial
    :return: The hyperparameters that they stand for, without a network
    """
    params = convert_offpolicy_params({**sampled_params, "net_arch": "small"})
    del params["policy_kwargs"]
    return params


def register_algorithms() -> None:
    """
    Make our algorithms known to RL Zoo, in place, and let ``normalize: ...`` in a YAML file restart at each task
    (``restart=False`` in it does not). Where there are no tasks it is SB3's ``VecNormalize``.
    """
    rl_zoo3.exp_manager.VecNormalize = TaskVecNormalize  # type: ignore[misc]
    ALGOS.update(OUR_ALGOS)
    HYPERPARAMS_SAMPLER["ppo_cchain"] = sample_ppo_cchain_params
    HYPERPARAMS_CONVERTER["ppo_cchain"] = convert_onpolicy_params
    HYPERPARAMS_SAMPLER["double_dqn"] = sample_double_dqn_params
    HYPERPARAMS_SAMPLER["dqn_cchain"] = sample_dqn_cchain_params
    HYPERPARAMS_CONVERTER["double_dqn"] = HYPERPARAMS_CONVERTER["dqn_cchain"] = convert_dqn_params


def hyperparams_folder() -> Path:
    """
    :return: The folder of our YAML files: inside the installed package, at the root of a checkout
    """
    package = Path(__file__).parent
    inside = package / "zoo_hyperparams"
    return inside if inside.is_dir() else package.parent / "zoo_hyperparams"


def hyperparams_file(algo: str, env_id: str) -> Path | None:
    """
    :param algo: Name of the algorithm on the command line
    :param env_id: Environment id
    :return: Our YAML file, where we have settings for the environment or where the algorithm is ours; otherwise None,
        and RL Zoo's settings hold
    """
    path = hyperparams_folder() / f"{algo}.yml"
    if path.is_file() and (algo in OUR_ALGOS or env_id in yaml.safe_load(path.read_text())):
        return path
    return None


def main() -> None:
    """Run RL Zoo's command line."""
    commands = ["train", "enjoy", "plot_train", "all_plots", "plot_from_file"]
    if len(sys.argv) < 2 or sys.argv[1] not in commands:
        sys.exit(f"usage: sb3-cchain {{{'|'.join(commands)}}} ...\nThe options are those of RL Zoo: sb3-cchain train --help")
    register_algorithms()
    if sys.argv[1] == "train":
        parser = argparse.ArgumentParser(add_help=False)
        parser.add_argument("--algo", default="ppo")
        parser.add_argument("--env", default="CartPole-v1")
        given, _ = parser.parse_known_args(sys.argv[2:])
        ours = hyperparams_file(given.algo, given.env)
        if ours is not None:
            # First, so that a file given by the user wins
            sys.argv[2:2] = ["--conf-file", str(ours)]
    rl_zoo3.cli.main()


if __name__ == "__main__":
    main()
