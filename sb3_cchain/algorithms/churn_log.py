"""What all algorithms log of churn reduction."""

from collections.abc import Callable, Sized

from sb3_cchain.churn.coefficient import LOSS_EPS


def churn_prefix(name: str, reducers: Sized) -> str:
    """
    :param name: The target that a reducer holds still
    :param reducers: All reducers of the model
    :return: What goes before the names of its logged values, which tells the target where there are several
    """
    return "churn" if len(reducers) == 1 else f"churn/{name}"


def log_churn(record: Callable[[str, float], None], prefix: str, coef: float, churn_loss: float, base_loss: float) -> None:
    r"""
    Log ``loss``, the churn loss L_churn, ``coef``, the λ that it was multiplied by, and ``relative_loss``,
    :math:`\lambda L_{churn} / |L|`, which an adaptive λ holds at β.

    :param record: ``record`` of the model's logger, or ``record_mean``
    :param prefix: :func:`churn_prefix`
    :param coef: λ
    :param churn_loss: L_churn
    :param base_loss: :math:`|L|`
    """
    record(f"{prefix}/loss", churn_loss)
    record(f"{prefix}/coef", coef)
    record(f"{prefix}/relative_loss", coef * churn_loss / (base_loss + LOSS_EPS))
