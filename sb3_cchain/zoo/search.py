"""What ``sb3-cchain train -optimize`` searches for our algorithms and for the related methods."""

from copy import copy
from typing import Any

import optuna
import rl_zoo3.exp_manager
import rl_zoo3.train
from rl_zoo3.hyperparams_opt import (
    HYPERPARAMS_CONVERTER,
    HYPERPARAMS_SAMPLER,
    convert_offpolicy_params,
    convert_onpolicy_params,
    sample_her_params,
    sample_ppo_params,
)

# The paper's grids: clipping range κ, regularisation coefficient c. It has none for ReDo: τ is none but dead units, the
# original's value for DQN and four times that; the interval in iterations is Plasticine's, a tenth and ten times that.
GRIDS: dict[str, dict[str, list[float]]] = {
    "ppo_weight_clipping": {"clip_ratio": [0.1, 0.5, 1.0, 10.0]},
    "ppo_l2_init": {"coef": [0.1, 1.0, 10.0, 100.0, 1000.0]},
    "ppo_redo": {"tau": [0.0, 0.025, 0.1], "interval": [1, 10, 100]},
}
REDO = "sb3_cchain.methods.ReDo"


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


class ExperimentManager(rl_zoo3.exp_manager.ExperimentManager):
    """
    RL Zoo's, which also searches the grids of the related methods. Their values stand within ``policy_kwargs`` and
    ``callback`` of the settings, the first of which RL Zoo's samplers replace as a whole, and the second not at all.
    """

    def objective(self, trial: optuna.Trial) -> float:
        """
        :param trial: Optuna's trial
        :return: Mean reward of the last evaluation
        :raises ValueError: When ReDo is to be searched and the settings do not have it
        """
        values = {name: trial.suggest_categorical(name, grid) for name, grid in GRIDS.get(self.algo, {}).items()}
        manager = copy(self)  # trials may run side by side
        if self.algo == "ppo_redo":
            manager.specified_callbacks = with_arguments(self.specified_callbacks, REDO, values)
        elif values:
            policy_kwargs = dict(self._hyperparams.get("policy_kwargs", {}))
            policy_kwargs["optimizer_kwargs"] = {**policy_kwargs.get("optimizer_kwargs", {}), **values}
            manager._hyperparams = {**self._hyperparams, "policy_kwargs": policy_kwargs}
        return super(ExperimentManager, manager).objective(trial)


def with_arguments(callbacks: str | list[Any], name: str, arguments: dict[str, Any]) -> list[Any]:
    """
    :param callbacks: ``callback`` of a YAML file
    :param name: Name of one of them
    :param arguments: Arguments of it
    :return: The same with these arguments
    :raises ValueError: When there is none of that name
    """
    entries = [callbacks] if isinstance(callbacks, str) else callbacks
    with_kwargs = [{entry: {}} if isinstance(entry, str) else entry for entry in entries]
    if not any(name in entry for entry in with_kwargs):
        raise ValueError(f"`callback` must have {name}, got {callbacks}")
    return [{name: {**entry[name], **arguments}} if name in entry else entry for entry in with_kwargs]


def refuse_trial(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: Values of a trial
    :raises ValueError: Always
    """
    raise ValueError(f"`--trial-id` cannot put {sampled_params} into the settings: give a YAML file of your own, -conf FILE")


def register_search_spaces() -> None:
    """Make the search spaces known to RL Zoo, in place."""
    rl_zoo3.train.ExperimentManager = ExperimentManager  # type: ignore[misc]
    HYPERPARAMS_SAMPLER["ppo_cchain"] = sample_ppo_cchain_params
    HYPERPARAMS_CONVERTER["ppo_cchain"] = convert_onpolicy_params
    HYPERPARAMS_SAMPLER["double_dqn"] = sample_double_dqn_params
    HYPERPARAMS_SAMPLER["dqn_cchain"] = sample_dqn_cchain_params
    HYPERPARAMS_CONVERTER["double_dqn"] = HYPERPARAMS_CONVERTER["dqn_cchain"] = convert_dqn_params
    for method in GRIDS:
        HYPERPARAMS_SAMPLER[method] = lambda *_: {}  # the ExperimentManager does it
        HYPERPARAMS_CONVERTER[method] = refuse_trial
