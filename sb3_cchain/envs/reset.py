"""Resets any environment that SB3 takes."""

from typing import Any

import gymnasium as gym


def reset_env(env: gym.Env, seed: int | None, options: dict[str, Any] | None) -> tuple[Any, dict[str, Any]]:
    """
    :param env: An environment. As with SB3, its ``reset()`` need not take options unless some are given
    :param seed: Passed on
    :param options: Passed on unless None
    :return: Observation and info
    """
    return env.reset(seed=seed) if options is None else env.reset(seed=seed, options=options)
