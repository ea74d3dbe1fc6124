"""Policies that were compiled by ``model.policy = th.compile(model.policy)``, as SB3's manual shows."""

from typing import Any

from torch import nn


def uncompiled(policy: nn.Module) -> Any:
    """
    :param policy: A policy
    :return: The policy itself, without the wrapper of ``torch.compile()``, which gives other names to its parameters. Both
        share their parameters.
    """
    return getattr(policy, "_orig_mod", policy)
