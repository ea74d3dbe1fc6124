"""How far the outputs of a model moved. The measures that the churn loss shares are in ``churn/divergence.py``."""

import torch as th

from sb3_cchain.churn.divergence import cross_entropy


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
