"""The strength of a method: what stands after ``@`` in ``cchain@1e3``, and where it is among the hyperparameters."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from sb3_cchain.methods.registry import REGISTRY, Strength

# Where the paper takes the best of several strengths in each environment; in the other suites C-CHAIN has one β
PAPER_SUITES = ("gym_control", "procgen")
_STRENGTHS = {row.name: row.strength for row in REGISTRY if row.strength is not None}


def paper_lines(line: str, suites: Sequence[str]) -> list[str]:
    """
    :param line: Name of a method, with another strength, or with all of which the paper takes the best, as in ``cchain@all``
    :param suites: Suites that it is to be run in
    :return: The method with each of these strengths; the line itself where it has no ``@all``
    :raises ValueError: When the paper does not take the best of several in these suites
    """
    method, _, text = line.partition("@")
    if text != "all" or method not in _STRENGTHS:
        return [line]
    if not set(suites) <= set(PAPER_SUITES):
        raise ValueError(f"`method` can have @all in {' and '.join(PAPER_SUITES)} only; got {line} in {', '.join(suites)}")
    return [f"{method}@{shortest(value)}" for value in _STRENGTHS[method].paper_values]


def split_line(line: str) -> tuple[str, str | None]:
    """
    :param line: Name of a method, with another strength as in ``cchain@1e3``
    :return: Name of the method; and the strength in its shortest form, so that ``cchain@1000`` is the same run, or None
    :raises ValueError: When the strength is not a number greater than 0, or the method has none
    """
    method, at, text = line.partition("@")
    if not at:
        return line, None
    if method not in _STRENGTHS:
        allowed = ", ".join(f"{name} ({strength.symbol})" for name, strength in _STRENGTHS.items())
        raise ValueError(f"`method` can have a strength after @ for {allowed} only; got {line}")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        symbol = _STRENGTHS[method].symbol
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
