"""Markdown: tables, and text from files, which must not act as markup."""

import re
from collections.abc import Iterable, Sequence


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """
    :param header: Names of the columns
    :param rows: Cells
    :return: The table in Markdown
    """
    return "\n".join(f"| {' | '.join(row)} |" for row in [header, ["---"] * len(header), *rows])


def escaped(text: object) -> str:
    """
    :param text: Text from a file
    :return: The same in Markdown, on one line, without any markup
    """
    return re.sub(r"([\\`*_\[\]<>&|!#~])", r"\\\1", " ".join(str(text).split()))


def code(text: object) -> str:
    """
    :param text: Text from a file
    :return: The same as a code span, on one line
    """
    line = " ".join(str(text).split())
    fence = "`" * (1 + max(map(len, re.findall("`+", line)), default=0))
    return f"{fence} {line} {fence}" if len(fence) > 1 or not line else f"{fence}{line}{fence}"
