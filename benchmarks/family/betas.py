"""Short runs with several β, from which the defaults come."""

from collections.abc import Mapping
from typing import Any

import torch as th
from sb3_contrib import TQC, TRPO, CrossQ
from stable_baselines3 import A2C, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm

from benchmarks.family.case import Case, Variant, action_noise
from sb3_cchain import CChainA2C, CChainPPO, CChainSAC, CChainTD3
from sb3_cchain.algorithms.churn_targets import churn_kind
from sb3_cchain.algorithms.contrib import CChainCrossQ, CChainTQC, CChainTRPO


def _variants(base: type[BaseAlgorithm], cchain: type[BaseAlgorithm], **betas: str) -> dict[str, Variant]:
    """
    :param base: Algorithm without churn reduction
    :param cchain: Its class with churn reduction
    :param betas: β that are tried, by target, as they are written
    :return: The base, then a variant for each β
    """
    variants = {base.__name__.lower(): Variant(base.__name__, base)}
    for target, values in betas.items():
        defaults = churn_kind(base).targets[target].target_ratios.values()
        for beta in values.split():
            label = f"{target}, β {beta}{' (default)' if float(beta) in defaults else ''}"
            arguments = {"churn_target": target, "target_churn_ratio": float(beta)}
            variants[f"cchain_{target}_{beta}"] = Variant(label, cchain, arguments)
    return variants


def _cartpole(algorithm: str, variants: Mapping[str, Variant], source: str = "", **settings: Any) -> Case:
    return Case(
        f"β of {algorithm}, CartPole",
        f"8 environments, {source}SB3's settings otherwise",
        "CartPole-v1",
        variants,
        steps=40_000,
        eval_freq=4000,
        seeds=3,
        settings=settings,
        n_envs=8,
        monitor={"interval": 11, "batch_size": 32},
    )


def _pendulum(algorithm: str, variants: Mapping[str, Variant], source: str = "", **settings: Any) -> Case:
    return Case(
        f"β of {algorithm}, Pendulum",
        f"two layers of 64, a learning rate of 1e-3, {source}SB3's settings otherwise",
        "Pendulum-v1",
        variants,
        steps=10_000,
        eval_freq=1000,
        seeds=3,
        settings={"learning_rate": 1e-3, "learning_starts": 1000, "policy_kwargs": {"net_arch": [64, 64]}, **settings},
        monitor={"interval": 11},
    )


_ROLLOUTS = {"n_steps": 128, "batch_size": 128}
_ADAM = {"policy_kwargs": {"optimizer_class": th.optim.Adam}}

BETAS = {
    "a2c_betas": _cartpole(
        "A2C",
        {
            **_variants(A2C, CChainA2C, policy="0.1 1 10 100 1e3 1e4", value="1e-4 1e-3 0.01"),
            "a2c_adam": Variant("A2C with Adam", A2C, _ADAM),
            "cchain_adam_value_0.01": Variant(
                "with Adam, value, β 0.01", CChainA2C, {**_ADAM, "churn_target": "value", "target_churn_ratio": 0.01}
            ),
        },
    ),
    "ppo_value_betas": _cartpole(
        "PPO's values",
        _variants(PPO, CChainPPO, value="1e-4 1e-3 0.01 0.1"),
        "rollouts of 128 steps each, minibatches of 128, 8 epochs, ",
        **_ROLLOUTS,
        n_epochs=8,
    ),
    "trpo_betas": _cartpole(
        "TRPO",
        _variants(TRPO, CChainTRPO, value="1e-4 1e-3 0.01"),
        "rollouts of 128 steps each, minibatches of 128, ",
        **_ROLLOUTS,
    ),
    "sac_betas": _pendulum(
        "SAC",
        _variants(SAC, CChainSAC, policy="5e-6 5e-5 5e-4", value="1e-4 1e-3 0.01"),
    ),
    "td3_betas": _pendulum(
        "TD3",
        _variants(TD3, CChainTD3, policy="5e-6 5e-5 5e-4", value="1e-4 1e-3 0.01"),
        "noise of 0.1 and a γ of 0.98, ",
        gamma=0.98,
        action_noise=action_noise(1),
    ),
    "tqc_betas": _pendulum("TQC", _variants(TQC, CChainTQC, policy="5e-6 5e-5", value="1e-3")),
    "crossq_betas": _pendulum("CrossQ", _variants(CrossQ, CChainCrossQ, policy="5e-5 0.01", value="1e-3")),
}
