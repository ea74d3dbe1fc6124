"""Churn reduction for any PyTorch training loop; knows nothing of Stable-Baselines3."""

from sb3_cchain.churn.coefficient import AdaptiveChurnCoefficient, ChurnCoefficient, make_coefficient
from sb3_cchain.churn.divergence import cross_entropy, mean_squared_difference
from sb3_cchain.churn.gradient import extra_gradient
from sb3_cchain.churn.reducer import ChurnReducer

__all__ = [
    "AdaptiveChurnCoefficient",
    "ChurnCoefficient",
    "ChurnReducer",
    "cross_entropy",
    "extra_gradient",
    "make_coefficient",
    "mean_squared_difference",
]
