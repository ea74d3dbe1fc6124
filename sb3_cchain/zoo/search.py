"""What ``sb3-cchain train -optimize`` searches for the algorithms of this package and for the related methods."""

from collections.abc import Callable
from functools import partial
from typing import Any

import optuna
from rl_zoo3 import ALGOS, hyperparams_opt
from rl_zoo3.hyperparams_opt import convert_offpolicy_params, sample_her_params
from rl_zoo3.utils import get_class_by_name
from sb3_contrib import CrossQ, MaskablePPO
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_cchain.algorithms import DoubleDQN
from sb3_cchain.algorithms.churn_algorithm import ChurnAlgorithm
from sb3_cchain.algorithms.churn_targets import ChurnArguments, ChurnTarget, churn_kind
from sb3_cchain.algorithms.reference_batches import REFERENCES
from sb3_cchain.churn import cross_entropy, mean_squared_difference
from sb3_cchain.methods.registry import REGISTRY, Method

# Arguments: Optuna's trial, the dimension of continuous actions (0 for others), the number of environments, and RL Zoo's
# `additional_args`. Returns hyperparameters of the algorithm.
Sampler = Callable[[optuna.Trial, int, int, dict[str, Any]], dict[str, Any]]
# From the values of a trial to the hyperparameters that they stand for
Converter = Callable[[dict[str, Any]], dict[str, Any]]

BETA = "target_churn_ratio"

# RL Zoo's, by name on the command line
HYPERPARAMS_SAMPLER: dict[str, Any] = hyperparams_opt.HYPERPARAMS_SAMPLER
HYPERPARAMS_CONVERTER: dict[str, Any] = hyperparams_opt.HYPERPARAMS_CONVERTER


def sample_double_dqn_params(
    trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """
    RL Zoo's search space for DQN without the network: its choice would replace the whole of ``policy_kwargs``, and with it the
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
    params = convert_double_dqn_params(sampled)
    for name in ("gamma", "batch_size"):  # shown in reports, as RL Zoo's samplers do
        trial.set_user_attr(name, params[name])
    return params


def convert_double_dqn_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: Values of a trial
    :return: The hyperparameters that they stand for, without a network
    """
    params = convert_offpolicy_params({**sampled_params, "net_arch": "small"})
    del params["policy_kwargs"]
    return params


def with_churn_arguments(sampler: Sampler, algorithm: type[BaseAlgorithm], churn_target: str = "auto") -> Sampler:
    """
    :param sampler: Search space of the algorithm without churn reduction
    :param algorithm: An algorithm with churn reduction
    :param churn_target: What it holds still; of ``"both"`` each has a β of its own
    :return: The same search space and β, a decade beyond the papers' values on either side. With PPO and DQN also where the
        reference batches are taken from, and with PPO their size.
    :raises ValueError: When the algorithm has no such target
    """
    kind = churn_kind(algorithm)
    names = ChurnArguments(churn_target).target_names(kind, algorithm.__name__)

    def sample(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
        sampled = sampler(trial, n_actions, n_envs, additional_args)
        for name in names:
            target = kind.targets[name]
            default = target.target_ratios[cross_entropy if _is_discrete(target, n_actions) else mean_squared_difference]
            suggested = BETA if len(names) == 1 else f"{BETA}_{name}"
            sampled[suggested] = trial.suggest_float(suggested, *_BETAS[default], log=True)
        sampled = with_beta_of_each(sampled)
        if issubclass(algorithm, (PPO, DQN)):
            sampled["churn_reference"] = trial.suggest_categorical("churn_reference", list(REFERENCES))
        if issubclass(algorithm, PPO):
            sampled["churn_batch_size"] = trial.suggest_categorical("churn_batch_size", [0.25, 0.5, 1.0, 2.0, 4.0, 8.0])
        return sampled

    return sample


def with_beta_of_each(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: Values of a trial
    :return: The same, with the β of several targets in one dict
    """
    each = {name: sampled_params[f"{BETA}_{name}"] for name in ("policy", "value") if f"{BETA}_{name}" in sampled_params}
    params = {key: value for key, value in sampled_params.items() if not key.startswith(f"{BETA}_")}
    return {**params, BETA: each} if each else params


# By the default: a decade beyond the values of the papers and their code on either side; two where no paper has values
_BETAS = {
    1e4: (1e2, 1e6),
    1e2: (1.0, 1e4),
    10: (0.1, 1e3),
    0.05: (5e-3, 5.0),
    0.01: (1e-3, 1e-1),
    1e-3: (1e-4, 1e-2),
    5e-5: (5e-6, 5e-4),
    5e-6: (5e-7, 5e-5),
}


def _is_discrete(target: ChurnTarget, n_actions: int) -> bool:
    return n_actions == 0 and cross_entropy in target.target_ratios


def refuse_trial(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: Values of a trial
    :raises ValueError: Always
    """
    raise ValueError(f"`--trial-id` cannot put {sampled_params} into the settings: give a YAML file of your own, -conf FILE")


# By class, RL Zoo's, and those of this package that differ from them
_SEARCH_SPACES: dict[type[BaseAlgorithm], tuple[Sampler, Converter]] = {
    **{ALGOS[name]: (HYPERPARAMS_SAMPLER[name], HYPERPARAMS_CONVERTER[name]) for name in HYPERPARAMS_SAMPLER},
    DoubleDQN: (sample_double_dqn_params, convert_double_dqn_params),
    # RL Zoo has none of these. Of CrossQ, β alone is searched
    MaskablePPO: (HYPERPARAMS_SAMPLER["ppo"], HYPERPARAMS_CONVERTER["ppo"]),
    CrossQ: (lambda *_: {}, dict),
}
_RL_ZOO_NAMES = frozenset(HYPERPARAMS_SAMPLER)


def search_churn_target(algo: str, churn_target: str) -> None:
    """
    Search the β of what is held still.

    :param algo: Name of an algorithm on the command line
    :param churn_target: Its ``churn_target``
    :raises ValueError: When the algorithm has no such target
    """
    algorithm = ALGOS[algo]
    if issubclass(algorithm, ChurnAlgorithm) and (space := _search_space(algorithm)):
        HYPERPARAMS_SAMPLER[algo] = with_churn_arguments(space[0], algorithm, churn_target)


def register_search_spaces() -> None:
    """Make the search spaces of all methods known to RL Zoo, in place."""
    for method in REGISTRY:
        if method.grid:
            HYPERPARAMS_SAMPLER[method.algo] = lambda *_: {}  # zoo/experiment.py searches the grid
            HYPERPARAMS_CONVERTER[method.algo] = refuse_trial
        elif not method.is_related and method.algo not in _RL_ZOO_NAMES:
            space = _search_space(method.algorithm)
            if space is None:
                continue
            HYPERPARAMS_SAMPLER[method.algo], HYPERPARAMS_CONVERTER[method.algo] = space
            if issubclass(method.algorithm, ChurnAlgorithm):
                search_churn_target(method.algo, "auto")
                HYPERPARAMS_CONVERTER[method.algo] = partial(_convert_with_beta, space[1])


def _search_space(algorithm: type[BaseAlgorithm]) -> tuple[Sampler, Converter] | None:
    """That of the nearest base that has one."""
    return next((_SEARCH_SPACES[base] for base in algorithm.__mro__ if base in _SEARCH_SPACES), None)


def _convert_with_beta(converter: Converter, sampled_params: dict[str, Any]) -> dict[str, Any]:
    return with_beta_of_each(converter(sampled_params))


def suggest_from_grid(trial: optuna.Trial, method: Method) -> dict[str, Any]:
    """
    :param trial: Optuna's trial
    :param method: A method
    :return: A value of each argument in its grid
    """
    return {name: trial.suggest_categorical(name, list(values)) for name, values in method.grid.items()}


def add_to_policy_kwargs(hyperparams: dict[str, Any], optimizer_kwargs: dict[str, Any]) -> dict[str, Any]:
    """
    :param hyperparams: Hyperparameters of an algorithm
    :param optimizer_kwargs: Arguments of the optimiser
    :return: The same with these arguments, and all others as they were
    """
    policy_kwargs = dict(hyperparams.get("policy_kwargs", {}))
    policy_kwargs["optimizer_kwargs"] = {**policy_kwargs.get("optimizer_kwargs", {}), **optimizer_kwargs}
    return {**hyperparams, "policy_kwargs": policy_kwargs}


def add_to_callback(callbacks: str | list[Any], callback_class: type, arguments: dict[str, Any]) -> list[Any]:
    """
    :param callbacks: ``callback`` of a YAML file
    :param callback_class: Class of one of them
    :param arguments: Arguments of that one
    :return: The same with these arguments, and all others as they were
    :raises ValueError: When there is no such callback, or one is an object
    """
    entries = [callbacks] if isinstance(callbacks, str) else callbacks
    with_arguments, found = [], False
    for entry in entries:
        if not isinstance(entry, str | dict):
            raise ValueError(f"-optimize: `callback` must hold names of classes, as a YAML file does, got {entry}")
        ((name, given),) = entry.items() if isinstance(entry, dict) else [(entry, {})]
        if issubclass(get_class_by_name(name), callback_class):
            found, given = True, {**(given or {}), **arguments}
        with_arguments.append({name: given})
    if not found:
        raise ValueError(f"-optimize: `callback` must have {callback_class.__name__}, got {callbacks}")
    return with_arguments
