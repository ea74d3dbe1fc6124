"""The strength of a method: what stands after ``@`` in ``cchain@1e3``, and where it is among the hyperparameters."""

import math
import re
from collections.abc import Mapping
from typing import Any

from sb3_cchain.methods.registry import REGISTRY, Strength


def split_line(line: str) -> tuple[str, str | None]:
    """
    :param line: Name of a method, with another strength as in ``cchain@1e3``
    :return: Name of the method; and the strength in its shortest form, so that ``cchain@1000`` is the same run, or None
    :raises ValueError: When the strength is not a number greater than 0, or the method has none
    """
    method, at, text = line.partition("@")
    if not at:
        return line, None
    strengths = {row.name: row.strength for row in REGISTRY if row.strength is not None}
    if method not in strengths:
        allowed = ", ".join(f"{name} ({strength.symbol})" for name, strength in strengths.items())
        raise ValueError(f"`method` can have a strength after @ for {allowed} only; got {line}")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        symbol = strengths[method].symbol
        raise ValueError(f"`method` must have {symbol} after @, a number greater than 0, as in {method}@10; got {line}")
    return method, shortest(value)


def shortest(number: float) -> str:
    """
    :param number: A number
    :return: Its shortest form
    """
    mantissa, exponent = f"{number:e}".split("e")
    texts = (f"{number:g}", f"{mantissa.rstrip('0').rstrip('.')}e{int(exponent)}", repr(number))
    return min((text for text in texts if float(text) == number), key=len)


def with_strength(strength: Strength, hyperparameters: Mapping[str, Any], value: str) -> dict[str, Any]:
    """
    :param strength: The strength of a method
    :param hyperparameters: The method's hyperparameters, with it among them or in the text of ``policy_kwargs``
    :param value: Another value
    :return: The hyperparameter that changes, with that value
    """
    if strength.argument in hyperparameters:
        return {strength.argument: float(value)}
    text = re.sub(_in_text(strength), f"{strength.argument}={value}", hyperparameters["policy_kwargs"])
    return {"policy_kwargs": text}


def strength_override(differing: Mapping[str, Any], value: str) -> str:
    """
    :param differing: What :func:`with_strength` returned
    :param value: The strength
    :return: What is given after ``--hyperparams``
    """
    ((name, changed),) = differing.items()
    return f"{name}:{changed!r}" if isinstance(changed, str) else f"{name}:{value}"


def read_strength(strength: Strength, hyperparameters: Mapping[str, Any]) -> str:
    """
    :param strength: The strength of a method
    :param hyperparameters: The method's hyperparameters
    :return: The strength in its shortest form
    :raises ValueError: When it is not among them
    """
    if strength.argument in hyperparameters:
        return shortest(float(hyperparameters[strength.argument]))
    found = re.search(_in_text(strength), str(hyperparameters.get("policy_kwargs")))
    if found is None:
        raise ValueError(f"The hyperparameters must have `{strength.argument}`; got {dict(hyperparameters)}")
    return shortest(float(found[1]))


def _in_text(strength: Strength) -> str:
    return rf"\b{strength.argument}=([^,)]+)"
