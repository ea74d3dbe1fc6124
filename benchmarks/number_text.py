"""How numbers are written, in tables and in the terminal."""


def thousands(number: int) -> str:
    """
    :param number: A whole number
    :return: It with a space before each three digits: 160 000
    """
    return f"{number:,}".replace(",", " ")


def with_error(mean: float, error: float | None, digits: int) -> str:
    """
    :param mean: A mean
    :param error: Its standard error, None where it is not known
    :param digits: Digits after the point
    :return: The mean ± its error, or the mean alone
    """
    return f"{mean:.{digits}f}" + ("" if error is None else f" ± {error:.{digits}f}")
