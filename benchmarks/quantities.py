"""The quantities of the neural tangent kernel that the report draws and tables."""

from typing import NamedTuple


class Quantity(NamedTuple):
    """A scalar of ``metrics.csv``, its label, and whether its axis is logarithmic."""

    name: str
    label: str
    logarithmic: bool


NTK = (
    Quantity("ntk/srank", "srank", False),
    Quantity("ntk/off_diagonal_sum", "off-diagonal sum", True),
    Quantity("ntk/diagonal_sum", "diagonal sum", True),
)
