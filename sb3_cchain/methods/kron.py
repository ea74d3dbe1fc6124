"""PSGD with Kronecker-factored preconditioners."""

from typing import Any

import torch as th
from torch.optim.optimizer import ParamsT

from sb3_cchain.methods.optimizer_wrapper import OptimizerWrapper
from sb3_cchain.validation import check_number


class Kron(OptimizerWrapper):
    r"""
    Preconditioned stochastic gradient descent (PSGD) with Kronecker-factored preconditioners: the update of a matrix with
    momentum :math:`M` is

    .. math:: W \leftarrow W - \eta \, Q_L^\top Q_L M Q_R^\top Q_R

    where the triangular :math:`Q_L, Q_R` are learned while training goes on, so that the preconditioned gradients become
    white. Vectors have a diagonal preconditioner, convolutions one factor for each of their dimensions.

    Sources: Li (2018), "Preconditioned stochastic gradient descent", https://arxiv.org/abs/1512.04202; in reinforcement
    learning: Castanyer et al. (2025), "Stable gradients for stable learning at scale in deep reinforcement learning",
    https://arxiv.org/abs/2506.15544. It is ``Kron`` of the package
    `pytorch-optimizer <https://github.com/kozistr/pytorch_optimizer>`_ (extra ``psgd``), as an optimiser of this package: it
    has no optimiser inside, and can be the ``base_class`` of the others. It has no step count, which :class:`AdamRel` needs.

    Its factors grow for as long as the gradients are 0, such as those of a policy that has collapsed, until the parameters are
    NaN.

    It costs a few products of each matrix with square matrices of its sides, and as long as the preconditioner is learned in
    each update, two triangular solves and more products. The factors take as much memory as two square matrices per
    matrix.

    :param params: Parameters or parameter groups
    :param lr: Learning rate, η
    :param momentum: Decay rate of the running mean of the gradients
    :param weight_decay: Share of the weights that is subtracted in each update, times the learning rate
    :param update_probability: Share of the updates in which the preconditioners are learned; None for all of the first 500,
        and then less and less down to 3 %
    :param max_size_triangular: Greatest side with a triangular factor; longer ones get a diagonal one
    :raises ImportError: When ``pytorch-optimizer`` is not installed, or ``opt-einsum``, without which its products would take
        memory of the fourth power of the width
    :raises ValueError: Naming the argument that is out of its range
    """

    name = "kron"
    has_arguments_of_base = False

    def __init__(
        self,
        params: ParamsT,
        lr: float | th.Tensor = 1e-3,
        *,
        momentum: float = 0.9,
        weight_decay: float = 0.0,
        update_probability: float | None = None,
        max_size_triangular: int = 8192,
    ):
        check_number("momentum", momentum, minimum=0, below=1)
        check_number("weight_decay", weight_decay, minimum=0)
        if update_probability is not None:
            check_number("update_probability", update_probability, minimum=0, maximum=1)
        check_number("max_size_triangular", max_size_triangular, minimum=1, integer=True)
        arguments: dict[str, Any] = dict(
            momentum=momentum,
            weight_decay=weight_decay,
            pre_conditioner_update_probability=update_probability,
            max_size_triangular=max_size_triangular,
        )
        super().__init__(params, lr, base_class=_kron_class(), base_kwargs=arguments)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """
        :param state_dict: Of Kron. There is no way from the state of Adam to that of Kron
        :raises ValueError: When it is that of another optimiser
        """
        missing = {"precondition_init_scale", "precondition_lr"} - state_dict["param_groups"][0].keys()
        if missing:
            raise ValueError(f"`state_dict` must be that of Kron, got one without {', '.join(sorted(missing))}")
        super().load_state_dict(state_dict)


def _kron_class() -> type[th.optim.Optimizer]:
    missing = 'Kron needs pytorch-optimizer and opt-einsum: pip install "sb3-cchain[psgd]"'
    if not th.backends.opt_einsum.is_available():
        raise ImportError(missing)
    try:
        from pytorch_optimizer import Kron as PSGDKron
    except ImportError as error:
        raise ImportError(missing) from error
    return PSGDKron
