"""How dormant the units of a layer are: pure functions of their activations."""

import torch as th


def mean_activity(activations: th.Tensor) -> th.Tensor:
    """
    :param activations: ``(batch_size, n_units, ...)``; further dimensions are positions, over which a filter's activation is
        averaged, too
    :return: Mean absolute activation of each unit, ``(n_units,)``
    """
    return activations.abs().transpose(0, 1).flatten(start_dim=1).mean(dim=1)


def dormant_scores(activity: th.Tensor) -> th.Tensor:
    r"""
    :math:`s_i = E_x |h_i(x)| \, / \, \frac{1}{H} \sum_k E_x |h_k(x)|`, Eq. 1 of Sokar et al. (ICML 2023),
    https://arxiv.org/abs/2302.12902. The scores of a layer have mean 1; a unit is τ-dormant when :math:`s_i \le \tau`.

    :param activity: :func:`mean_activity` of the units of one layer, ``(n_units,)``
    :return: Score of each, ``(n_units,)``; zeros where no unit is active at all
    """
    return activity / activity.mean().clamp(min=th.finfo(activity.dtype).tiny)
