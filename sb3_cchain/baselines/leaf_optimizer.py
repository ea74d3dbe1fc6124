"""The optimiser inside its wrappers."""

import torch as th


def leaf_optimizer(optimizer: th.optim.Optimizer) -> th.optim.Optimizer:
    """
    :param optimizer: An optimiser, or one wrapped around another, which is its attribute ``base``; wrappers nest
    :return: The innermost one, whose ``state`` holds the moments
    """
    while isinstance(base := getattr(optimizer, "base", None), th.optim.Optimizer):
        optimizer = base
    return optimizer
