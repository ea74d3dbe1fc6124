"""Churn reduction for any PyTorch training loop; knows nothing of Stable-Baselines3."""

from sb3_cchain.churn.coefficient import AdaptiveChurnCoefficient, ChurnCoefficient, make_coefficient
from sb3_cchain.churn.component import component_backward, gradient_component
from sb3_cchain.churn.divergence import cross_entropy, mean_squared_difference
from sb3_cchain.churn.gradient import extra_gradient
from sb3_cchain.churn.reducer import ChurnReducer, ChurnReducers

__all__ = [
    "AdaptiveChurnCoefficient",
    "ChurnCoefficient",
    "ChurnReducer",
    "ChurnReducers",
    "component_backward",
    "cross_entropy",
    "extra_gradient",
    "gradient_component",
    "make_coefficient",
    "mean_squared_difference",
]
