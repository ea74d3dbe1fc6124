"""How far the outputs of a model moved: pure functions of those before (``old``) and after (``new``) one or more updates."""

import torch as th

from sb3_cchain.analysis.model_outputs import ModelOutputs
from sb3_cchain.churn.divergence import action_changes, cross_entropy, mean_absolute_change, mean_squared_difference


def kl_divergence(old: th.Tensor, new: th.Tensor) -> float:
    r"""
    :math:`KL(p_{old} \,\|\, p_{new}) = E_x \sum_a p_{old}(a|x) \log \frac{p_{old}(a|x)}{p_{new}(a|x)}`, with
    :math:`10^{-8}` added inside the logarithms.

    :param old: Probabilities before, ``(batch_size, ..., n_categories)``; dimensions in between are independent distributions,
        whose divergences are summed
    :param new: Probabilities after, of the same shape
    :return: Mean over the batch
    """
    # In single precision the probabilities miss a sum of 1 by more than what one small update changes
    old, new = (probs.double() / probs.double().sum(dim=-1, keepdim=True) for probs in (old, new))
    return (cross_entropy(old, new) - cross_entropy(old, old)).item()


def churn(old: ModelOutputs, new: ModelOutputs) -> dict[str, float]:
    r"""
    The churn :math:`C_f(x, \theta, \Delta_\theta)` of Tang et al. (ICML 2025), https://arxiv.org/abs/2506.00592, averaged over
    a batch, for each kind of output that there is:

    - ``policy_churn``: of a categorical policy :func:`kl_divergence`; of a continuous one the mean squared difference of the
      action means, over batch and action dimensions
    - ``value_churn``: :func:`mean_absolute_change` of the values
    - ``greedy_action_changes``: :func:`action_changes` of the greedy actions

    :param old: Outputs before
    :param new: Outputs after, on the same batch
    :return: By name
    """
    churns = {}
    if old.probabilities is not None and new.probabilities is not None:
        churns["policy_churn"] = kl_divergence(old.probabilities, new.probabilities)
    if old.action_means is not None and new.action_means is not None:
        churns["policy_churn"] = mean_squared_difference(old.action_means, new.action_means).item()
    if old.values is not None and new.values is not None:
        churns["value_churn"] = mean_absolute_change(old.values, new.values)
    if old.greedy_actions is not None and new.greedy_actions is not None:
        churns["greedy_action_changes"] = action_changes(old.greedy_actions, new.greedy_actions)
    return churns
