"""Evaluation of a policy with the masks of its environment."""

import sys
from typing import Any

from stable_baselines3.common import evaluation
from stable_baselines3.common.vec_env import VecEnv

_evaluate_policy = evaluation.evaluate_policy


def evaluate_policy(model: Any, env: VecEnv, *args: Any, **kwargs: Any) -> Any:
    """
    SB3's ``evaluate_policy``, and for MaskablePPO that of sb3-contrib, which asks the environment for its masks.

    :param model: A model
    :param env: A vectorised environment
    :param args: As of SB3's
    :param kwargs: As of SB3's
    :return: As of SB3's
    """
    contrib = sys.modules.get("sb3_contrib")  # which a model of it has imported
    if contrib is None or not isinstance(model, contrib.MaskablePPO):
        return _evaluate_policy(model, env, *args, **kwargs)
    from sb3_contrib.common.maskable.evaluation import evaluate_policy as evaluate_masked
    from sb3_contrib.common.maskable.utils import is_masking_supported

    return evaluate_masked(model, env, *args, **{"use_masking": is_masking_supported(env), **kwargs})
