import torch as th

from sb3_cchain.baselines.leaf_optimizer import leaf_optimizer


class Wrapper(th.optim.Optimizer):
    """Stands for an optimiser around another one."""

    def __init__(self, base):
        super().__init__(base.param_groups, {})
        self.base = base


def test_the_innermost_optimiser():
    adam = th.optim.Adam([th.nn.Parameter(th.ones(2))])
    assert leaf_optimizer(adam) is adam
    assert leaf_optimizer(Wrapper(adam)) is adam
    assert leaf_optimizer(Wrapper(Wrapper(adam))) is adam


def test_another_base_is_none():
    adam = th.optim.Adam([th.nn.Parameter(th.ones(2))])
    adam.base = "of something else"
    assert leaf_optimizer(adam) is adam
